"""`RobotQuery`: a chunk of configurations as an operator; and edges, halved until each stretch is decided.

A launch poses the parts, writes the pairs of each stage, a part first, and asks them; stages that a configuration needs
no more are empty. Of outputs beside "any" and "distance", "within" tells of what does not meet whether it is proved
apart by a reach, and "pairs" is read by the host after each stage, so that no graph captures it. Parts that are padded
meet where they are not proved apart by their paddings, which is asked first; distances are those of the parts as they
are.
"""

from itertools import product
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.device_memory import DeviceMemory
from warp_abtree.checks.upload import struct_of, zeros_of
from warp_abtree.interop.robot.link_parts import order_parts, padding_of
from warp_abtree.interop.robot.surroundings import make_batch
from warp_abtree.kernels.intersect.broad_phase import PosedBounds, pose_box_kernel
from warp_abtree.kernels.robot import answers, forward, link_pairs
from warp_abtree.kernels.robot.link_pairs import ASK_ANY, ASK_DISTANCE, ASK_PADDED, ASK_WITHIN
from warp_abtree.query.request import Buffers, CapacityError
from warp_abtree.query.stages.distance import DistanceQuery
from warp_abtree.query.stages.intersect import Query
from warp_abtree.scene.sweep import CONTACT_ROWS

PAIRS_GUESS = 2  # of a configuration and stage
NO_PAIRS = np.zeros((0, 2), np.int32)
NEAREST_ROWS = np.dtype(
    [("distance", np.float64), ("points", np.float64, (2, 3)), ("faces", np.int32, 2), ("pair", np.int32, 2)]
)
# Edges whose stretches are halved at a time.
EDGES_AT_ONCE = 1024
# Stretches of an edge that are looked at at a time, and how short they may be: what takes more is undecided.
STRETCHES_MAX, WIDTH_LEAST = 1024, 2.0**-30


class RobotQuery(DeviceMemory):
    """A fixed number of configurations as an operator: allocates once, launches many times.

    `launch()` only launches, so that a CUDA graph can capture it; `configurations` and the poses of what surrounds the
    robot, as of the last `take_poses`, are read by each launch. Configurations are taken as they are: those that are
    not finite meet nothing.

    Attributes:
        configurations: Device float64 (room, n).
        hit: Whether parts of each intersect, device uint8 (room,).
        nearest: Of output "distance", device arrays of `kernels.robot.answers.NearestParts`, else None.
    """

    def __init__(self, robot, around, output: str, room: int):
        self.device, self.output, self.room = robot.device, output, room
        self.active = room  # configurations that are posed
        self.batch, meets = make_batch(around, robot.models, room, robot.device)
        self.around = len(meets)  # objects of the surroundings, which come first
        self.chain = robot.description.make_chain(self.device)
        padding = padding_of(robot)
        self.parts, self.stages = order_parts(robot, meets, padding)
        device, batch, rows = self.device, self.batch, (room, len(self.chain.lower))
        buffers, is_within = Buffers(pairs=max(1, PAIRS_GUESS * room)), output == "within"
        self.found: list[np.ndarray] = []  # of "pairs", pairs of objects that meet, a part first, (k, 2)
        self.most, self.nearest = np.inf, None  # of "distance", what is farther apart is infinitely far
        proofs = [ASK_PADDED] * bool(padding.any()) + [ASK_WITHIN] * is_within
        self._modes = [ASK_DISTANCE] if output == "distance" else proofs or [ASK_ANY]  # of each stage
        self.query: Any
        self._reach: str | None  # array of how far each pair matters
        if output == "distance":
            self._reach = "beyond"
            self.query = DistanceQuery(batch, NO_PAIRS, buffers)
            self.nearest = zeros_of(answers.NearestParts, room, 0, device)
        else:
            self._reach = "within" if proofs else None
            self.query = Query(batch, "any", NO_PAIRS, buffers, within=0.0 if proofs else None)
        self.frames = zeros_of(forward.Frames, room, len(self.chain.parent), device)
        spread, near, most = rows if is_within else (0, 0), room * is_within, room * (output == "distance")
        shapes: dict[str, Any] = {"half": spread, "size": spread, "hit": room, "near": near, "best": most}
        zeros = {name: np.zeros(shape) for name, shape in shapes.items()}
        self.chunk = struct_of(link_pairs.Chunk, device, count=[room], **zeros)
        arrays = {name: getattr(self.chunk, name) for name in link_pairs.Chunk.vars}
        self._padded = struct_of(link_pairs.Chunk, device, **{**arrays, "near": self.chunk.hit})  # what is near meets
        self.hit, self.configurations = self.chunk.hit, wp.zeros(rows, dtype=wp.float64, device=device)
        self.demand = wp.zeros(2, dtype=wp.int32, device=device)  # pairs of a stage at most, and face pairs that waited
        corners = {name: wp.zeros(batch.object_count, dtype=wp.vec3, device=device) for name in ("lower", "upper")}
        self._boxes = struct_of(link_pairs.LinkBoxes, device, **corners)
        self._bounds, count = struct_of(PosedBounds, device, pair_count=[0], **corners), self.around
        self._bvh = wp.Bvh(*(corner[:count] for corner in corners.values())) if count else None
        self._boxes.bvh = wp.uint64(0) if self._bvh is None else self._bvh.id
        self._world, self._models = around, len(robot.models)
        self._world_batch, self._lods = (None, np.zeros(0)) if around is None else (around.batch(), around.lods)
        self._own_names = [robot.link_names[k] for k in robot.model_link]
        self.take_poses()

    def take_poses(self):
        """Read where what surrounds the robot is now; raise RuntimeError if objects were added to it. Launches only."""
        if self._world_batch is not None:
            self._world_batch.check("robot query")
            source, target = self._world_batch.objects.pool, self.batch.objects.pool
            wp.copy(target.rotation, source.rotation, count=self.around)
            wp.copy(target.position, source.position, count=self.around)

    def is_of(self, world) -> bool:
        """Return whether what surrounds the robot still has the same objects at the same LODs."""
        if world is None or self._world is not world:
            return True  # of models that were given again
        return self._world_batch is world.batch() and np.array_equal(self._lods, world.lods)

    def _names(self) -> list[str]:
        """Return the names of models of the robot, of what surrounds it now, and of -1."""
        around = [] if self._world_batch is None else self._world_batch.names
        return [*self._own_names, *around, ""]

    def place(self):
        """Pose the parts of all configurations, and box all objects. Launches only."""
        device, batch, around, parts = self.device, self.batch, self.around, self.parts.frame
        inputs = [self.chain, self.configurations, self.frames]
        wp.launch(forward.forward_kernel, self.active, inputs, device=device)
        inputs = [around, parts, self.frames, batch.objects.pool]
        wp.launch(forward.place_part_kernel, (self.active, len(parts)), inputs, device=device)
        inputs = [batch.trees, self.query.guard.record(), 0.0, None, self._bounds]
        wp.launch(pose_box_kernel, around + self.active * len(parts), inputs, device=device)
        if self._bvh is not None:
            self._bvh.rebuild()
        self.hit.zero_()
        self.chunk.near.zero_()

    def launch(self):
        """Check all configurations. Launches only."""
        query, around = self.query, self.around
        query.check_scene()
        with query.guard.launching(self):
            self._forget()
            self.place()
            distances = None if self._reach is None else query.distances_of(self._reach)
            for stage, mode in product(self.stages, self._modes):
                query.pair_count.zero_()
                inputs = [mode, wp.vec2i(*stage), around, self.chain, self.parts, self.frames]
                inputs += [self._boxes, self.chunk, query.pair_batch, distances]
                wp.launch(link_pairs.find_link_pair_kernel, self.active, inputs, device=self.device)
                query.search()
                self._note([around, len(self.parts.frame), query.pair_batch], mode)

    def _forget(self):
        """Forget the answers of the last launch. Launches only."""
        self.demand.zero_()
        self.found.clear()
        if self.nearest is not None:
            self.chunk.best.fill_(self.most)
            self.nearest.distance.fill_(np.inf)
            self.nearest.points.fill_(np.nan)
            self.nearest.faces.fill_(wp.vec2i(-1, -1))
            self.nearest.pair.fill_(wp.vec2i(-1, -1))

    def _note(self, found: list, mode: int):
        """Reduce the answers of a stage's pairs to those of configurations. Launches only, but for "pairs"."""
        query, nearest, chunk = self.query, self.nearest, self._padded if mode == ASK_PADDED else self.chunk
        if nearest is None:
            near = None if query.near is None else query.near.any_hit
            steps = [(answers.note_hit_kernel, [query.hits, near, chunk, self.demand])]
        else:
            nearest.winner.fill_(int(answers.NO_PAIR))
            steps = [
                (answers.note_distance_kernel, [query.hits, query.distances, chunk, self.demand]),
                (answers.find_winner_kernel, [query.distances, chunk, nearest]),
                (answers.write_nearest_kernel, [query.distances, nearest, chunk]),
            ]
        for kernel, inputs in steps:
            wp.launch(kernel, len(query.pairs), [*found, *inputs], device=self.device)
        if nearest is not None:
            query.forget()
        elif self.output == "pairs":
            self.hit.zero_()  # later stages are asked, too
            pairs = query.pairs.numpy()[: query.pair_count.numpy()[0]]
            for hits in (query.hits, query.near):
                if hits is not None:
                    self.found.append(pairs[hits.any_hit.numpy()[: len(pairs)] != 0])

    def make_room(self) -> bool:
        """Make room for the demand of the last launch; return whether there was too little. Waits for the device."""
        (pairs, uncertain), rooms, wanted = self.demand.numpy().tolist(), self.query.rooms, {}
        if pairs > rooms.pairs:
            wanted["pairs"] = pairs + pairs // 4
        if 0 < rooms.uncertain < uncertain:
            wanted["uncertain"] = 2 * uncertain
        if wanted:
            self.query.make_room(**wanted)
        return bool(wanted)

    def check(self):
        """Raise where the last launch lost anything, after making room for the next. Waits for the device.

        Raises:
            CapacityError: A buffer overflowed; a graph is to be captured again.
            RuntimeError: There was no whole launch, see `Query.result`.
        """
        guard = self.query.guard
        guard.check(guard.outcome())
        pairs, uncertain = self.demand.numpy().tolist()
        if self.make_room():
            raise CapacityError(f"{pairs} pairs of objects, {uncertain} uncertain ones of faces; launch again")

    def ask(self, rows: wp.array, beyond: float = np.inf) -> np.ndarray | list:
        """Return the answers of configurations, device rows (c, n), see `Robot.check`. Waits for the device."""
        self.take_poses()
        self.most = beyond
        names = np.array(self._names() if self.nearest else [""])
        nearest, listed = np.dtype([*NEAREST_ROWS.descr, ("names", names.dtype, 2)]), []
        answers = np.empty(len(rows), nearest if self.output == "distance" else bool)
        for start in range(0, len(rows), self.room):
            count = min(self.room, len(rows) - start)
            self._run(rows, start, count)
            part = answers[start : start + count]
            if self.output == "pairs":
                listed += self._list_pairs(count)
                continue
            if self.output == "any":
                part[:] = self.hit[:count].numpy() != 0
                continue
            for name in ("distance", "points", "faces", "pair"):
                part[name] = getattr(self.nearest, name)[:count].numpy()
            part["pair"] = np.where(part["pair"] < 0, -1, self._number(part["pair"]))
            part["names"] = names[part["pair"]]
        return listed if self.output == "pairs" else answers

    def _number(self, objects) -> np.ndarray:
        """Return objects as indices of models of the robot, and what surrounds it after these."""
        return np.where(objects < self.around, objects + self._models, (objects - self.around) % self._models)

    def _list_pairs(self, count) -> list[list[tuple[str, str]]]:
        """Return the pairs of names that intersect at each of the configurations of the last launch."""
        pairs, names = np.concatenate(self.found), self._names()
        rows: list[set] = [set() for _ in range(count)]
        places = (pairs[:, 0] - self.around) // self._models
        for place, (a, b) in zip(places.tolist(), np.sort(self._number(pairs)).tolist()):
            rows[place].add((names[a], names[b]))
        return [sorted(row) for row in rows]

    def _run(self, rows, first, count):
        self.active = count
        self.chunk.count.fill_(count)
        width = self.configurations.shape[1]
        wp.copy(self.configurations, rows, src_offset=first * width, count=count * width)
        self.launch()
        while self.make_room():
            self.launch()

    def ask_spread(self, middles, halves, sizes) -> tuple[np.ndarray, np.ndarray]:
        """Return which configurations meet, and which are not proved apart for all that joint values may differ by.

        Args:
            middles, halves, sizes: Configurations, what values may differ by, and their greatest magnitude, (c, n).
        """
        hit, near = np.empty(len(middles), bool), np.empty(len(middles), bool)
        for start in range(0, len(middles), self.room):
            part = slice(start, start + self.room)
            for target, values in ((self.chunk.half, halves[part]), (self.chunk.size, sizes[part])):
                wp.copy(target, wp.array(values, dtype=wp.float64, device=self.device), count=values.size)
            count = len(middles[part])
            self._run(wp.array(middles[part], dtype=wp.float64, device=self.device), 0, count)
            hit[part], near[part] = self.hit[:count].numpy() != 0, self.chunk.near[:count].numpy() != 0
        return hit, near


def check_edges(query: RobotQuery, starts, ends, tolerance: float) -> np.ndarray:
    """Return the rows of `Robot.check_edges`. Waits for the device, about twice a halving."""
    query.take_poses()
    rows = np.empty(len(starts), CONTACT_ROWS)
    for first in range(0, len(starts), EDGES_AT_ONCE):
        part = slice(first, first + EDGES_AT_ONCE)
        rows[part] = _halve(query, starts[part], ends[part], tolerance)
    return rows


def _halve(query: RobotQuery, starts, ends, tolerance) -> np.ndarray:
    """Halve the stretches of edges until each is proved free, or the first contact is known within the tolerance.

    A stretch k of a level is from k / 2^level to (k + 1) / 2^level, which float64 holds exactly. An edge keeps the
    answer of the level that decides it, whatever levels the others go on to.
    """
    count, rows = len(starts), np.zeros(len(starts), CONTACT_ROWS)
    sizes, motion = np.maximum(np.abs(starts), np.abs(ends)), ends - starts
    # Ends first: stretches are looked at in their middles alone. `met` is a time at which parts intersect.
    still = np.zeros_like(motion)
    met = np.where(query.ask_spread(ends, still, sizes)[0], 1.0, np.inf)
    met[query.ask_spread(starts, still, sizes)[0]] = 0.0
    first = np.minimum(met, 1.0)  # start of the first stretch that is not proved free
    edge = np.flatnonzero((met > 0.0) & motion.any(1))  # what rests is as it starts
    place, width = np.zeros(len(edge)), 1.0
    while len(edge):
        middle = (place + 0.5) * width
        half = 0.5 * width * np.abs(motion[edge]) * (1 + 2.0**-50)
        hit, near = query.ask_spread(starts[edge] + middle[:, None] * motion[edge], half, sizes[edge])
        np.minimum.at(met, edge[hit], middle[hit])
        first[edge] = np.minimum(met[edge], 1.0)
        is_open = (hit | near) & (place * width < met[edge])
        edge, place = edge[is_open], place[is_open]
        np.minimum.at(first, edge, place * width)
        open_count, close = np.bincount(edge, minlength=count), met - first <= tolerance
        given_up = (open_count > STRETCHES_MAX) | ((open_count > 0) & (width <= WIDTH_LEAST))
        rows["undecided"] |= given_up & ~close
        goes_on = ~(given_up | close)[edge]
        edge, place = edge[goes_on], place[goes_on]
        edge, place, width = np.repeat(edge, 2), (2 * place[:, None] + [0.0, 1.0]).ravel(), 0.5 * width
    rows["time"] = first
    rows["clear"] = ~rows["undecided"] & np.isinf(met)
    return rows
