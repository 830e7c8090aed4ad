"""Queries about the parts of a robot at a chunk of configurations, among themselves and with what surrounds them."""

from itertools import product
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import finite_array, whole_number
from warp_abtree.checks.device_memory import DeviceMemory
from warp_abtree.checks.upload import struct_of, zeros_of
from warp_abtree.interop.robot.surroundings import make_batch
from warp_abtree.kernels.intersect.broad_phase import PosedBounds, pose_box_kernel
from warp_abtree.kernels.robot import answers, forward, link_pairs
from warp_abtree.kernels.robot.link_pairs import ASK_ANY, ASK_DISTANCE, ASK_PADDED, ASK_WITHIN
from warp_abtree.query.request import Buffers
from warp_abtree.query.stages.distance import DistanceQuery
from warp_abtree.query.stages.intersect import Query
from warp_abtree.state.batch import check_pairs

PAIRS_GUESS = 2  # of a configuration and stage
NO_PAIRS = np.zeros((0, 2), np.int32)


def padding_of(robot) -> np.ndarray:
    """Return the padding of each model of a robot, float64 (m,).

    Raises:
        TypeError, ValueError: `link_padding` is no dict, names no link, or has a value that is no finite distance.
    """
    given = robot.link_padding
    if not isinstance(given, dict):
        raise TypeError(f"link_padding: a {type(given).__name__} is no dict of distances by the names of links")
    for name, value in given.items():
        if name not in robot.link_names:
            raise ValueError(f"link_padding: the robot has no link {name!r}")
        if finite_array(value, f"link_padding of {name!r}", ()) < 0:
            raise ValueError(f"link_padding of {name!r}: {value} is below 0")
    return np.array([float(given.get(robot.link_names[k], 0.0)) for k in robot.model_link])


def tested_pairs(robot) -> np.ndarray:
    """Return the pairs of models that a robot tests against one another, checked."""
    return check_pairs(robot.pairs, len(robot.models), owner="the robot", kind="models")


def order_parts(robot, meets, padding) -> tuple[link_pairs.Parts, list[tuple[int, int]]]:
    """Return parts with the entries of what is asked, those of the outermost first, and the stages of entries.

    A stage (first, end) are the entries of a part, asked at once.
    """
    description, models = robot.description, robot.models
    frame = [description.links[robot.link_names[k]] for k in robot.model_link]
    paths = [description.path(f) for f in frame]
    entries, stages, pairs = [], [], tested_pairs(robot)
    mounted = {whole_number(k, "mounted", 0, len(robot.link_names) - 1) for k in robot.mounted}
    for k in sorted(range(len(frame)), key=lambda k: -len(paths[k])):
        first = len(entries)
        if len(meets) and robot.model_link[k] not in mounted:
            entries.append((k, -1, -1))
        for i, j in pairs[pairs[:, 1] == k].tolist():
            entries.append((j, i, max(set(paths[i]) & set(paths[j]), default=-1)))
        if len(entries) > first:
            stages.append((first, len(entries)))
    middles = [model.centre for model in models]
    vertices = [model.progressive.vertex_pos[: model.progressive.vertex_count] for model in models]
    parts = struct_of(
        link_pairs.Parts,
        robot.device,
        **dict(zip(("first", "second", "shared"), np.array(entries, np.int32).reshape(-1, 3).T)),
        meets=meets.astype(np.uint8),
        frame=frame,
        depth=[len(path) for path in paths],
        middle=middles,
        padding=padding * (1 + 2.0**-50),
        radius=[np.sqrt(((v - m) ** 2).sum(1).max()) * (1 + 2.0**-40) for v, m in zip(vertices, middles)],
    )
    return parts, stages or [(0, 0)]  # a launch is one even where there is nothing to ask


class LinkQuery(DeviceMemory):
    """A query given no pairs: a launch poses the parts, writes the pairs of each stage, a part first, and asks it.

    Stages that a configuration needs no more are empty. The output is "any", "distance"; "within", which tells of what
    does not meet whether it is proved apart by a reach; or "pairs", read by the host after each stage, so that no graph
    captures it. Parts that are padded meet where they are not proved apart by their paddings, which is asked first;
    distances are those of the parts as they are.

    Attributes:
        around: Objects of the surroundings, which come first in the batch.
        active: Configurations that are posed, the room by default.
        demand: Pairs of a stage at most, and face pairs that waited, device int32 (2,).
        found: Of "pairs", pairs of objects that meet, a part first, arrays (k, 2).
        most: Of "distance", what is farther apart is infinitely far.
    """

    def __init__(self, robot, around, output: str, room: int):
        self.device, self.output, self.room, self.active = robot.device, output, room, room
        self.batch, meets = make_batch(around, robot.models, room, robot.device)
        self.around = len(meets)
        self.chain = robot.description.make_chain(self.device)
        padding = padding_of(robot)
        self.parts, self.stages = order_parts(robot, meets, padding)
        device, batch, rows = self.device, self.batch, (room, len(self.chain.lower))
        buffers, is_within = Buffers(pairs=max(1, PAIRS_GUESS * room)), output == "within"
        self.found, self.most, self.nearest = [], np.inf, None
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
        self.chunk = link_pairs.Chunk()
        sizes: dict[str, Any] = dict(count=1, half=spread, size=spread, hit=room, near=near, best=most)
        for name, shape in sizes.items():
            setattr(self.chunk, name, wp.zeros(shape, dtype=link_pairs.Chunk.vars[name].type.dtype, device=device))
        self.chunk.count.fill_(room)
        self._padded = link_pairs.Chunk()  # where what is near meets
        for name in sizes:
            setattr(self._padded, name, getattr(self.chunk, "hit" if name == "near" else name))
        self.hit, self.configurations = self.chunk.hit, wp.zeros(rows, dtype=wp.float64, device=device)
        self.demand = wp.zeros(2, dtype=wp.int32, device=device)
        self._boxes, self._bounds, count = link_pairs.LinkBoxes(), PosedBounds(), self.around
        for name in ("lower", "upper"):
            corners = wp.zeros(batch.object_count, dtype=wp.vec3, device=device)
            setattr(self._boxes, name, corners)
            setattr(self._bounds, name, corners)
        self._bounds.pair_count = wp.zeros(1, dtype=wp.int32, device=device)
        self._bvh = wp.Bvh(self._boxes.lower[:count], self._boxes.upper[:count]) if count else None
        self._boxes.bvh = wp.uint64(0) if self._bvh is None else self._bvh.id

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
