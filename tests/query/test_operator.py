"""Operators of stages: a stage of one's own, room that grows, and graphs of scenes that change."""

import numpy as np
import pytest
import warp as wp
from helpers import refused
from helpers.faults import MORE_PAIRS, add_objects, check_buffer_lengths
from helpers.samples import random_poses, sample
from helpers.scenes import scene_with

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.query.operator import Operator
from warp_abtree.query.stage import Array, Stage
from warp_abtree.query.stages.faces import FaceQuery, PairPose, Trees
from warp_abtree.query.stages.inside import InsideStage
from warp_abtree.query.stages.intersect import IntersectStage


@wp.kernel
def count_per_object_kernel(
    pair_count: wp.array[int], pairs: wp.array[wp.vec2i], hits: wp.array[int], count: wp.array[int]
):
    p = wp.tid()
    if p < pair_count[0] and hits[p] != 0:
        wp.atomic_add(count, pairs[p][0], 1)
        wp.atomic_add(count, pairs[p][1], 1)


@wp.struct
class Nothing:
    none: wp.int32


@wp.func
def visit_nothing(pair: wp.int32, faces: wp.vec2i, trees: Trees, pose: PairPose, own: Nothing):
    return False


class TouchingStage(Stage):
    """Count the pairs that each object intersects in, for each of a pair's room a place that says so."""

    def arrays(self, rooms):
        count = Array(self, "count", wp.int32, self.operator.batch.object_count, 0)
        return [count, Array(self, "place", wp.float64, (rooms.pairs, 3), 7.0)]

    def link(self):
        self.linked = self.place

    def report(self, count):
        operator = self.operator
        self.count.zero_()
        inputs = [operator.pair_count, operator.pairs, operator.hits.any_hit, self.count]
        operator.launch_kernel(count_per_object_kernel, operator.rooms.pairs, inputs)

    def read(self, found, device, with_rows):
        found.points = self.count.numpy()


@pytest.mark.parametrize("scene", [None, "cpu", ab.Scene])
@pytest.mark.parametrize(
    "make",
    [
        *(ab.Query, ab.ContactQuery, ab.ManifoldQuery, ab.DistanceQuery),
        lambda scene: ab.FirstContactQuery(scene, None),
        lambda scene: FaceQuery(scene, visit_nothing, Nothing()),
    ],
)
def test_refuses_what_is_no_scene(make, scene):
    refused(TypeError, f"scene: a Scene or Batch is expected, not a {type(scene).__name__}$", make, scene)


@pytest.mark.parametrize("pairs", [None, MORE_PAIRS])
def test_a_stage_of_ones_own(device, pairs):
    """It is launched after the search, again where room for pairs was lacking, and captured with the rest."""
    scene = add_objects(device)
    query = Operator(scene, [IntersectStage(), InsideStage(), TouchingStage()], pairs, ab.Buffers(pairs=1))
    assert pairs is None or query.rooms.pairs == len(pairs)
    result = query.run()
    touching = np.bincount(result.pairs[result.any].ravel(), minlength=scene.object_count)
    assert result.any.sum() == scene.intersect(pairs).any.sum() > 0
    np.testing.assert_array_equal(result.points, touching)
    (stage,) = query.stages[2:]
    assert stage.linked is stage.place and stage.place.shape == (query.rooms.pairs, 3)
    assert (stage.place.numpy() == 7).all()
    check_buffer_lengths([query])
    with wp.ScopedCapture(device) as capture:
        query.launch()
    stage.count.zero_()
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(query.result().points, touching)


def test_a_captured_query_of_solids_follows_lods(device):
    """Room for the components of solids is no reason to point objects at states anew, which a graph would not see."""
    rng, scene = np.random.default_rng(3), ab.Scene(device)
    for i in range(12):
        scene.add(sample("torus" if i % 2 else "small ball"), random_poses(rng, 1, 0.5)[0], solid=i % 2 == 1)
    most = np.array([scene.models[m].lod_max for m in scene.object_model])
    pairs = np.array([(i, j) for i in range(12) for j in range(i)])
    query = ab.Query(scene, "count", pairs=pairs)
    query.run()
    scene.set_lods(rng.integers(0, most + 1))
    query.run()
    with wp.ScopedCapture(device) as capture:
        query.launch()
    for fraction in (0.5, 0.2, 0.0):
        scene.set_lods((fraction * most).astype(int))
        wp.capture_launch(capture.graph)
        found, fresh = query.result(), ab.Query(scene, "count", pairs=pairs).run()
        np.testing.assert_array_equal(found.count, fresh.count)
        np.testing.assert_array_equal(found.any, fresh.any)


def test_distances_after_more_tree_states_than_there_was_room_for(device, monkeypatch):
    """Slabs are made anew, not read from memory that nothing has written; in the regimes of threads and of warps."""

    def dirty(shape, dtype=float, **options):
        array = empty(shape, dtype=dtype, **options)
        if dtype is wp.vec4:
            array.fill_(wp.vec4(1.0, 0.0, 0.0, -9.0))
        return array

    empty, most = wp.empty, sample("ball").lod_max
    for regime in ({}, {"warps": True}):
        scene = scene_with(device, *[(sample("ball"), (2.2 * i, 0.3 * i, 0.2 * i, 0, 0, 0, 1)) for i in range(4)])
        with testing.regime(**regime), monkeypatch.context() as patch:
            query = ab.DistanceQuery(scene, [(0, 1), (1, 2), (2, 3)] * 12)
            query.run()
            query.run()
            patch.setattr(wp, "empty", dirty)
            for lods in ([most, most // 2, most, most], [most // 3, most // 2, most, most // 5]):
                scene.set_lods(lods)
                query.forget()
                found, fresh = query.run(), ab.DistanceQuery(scene, query.given).run()
                np.testing.assert_array_equal(found.distance, fresh.distance)
                np.testing.assert_array_equal(found.bracket, fresh.bracket)


def test_room_keeps_given_pairs(device):
    scene = add_objects(device)
    query = ab.ContactQuery(scene, MORE_PAIRS, gap=0.05)
    expected = query.run()
    query.make_room(pairs=3 * len(MORE_PAIRS), hits=4 * len(expected.contacts))
    found = query.run()
    assert found.pairs.tolist() == MORE_PAIRS.tolist() and found.contacts.tobytes() == expected.contacts.tobytes()


def test_first_contacts_after_a_filter(device):
    scene = add_objects(device)
    ends = np.tile([0.0, 0, 0, 0, 0, 0, 1], (4, 1))
    first = scene.first_contact(None, ends)
    scene.filter(first.pairs[:1])
    again = scene.first_contact(None, ends)
    assert again.pairs.tolist() == first.pairs[1:].tolist() and again.time.tolist() == first.time[1:].tolist()
