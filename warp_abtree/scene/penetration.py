"""Penetration along directions: the way to the outermost contact, by first contact of an object brought in from afar.

Along a direction d the second object of a pair starts beyond the first, where their boxes are apart, and moves straight
back to its pose. First contacts are never late, so the rest of the way is never too short: moved by depth d, or farther
along d, the surfaces do not interpenetrate. It is too long by at most `tolerance` of the way, which is as long as both
boxes are along d; by more where `FirstContactQuery` leaves a pair undecided. That holds for motions as real numbers; a
pose that is moved so rounds.

The least depth over the directions bounds the translational penetration depth of the pair from above. Directions are
those given, or both ways along the mean normal of the contacts and the axes of the smaller object's box, of equal ones
that with the higher index, and the axes, edge and corner diagonals of a cube in the world.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

from warp_abtree.checks.arguments import check_device, to_numpy
from warp_abtree.query.stages.intersect import Query
from warp_abtree.query.stages.motion import FirstContactQuery, check_time_tolerance
from warp_abtree.state.arrays import ObjectArrays
from warp_abtree.state.batch import Batch

# Pairs times directions of a launch: enough to fill a GPU, few enough that more pairs need no more memory.
APPROACHES = 65536
# What starts are farther away than boxes reach, as a part of their sizes.
START_MARGIN = 2.0**-10
# Of lengths and positions in float64, each rounded a few times.
POSITION_ROUNDING = 2.0**-50
# Axes, edge and corner diagonals of a cube.
CUBE_DIRECTIONS = np.array([d for d in product((1, 0, -1), repeat=3) if any(d)], np.float64)
DEFAULT_COUNT = 2 + 6 + len(CUBE_DIRECTIONS)


@dataclass(frozen=True)
class Penetration:
    """Least ways out of object pairs; its arrays are on the host.

    Attributes:
        pairs: Object pairs, int32 (p, 2).
        depth: How far the second object has to move along `direction` to come free [world units], float64 (p,); 0
            where the pair does not intersect.
        direction: Unit vectors [world axes], float64 (p, 3); where the pair does not intersect, its first direction,
            of the default ones that from box to box.
    """

    pairs: np.ndarray
    depth: np.ndarray
    direction: np.ndarray


def check_directions(directions) -> np.ndarray:
    """Return directions (m, 3) or (p, m, 3) as unit vectors, float64 (1, m, 3) or (p, m, 3); refuse what is none."""
    given = to_numpy(directions, "directions")
    if given.ndim not in (2, 3) or given.shape[-1] != 3 or not given.shape[-2]:
        raise ValueError(
            f"directions: shape {given.shape} and type {given.dtype}, not numbers of shape (m, 3) or (p, m, 3), m > 0"
        )
    given = given.astype(np.float64).reshape(-1, *given.shape[-2:])
    most = np.abs(given).max(2, keepdims=True)
    bad = np.argwhere(~(np.isfinite(most[..., 0]) & (most[..., 0] > 0)))
    if len(bad):
        pair, k = bad[0].tolist()
        of_pair = f" of pair {pair}" if len(given) > 1 else ""
        raise ValueError(f"directions: direction {k}{of_pair} is {given[pair, k].tolist()}, of no finite length over 0")
    return _unit(given / most)


def _unit(vectors) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


class _PosedBoxes:
    """Root boxes of a batch's objects, in the frames of these, and the poses."""

    def __init__(self, batch: Batch):
        batch.catch_up()
        pool, state, states = batch.objects.pool, batch.objects.state, batch.states
        self.rotation, self.position = pool.rotation.numpy(), pool.position.numpy()
        box = np.zeros((len(states.slots), 2, 3))
        for i in np.unique(state):
            box[i] = [corners[1] for corners in states.read_nodes(states.slots[i], 2)[:2]]
        self.half = (box[:, 1] - box[:, 0])[state] / 2
        middle = batch.models.pool.centre.numpy()[batch.object_model] + box.mean(1)[state]
        self.centre = np.einsum("nij,nj->ni", self.rotation, middle) + self.position
        self.size = np.linalg.norm(self.half, axis=1)

    def reach(self, objects, directions) -> np.ndarray:
        """Return how far boxes (p,) reach from their centres along directions (p, m, 3)."""
        return np.einsum("pmk,pk->pm", np.abs(directions @ self.rotation[objects]), self.half[objects])

    def default_directions(self, pairs, normals) -> np.ndarray:
        """Return both ways along mean normals and the axes of the smaller objects, and those of a cube, (p, 34, 3)."""
        lower, higher = pairs.min(1), pairs.max(1)
        smaller = np.where(self.size[lower] < self.size[higher], lower, higher)
        normals, axes = normals[:, None], self.rotation[smaller].transpose(0, 2, 1)
        cube = np.broadcast_to(CUBE_DIRECTIONS, (len(pairs), *CUBE_DIRECTIONS.shape))
        return _unit(np.concatenate([normals, -normals, axes, -axes, cube], 1))

    def between(self, pairs) -> np.ndarray:
        """Return directions from the first box of each pair to its second, (p, 3); x where they have one centre."""
        way = self.centre[pairs[:, 1]] - self.centre[pairs[:, 0]]
        way[~way.any(1)] = 1, 0, 0
        return _unit(way)


class _Approaches:
    """Second objects of pairs (p, 2), each moved along its pair's directions (p, m, 3); the scene's objects stay."""

    def __init__(self, batch: Batch, boxes: _PosedBoxes, pairs, directions):
        self._batch, self._boxes, self._pairs, self._directions = batch, boxes, pairs, directions
        first, second = pairs.T
        reach = boxes.reach(first, directions) + boxes.reach(second, directions)
        apart = np.einsum("pmk,pk->pm", directions, boxes.centre[first] - boxes.centre[second])
        self.way = apart + reach + START_MARGIN * (boxes.size[first] + boxes.size[second])[:, None]

    def _place(self, asked, shift):
        """Return a batch of the objects of pairs asked (p, m), second ones moved by shifts (k,) along the directions.

        Also its pairs (k, 2), and the positions that its objects have in the scene.
        """
        boxes, (row, k) = self._boxes, np.nonzero(asked)
        still, first = np.unique(self._pairs[row, 0], return_inverse=True)
        placed = np.concatenate([still, self._pairs[row, 1]])
        objects, position = ObjectArrays(0 * placed, 0 * placed, self._batch.device), boxes.position[placed]
        objects.set_states(self._batch.objects.state[placed])
        objects.pool.rotation.assign(boxes.rotation[placed])
        moves = shift[:, None] * self._directions[row, k]
        objects.pool.position.assign(position + np.concatenate([np.zeros((len(still), 3)), moves]))
        own = Batch(self._batch.models, self._batch.states, objects, self._batch.object_model[placed])
        return own, np.stack([first, np.arange(len(still), len(placed))], 1), position

    def meet(self, asked, shift) -> np.ndarray:
        """Return which pairs intersect at shifts (k,) along directions asked (p, m), (k,). Waits for the device."""
        own, pairs, _ = self._place(asked, shift)
        return Query(own, "any", pairs=pairs).run().any

    def find_depths(self, asked, tolerance) -> np.ndarray:
        """Return depths along directions asked (p, m), (k,). Waits for the device."""
        way = self.way[asked]
        own, pairs, position = self._place(asked, way)
        query = FirstContactQuery(own, None, pairs, tolerance=tolerance)
        query.ends.position.assign(position)
        rest = way * (1 - query.run().time)
        return rest + POSITION_ROUNDING * (way + np.abs(position[pairs[:, 1]]).max(1)) * (rest > 0)

    def find_least(self, likely: int, tolerance) -> tuple:
        """Return the least depth of each pair and its direction, (p,) and (p, 3). Waits for the device.

        Where a pair still intersects when it is moved by the least depth known, its outermost contact is as deep. So
        first come the directions along which boxes overlap least, of all and of the first `likely`.
        """
        depths, asked, rows = np.full(self.way.shape, np.inf), np.zeros(self.way.shape, bool), np.arange(len(self.way))
        for some in (self.way, self.way[:, :likely]):
            asked[rows, some.argmin(1)] = True
        depths[asked] = self.find_depths(asked, tolerance)
        left = ~asked
        if left.any():
            left[left] = ~self.meet(left, np.broadcast_to(depths.min(1)[:, None], left.shape)[left])
        if left.any():
            depths[left] = self.find_depths(left, tolerance)
        least = rows, depths.argmin(1)
        return depths[least], self._directions[least]


def find_penetration(scene, pairs, directions, tolerance) -> Penetration:
    """Answer `Scene.penetration`."""
    check_device(scene.device, "Scene.penetration")
    tolerance = check_time_tolerance(tolerance)
    given = None if directions is None else check_directions(directions)
    met = scene.intersect(pairs, "contacts" if given is None else "any")
    pairs, batch = met.pairs, scene.batch()
    if given is not None and len(given) not in (1, len(pairs)):
        raise ValueError(f"directions: those of {len(given)} pairs given for {len(pairs)} pairs")
    boxes = _PosedBoxes(batch)
    if given is None:
        count, likely, direction = DEFAULT_COUNT, 2, boxes.between(pairs)
    else:
        given = np.broadcast_to(given, (len(pairs), *given.shape[1:]))
        count, likely, direction = given.shape[1], given.shape[1], given[:, 0].copy()
    depth, hit, step = np.zeros(len(pairs)), np.flatnonzero(met.any), max(1, APPROACHES // count)
    for start in range(0, len(hit), step):
        part = hit[start : start + step]
        if given is None:
            normals = met.pair_contacts["normal"][part]
            normals = np.where(np.isfinite(normals), normals, direction[part])
            asked = boxes.default_directions(pairs[part], normals)
        else:
            asked = given[part]
        approaches = _Approaches(batch, boxes, pairs[part], asked)
        depth[part], direction[part] = approaches.find_least(likely, tolerance)
    return Penetration(pairs, depth, direction)
