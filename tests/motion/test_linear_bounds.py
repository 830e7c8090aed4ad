"""Bounds of `kernels.motion.linear`, each by itself, as `test_motion_bounds`: what they cover, in longer numbers."""

import numpy as np
import pytest
import warp as wp
from helpers.motions import FAMILIES, random_boxes, skewed_boxes
from helpers.questions import launch
from helpers.scenes import scene_with
from oracles.path import HAS_LONG, LONG, apply, invert

import warp_abtree as ab
from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ObjectPool, Trees
from warp_abtree.kernels.base.nodes import load_node
from warp_abtree.kernels.base.poses import place_trees
from warp_abtree.kernels.motion.linear import (
    LinearMotion,
    bound_linear_motion,
    image_of,
    start_linear_motion,
)
from warp_abtree.kernels.motion.node_pair import MovingBox, move_box
from warp_abtree.kernels.motion.path import pair_skew

pytestmark = pytest.mark.skipif(not HAS_LONG, reason="no floating-point numbers longer than float64")
COUNT = 24


@wp.struct
class View:
    """A motion, and the root boxes at a time along the axes of A's first frame."""

    motion: LinearMotion
    box_a: MovingBox
    box_b: MovingBox


@wp.kernel(module="unique", module_options=native.options())
def view_kernel(ends: ObjectPool, trees: Trees, times: wp.array(dtype=wp.float64), view_out: wp.array(dtype=View)):
    i = wp.tid()
    t, a, b, o = times[i], 2 * i, 2 * i + 1, wp.vec3()
    pose = place_trees(trees, trees.objects.state[a], trees.objects.state[b])
    m = start_linear_motion(ends, trees, wp.vec2i(a, b))
    m = bound_linear_motion(m, trees.states, pose, pair_skew(trees.objects, a, m.first))
    speed = (m.way_b * m.centre_b + m.shift_b) - (m.way_a * m.centre_a + m.shift_a)
    shift = ((m.first * m.centre_b + m.offset) - m.centre_a) + t * speed
    at = image_of(wp.identity(n=3, dtype=wp.float64) + t * m.way_a, m.first + t * m.way_b, shift, m.scale)
    way = image_of(m.way_a, m.way_b, speed, m.scale)
    view = View()
    view.motion = m
    view.box_a = move_box(load_node(trees.states, pose.node_a + 1), m, at.a, o, way.a, o)
    view.box_b = move_box(load_node(trees.states, pose.node_b + 1), m, at.b, at.shift, way.b, way.shift)
    view_out[i] = view


class Case:
    """Pairs of boxes, what kernels say of them, and in A's first frame where corners are, and centres, and their ways.

    Attributes:
        places, ways: Of A's corners and of B's.
        middle, drift: Of A's centre.
    """

    def __init__(self, rng, device, models, starts, ends):
        scene = scene_with(device, *zip(models, starts, strict=True))
        query = ab.FirstContactQuery(scene, ends, np.arange(len(models)).reshape(-1, 2), linear=True)
        self.times, trees = rng.uniform(size=len(models) // 2), query.batch.trees
        self.view = launch(view_kernel, device, len(self.times), query.ends, trees, self.times)
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
        motion, t = self.view["motion"], self.times.astype(LONG)[:, None, None]
        ways = [apply(motion[f"way_{x}"], c) + motion[f"shift_{x}"][:, None] for x, c in zip("ab", self.corners)]
        starts = self.corners[0], apply(motion["first"], self.corners[1]) + motion["offset"][:, None]
        for true, said in zip((self.places, self.ways), ([s + t * way for s, way in zip(starts, ways)], ways)):
            far = [np.sqrt(((x - y) ** 2).sum(-1)).max(-1).astype(float) for x, y in zip(true, said)]
            yield far[0] + far[1]


@pytest.mark.parametrize("name", FAMILIES)
def test_slacks_of_straight_ways_cover_rounding(device, name):
    rng = np.random.default_rng(1)
    case = Case(rng, device, *random_boxes(rng, COUNT, name))
    for off in case.errors():
        assert (off <= case.view["motion"]["slack"]).all() and (off > 0).any()


@pytest.mark.parametrize("kind", ["random", "opposite"])
def test_slacks_of_straight_ways_cover_matrices_that_are_not_quite_rotations(device, kind):
    rng = np.random.default_rng(2)
    case = Case(rng, device, *skewed_boxes(rng, COUNT, kind))
    for off in case.errors():
        assert (off <= case.view["motion"]["slack"]).all()
    assert off.max() > 1e-8


@pytest.mark.parametrize("name", FAMILIES)
def test_margins_of_straight_boxes_cover_float32(device, name):
    """Boxes hold all that they should, and speeds of boxes all speeds; no narrower ones do."""
    rng = np.random.default_rng(3)
    case = Case(rng, device, *random_boxes(rng, COUNT, name))
    motion = case.view["motion"]
    scale = 2 * motion["scale"].astype(LONG)[:, None]
    for k, box in enumerate((case.view["box_a"], case.view["box_b"])):
        for true, middle, width, margin in (
            (case.places[k] - case.middle, box["at"]["posed_sum"], box["at"]["posed_size"], motion["margin"]),
            (case.ways[k] - case.drift, box["speed"], box["spread"], motion["speed_margin"]),
        ):
            low, high = scale * true.min(1), scale * true.max(1)
            left = np.minimum(low - (middle - width.astype(float)), (middle + width.astype(float)) - high)
            assert (left >= 0).all()
            assert (left.min(1) < 2 * margin).any(), "without the margin it is too narrow"
