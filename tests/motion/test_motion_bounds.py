"""Bounds of `kernels.motion`, each by itself: what they cover, in longer numbers, is within them.

Those of `path` and `node_pair`, and of `linear` for straight ways. Beside each, that it is needed: without it, the test
fails. docs/exactness.md lists which test holds which bound.
"""

import numpy as np
import pytest
import warp as wp
from helpers.motions import FAMILIES, random_boxes, skewed_boxes
from helpers.questions import launch
from helpers.samples import model_of_faces
from helpers.scenes import scene_with
from oracles.path import HAS_LONG, LONG, apply, frames_at, invert, move, seen_from, shortest_turns
from scipy.spatial.transform import Rotation

import warp_abtree as ab
from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ObjectPool, Trees
from warp_abtree.kernels.base.nodes import load_node
from warp_abtree.kernels.base.poses import place_trees
from warp_abtree.kernels.motion import linear
from warp_abtree.kernels.motion.node_pair import MovingBox, box_motion, move_box
from warp_abtree.kernels.motion.path import (
    Moment,
    Motion,
    Path,
    bound_motion,
    pair_skew,
    place_motion,
    prepare_path_kernel,
    reverse_moment,
    start_motion,
)

pytestmark = pytest.mark.skipif(not HAS_LONG, reason="no floating-point numbers longer than float64")
COUNT = 24


@wp.struct
class Seen:
    """A motion, and what is known of it at a time."""

    motion: Motion
    b_in_a: Moment
    a_in_b: Moment
    box_a: MovingBox  # the root's
    box_b: MovingBox


@wp.kernel(module="unique", module_options=native.options())
def see_kernel(
    paths: wp.array(dtype=Path), trees: Trees, times: wp.array(dtype=wp.float64), seen_out: wp.array(dtype=Seen)
):
    i = wp.tid()
    a, b = 2 * i, 2 * i + 1
    pose = place_trees(trees, trees.objects.state[a], trees.objects.state[b], wp.float64(0.0))
    seen = Seen()
    motion = start_motion(paths, trees, wp.vec2i(a, b))
    seen.motion = bound_motion(motion, trees.states, pose, pair_skew(trees.objects, a, motion.first))
    seen.b_in_a = place_motion(seen.motion, times[i])
    seen.a_in_b = reverse_moment(seen.b_in_a)
    boxes = box_motion(seen.motion, seen.b_in_a)
    home, spin = wp.transpose(boxes.rotation), wp.transpose(boxes.spin)
    root_a, root_b = load_node(trees.states, pose.node_a + 1), load_node(trees.states, pose.node_b + 1)
    seen.box_a = move_box(root_a, seen.motion, home, boxes.back, spin, boxes.back_speed)
    seen.box_b = move_box(root_b, seen.motion, boxes.rotation, boxes.shift, boxes.spin, boxes.speed)
    seen_out[i] = seen


class Case:
    """Pairs of boxes that move, what kernels say of them at random times, and the truth.

    Args:
        starts, ends: Poses, (2 n, 7) or (2 n, 4, 4).
        turns: Axes and angles; None for those that kernels find.
    """

    def __init__(self, rng, device, models, starts, ends, screw=False, turns=None):
        scene = scene_with(device, *zip(models, starts, strict=True))
        query, count = ab.FirstContactQuery(scene, ends, np.arange(len(models)).reshape(-1, 2)), len(models)
        trees, paths = query.batch.trees, wp.zeros(count, dtype=Path, device=device)
        wp.launch(prepare_path_kernel, count, [screw, trees.objects, query.ends, paths], device=device)
        self.times = rng.uniform(size=count // 2)
        self.seen = launch(see_kernel, device, count // 2, paths, trees, self.times)
        self.motion, made = self.seen["motion"], paths.numpy()
        anchor, start, travel = (made[name] for name in ("anchor", "start", "travel"))
        if not screw:
            start, end = trees.objects.position.numpy().astype(LONG), query.ends.position.numpy().astype(LONG)
            travel = end - start
        self.own_turns = made["axis"], made["angle"]
        self._frames = trees.objects.rotation.numpy(), anchor, start, travel
        boxes = np.array([model.mesh_at(model.lod_max)[0] for model in models])
        self.corners = boxes[0::2], boxes[1::2]
        self.find_truth(turns or self.own_turns)

    def find_truth(self, turns):
        rotation, *places = self._frames
        at = frames_at(rotation, *turns, *places, np.repeat(self.times, 2))
        a, b = ([(m[k::2], c[k::2]) for m, c in at] for k in (0, 1))
        self.b_in_a, self.a_in_b = seen_from(a, b), seen_from(b, a)

    def views(self):
        """Yield (what is seen, its map and what a kernel says: moment, box, bend; the centres) both ways."""
        motion = self.motion
        for points, truth, name, box, own, other in (
            (self.corners[1], self.b_in_a, "b_in_a", "box_b", "centre_b", "centre_a"),
            (self.corners[0], self.a_in_b, "a_in_b", "box_a", "centre_a", "centre_b"),
        ):
            yield points, truth, self.seen[name], self.seen[box], motion["bend_" + name[0]], motion[own], motion[other]

    def boxes(self):
        """Yield what a box is of, (n, 8, 3), with its middle, its width and its margin: of places, and of speeds."""
        for points, (place, speed, _), _, box, _, _, home in self.views():
            at = box["at"]
            yield move((place[0], place[1] - home), points), at["posed_sum"], at["posed_size"], self.motion["margin"]
            yield move(speed, points), box["speed"], box["spread"], self.motion["speed_margin"]


@wp.struct
class StraightView:
    """A motion, and the root boxes at a time along the axes of A's first frame."""

    motion: linear.LinearMotion
    box_a: MovingBox
    box_b: MovingBox


@wp.kernel(module="unique", module_options=native.options())
def straight_kernel(
    ends: ObjectPool, trees: Trees, times: wp.array(dtype=wp.float64), view_out: wp.array(dtype=StraightView)
):
    i = wp.tid()
    t, a, b, o = times[i], 2 * i, 2 * i + 1, wp.vec3()
    pose = place_trees(trees, trees.objects.state[a], trees.objects.state[b], wp.float64(0.0))
    m = linear.start_linear_motion(ends, trees, wp.vec2i(a, b))
    m = linear.bound_linear_motion(m, trees.states, pose, pair_skew(trees.objects, a, m.first))
    speed = (m.way_b * m.centre_b + m.shift_b) - (m.way_a * m.centre_a + m.shift_a)
    shift = ((m.first * m.centre_b + m.offset) - m.centre_a) + t * speed
    at = linear.image_of(wp.identity(n=3, dtype=wp.float64) + t * m.way_a, m.first + t * m.way_b, shift, m.scale)
    way = linear.image_of(m.way_a, m.way_b, speed, m.scale)
    view = StraightView()
    view.motion = m
    view.box_a = move_box(load_node(trees.states, pose.node_a + 1), m, at.a, o, way.a, o)
    view.box_b = move_box(load_node(trees.states, pose.node_b + 1), m, at.b, at.shift, way.b, way.shift)
    view_out[i] = view


def farthest(vectors):
    """Return the longest of the vectors (n, k, 3) of each pair."""
    return np.sqrt((vectors**2).sum(-1)).max(-1).astype(float)


class StraightCase:
    """Pairs of boxes, what kernels say of them, and in A's first frame where corners are, and centres, and their ways.

    Attributes:
        places, ways: Of A's corners and of B's.
        middle, drift: Of A's centre.
    """

    def __init__(self, rng, device, models, starts, ends):
        scene = scene_with(device, *zip(models, starts, strict=True))
        query = ab.FirstContactQuery(scene, ends, np.arange(len(models)).reshape(-1, 2), linear=True)
        self.times, trees = rng.uniform(size=len(models) // 2), query.batch.trees
        self.view = launch(straight_kernel, device, len(self.times), query.ends, trees, self.times)
        self.motion = self.view["motion"]
        points = np.array([[*model.mesh_at(model.lod_max)[0], model.centre] for model in models])
        self.corners = points[0::2, :-1], points[1::2, :-1]
        home = np.repeat(invert(trees.objects.rotation.numpy().astype(LONG)[0::2]), 2, 0)
        origin = np.repeat(trees.objects.position.numpy().astype(LONG)[0::2], 2, 0)
        first, last = (
            apply(home, apply(pool.rotation.numpy(), points) + (pool.position.numpy() - origin)[:, None])
            for pool in (trees.objects, query.ends)
        )
        way = last - first
        now = first + np.repeat(self.times, 2).astype(LONG)[:, None, None] * way
        (self.places, self.ways), (self.middle, self.drift) = (
            [(x[0::2, part], x[1::2, part]) for x in (now, way)] for part in (slice(-1), slice(-1, None))
        )
        self.middle, self.drift = self.middle[0], self.drift[0]

    def errors(self):
        """Return how far the corners of each pair are off, and their ways, as the kernels place them, the farthest."""
        motion, t = self.motion, self.times.astype(LONG)[:, None, None]
        ways = [apply(motion[f"way_{x}"], c) + motion[f"shift_{x}"][:, None] for x, c in zip("ab", self.corners)]
        starts = self.corners[0], apply(motion["first"], self.corners[1]) + motion["offset"][:, None]
        for true, said in zip((self.places, self.ways), ([s + t * way for s, way in zip(starts, ways)], ways)):
            far = [farthest(x - y) for x, y in zip(true, said)]
            yield far[0] + far[1]

    def boxes(self):
        """Yield what a box is of, (n, 8, 3), with its middle, its width and its margin: of places, and of speeds."""
        for k, box in enumerate((self.view["box_a"], self.view["box_b"])):
            yield self.places[k] - self.middle, box["at"]["posed_sum"], box["at"]["posed_size"], self.motion["margin"]
            yield self.ways[k] - self.drift, box["speed"], box["spread"], self.motion["speed_margin"]


def family(rng, device, name, screw=False):
    models, starts, ends = random_boxes(rng, COUNT, name)
    return Case(rng, device, models, starts, ends, screw, shortest_turns(starts[:, 3:], ends[:, 3:]))


def errors_of(case):
    """Return how far points are off, and speeds, and what motions allow for either; the way B is seen, and A."""
    for points, truth, found, *_ in case.views():
        maps = (found["rotation"], found["shift"]), (found["spin"], found["speed"])
        far = [farthest(move(true, points) - move(said, points)) for true, said in zip(truth, maps)]
        yield *far, case.motion["slack"], case.motion["speed_slack"]


@pytest.mark.parametrize("screw", [False, True], ids=["straight", "screw"])
@pytest.mark.parametrize("name", FAMILIES)
def test_slacks_of_faces_cover_the_rounding_of_paths(device, name, screw):
    """Half of the slack of points is for those, half for what rounding of a slow turn adds to speeds.

    Accelerations are bounded, too.
    """
    case = family(np.random.default_rng(1), device, name, screw)
    for points, (_, _, bend), _, _, most, *_ in case.views():
        assert (2 * case.motion["scale"] * farthest(move(bend, points)) <= most).all()
    for off, _, slack, _ in errors_of(case):
        assert (off <= 0.5 * slack).all() and (off > 0).any()
    case.find_truth(case.own_turns)
    for _, off, _, speed_slack in errors_of(case):
        assert (off <= speed_slack).all() and (off > 0).any()


@pytest.mark.parametrize("kind", ["random", "opposite", "second"])
def test_slacks_of_faces_cover_matrices_that_are_not_quite_rotations(device, kind):
    """Up to what poses may be off, and where one object's are off the other way."""
    rng = np.random.default_rng(2)
    case = Case(rng, device, *skewed_boxes(rng, COUNT, kind))
    errors = list(errors_of(case))
    for off, speed_off, slack, speed_slack in errors:
        assert (off <= 0.5 * slack).all() and (speed_off <= speed_slack).all()
    assert max(off.max() for off, *_ in errors) > 1e-8


@pytest.mark.parametrize("name", [*FAMILIES, "random", "opposite"])
def test_slacks_of_straight_ways_cover_rounding(device, name):
    """Of matrices, too, that are not quite rotations."""
    rng = np.random.default_rng(1)
    boxes = random_boxes(rng, COUNT, name) if name in FAMILIES else skewed_boxes(rng, COUNT, name)
    case = StraightCase(rng, device, *boxes)
    for off in case.errors():
        assert (off <= case.motion["slack"]).all() and (off > 0).any()
    assert name in FAMILIES or off.max() > 1e-8


@pytest.mark.parametrize("straight", [False, True], ids=["rigid", "straight"])
@pytest.mark.parametrize("name", FAMILIES)
def test_margins_of_boxes_cover_float32(device, name, straight):
    """Posed boxes hold all that they should, and speeds of boxes all speeds; no narrower ones do."""
    rng = np.random.default_rng(3)
    case = StraightCase(rng, device, *random_boxes(rng, COUNT, name)) if straight else family(rng, device, name)
    scale = 2 * case.motion["scale"].astype(LONG)[:, None]
    for true, middle, width, margin in case.boxes():
        low, high = scale * true.min(1), scale * true.max(1)
        left = np.minimum(low - (middle - width.astype(float)), (middle + width.astype(float)) - high)
        assert (left >= 0).all()
        assert (left.min(1) < 2 * margin).any(), "without the margin it is too narrow"


def plates(rng, way, turns):
    """Return models of flat triangles about their frames' origins, far corners on the x axis, and poses.

    All turn about z; the second of each pair moves along y.
    """
    models, poses = [], []
    for k in range(2 * COUNT):
        x, y = rng.uniform(0.5, 1.5, 2)
        models.append(model_of_faces([[x, y, 0], [-0.1, y, 0], [x, -0.1, 0]]))
        angle, place = turns[k % 2] * rng.uniform(0.5, 1), k % 2 * np.array([rng.uniform(1, 2), 0, 0])
        for t in (0, 1):
            turned = Rotation.from_euler("z", t * angle - np.arctan2(y, x) + np.pi * (k % 2 == 0))
            poses.append([*(place + t * (k % 2) * np.array([0, way, 0])), *turned.as_quat()])
    poses = np.array(poses)
    return models, poses[0::2], poses[1::2]


@pytest.mark.parametrize(
    ("way", "turns", "seen"),
    [(1.0, (0.0, 2.0), 0), (0.0, (2.0, 0.0), 0), (0.0, (-1.5, 1.5), 0), (50.0, (0.01, 0.0), 0), (0.0, (0.0, 2.0), 1)],
    ids=["the mover turns", "the base turns", "both do", "the base turns under a way", "seen from what turns"],
)
def test_no_term_of_accelerations_is_too_large(device, way, turns, seen):
    """Where they are all there is: a smaller one would not do, nor one without what rounding adds."""
    rng = np.random.default_rng(5)
    models, starts, ends = plates(rng, way, turns)
    case = Case(rng, device, models, starts, ends)
    case.times = np.zeros(COUNT)
    case.find_truth(case.own_turns)
    points, (_, _, bend), _, _, most, *_ = list(case.views())[seen]
    ratio = 2 * case.motion["scale"] * farthest(move(bend, points)) / most
    assert ratio.max() <= 1
    assert ratio.max() > (1 - 2.0**-15 if way in (0, 1) else 0.99)


@pytest.mark.parametrize("path", [{}, {"screw": True}, {"linear": True}], ids=["straight", "screw", "linear"])
@pytest.mark.parametrize("name", ["plain", "far from their frames"])
def test_swept_boxes_hold_objects_all_the_way(device, name, path):
    rng = np.random.default_rng(6)
    models, starts, ends = random_boxes(rng, COUNT, name)
    worlds = [{"world": k} for k in range(len(models))]
    scene = scene_with(device, *zip(models, starts, worlds, strict=True))
    query = ab.FirstContactQuery(scene, ends, **path)
    query.run()
    lower, upper = (rows.numpy() for rows in (query.broad_phase.lower, query.broad_phase.upper))
    turns, still = shortest_turns(starts[:, 3:], ends[:, 3:]), np.zeros((2 * COUNT, 3))
    pool, corners = query.batch.objects.pool, np.array([model.mesh_at(model.lod_max)[0] for model in models])
    start, way = pool.position.numpy(), query.ends.position.numpy().astype(LONG) - pool.position.numpy()
    if path.get("screw"):
        anchor, start, way = screw_of(pool.rotation.numpy(), *turns, start, way)
    for t in np.linspace(0, 1, 33):
        if path.get("linear"):
            pools = pool, query.ends
            first, last = (apply(p.rotation.numpy(), corners) + p.position.numpy().astype(LONG)[:, None] for p in pools)
            points = (1 - t) * first + t * last
        else:
            anchors, times = anchor if path.get("screw") else still, np.full(2 * COUNT, t)
            points = move(frames_at(pool.rotation.numpy(), *turns, anchors, start, way, times)[0], corners)
        assert (lower <= points.min(1)).all() and (points.max(1) <= upper).all(), t


def screw_of(rotation, axis, angle, start, way):
    """Return anchors in the model frame, where they start, and their ways; turns of less than 2^-19 are straight."""
    k = np.einsum("nij,nj->ni", rotation.astype(LONG), axis)
    along = (way * k).sum(1, keepdims=True) * k
    side, half = way - along, angle[:, None] / 2
    turns = np.sin(half) > 2.0**-20
    half = np.where(turns, half, 1)
    anchor = np.where(turns, (side + np.cross(k, side) * np.cos(half) / np.sin(half)) / 2, 0)
    return np.einsum("nji,nj->ni", rotation.astype(LONG), anchor), start + anchor, np.where(turns, along, way)
