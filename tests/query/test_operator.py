"""Operators of stages: room that grows, graphs of scenes that change, and stages and questions of one's own.

Of questions the sample stands against brute force in integers; another one is about order and where pairs end.
"""

import runpy

import numpy as np
import pytest
import trimesh
import warp as wp
from conftest import ROOT
from helpers import refused
from helpers.faults import MORE_PAIRS, add_objects, check_buffer_lengths
from helpers.samples import random_poses, random_quaternions, sample
from helpers.scenes import scene_with
from oracles.triangle import into_frame_of_a
from oracles.triangle_distance import near_faces

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.query.operator import Operator
from warp_abtree.query.stage import Array, Stage
from warp_abtree.query.stages.faces import FaceQuery, PairPose, Trees, face_distance
from warp_abtree.query.stages.inside import InsideStage
from warp_abtree.query.stages.intersect import IntersectStage

SCALE = wp.constant(wp.float64(2.0**20))


@wp.struct
class LeastDistance:
    """A distance in units of 2^-20, the same whatever the order of visits."""

    least: wp.array(dtype=wp.int64)


@wp.func
def visit_least(pair: wp.int32, faces: wp.vec2i, trees: Trees, pose: PairPose, own: LeastDistance):
    wp.atomic_min(own.least, pair, wp.int64(face_distance(trees, pose, faces) * SCALE))
    return True


@wp.kernel
def count_per_object_kernel(
    pair_count: wp.array[int], pairs: wp.array[wp.vec2i], hits: wp.array[int], count: wp.array[int]
):
    p = wp.tid()
    if p < pair_count[0] and hits[p] != 0:
        wp.atomic_add(count, pairs[p][0], 1)
        wp.atomic_add(count, pairs[p][1], 1)


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
def test_refuses_what_is_no_scene(scene):
    makers = [ab.Query, ab.ContactQuery, ab.ManifoldQuery, ab.DistanceQuery]
    makers.append(lambda scene: ab.FirstContactQuery(scene, None))
    makers.append(lambda scene: FaceQuery(scene, visit_least, LeastDistance()))
    for make in makers:
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


SAMPLE = ROOT / "scenes" / "06_your_own_query.py"


@pytest.fixture(scope="module")
def sampled():
    return runpy.run_path(str(SAMPLE))


@pytest.fixture
def scene_and_meshes(regime, device):
    """Return a plate and a ball that crosses it, one beside it and one far away, turned."""
    plate = trimesh.creation.box((2.0, 1.0, 0.1)).subdivide()
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.4)
    rng, poses = np.random.default_rng(3), np.zeros((4, 7))
    poses[1:, :3] = (0.1, 0, 0.3), (-0.5, 0.2, 0.5), (0, 0, 3)
    poses[:, 3:] = random_quaternions(rng, 4)
    turn = trimesh.transformations.quaternion_matrix(poses[0, [6, 3, 4, 5]])[:3, :3]
    poses[:, :3] = poses[:, :3] @ turn.T
    models = map(ab.Model.load, (plate, ball, ball, ball))
    return scene_with(device, *zip(models, poses, strict=True)), plate, ball, poses


@pytest.mark.parametrize("distance", [0.0, 0.05, 0.2])
def test_the_sample_equals_brute_force(sampled, scene_and_meshes, distance):
    scene, plate, ball, poses = scene_and_meshes
    truth = np.zeros((3, len(plate.faces)), bool)
    for k in range(3):
        points = into_frame_of_a(ball.vertices, poses[0], poses[k + 1])
        pairs, separations, met = near_faces(plate.triangles, points[ball.faces], distance)
        assert not np.any(np.abs(separations[~met] - distance) < 1e-9), "no matter of rounding"
        truth[k, pairs[met | (separations <= distance), 0]] = True
    assert truth[0].any() and not truth[2].any() and not truth.all()
    found = sampled["near_faces"](scene, len(plate.faces), [(0, 1), (0, 2), (0, 3)], distance)
    np.testing.assert_array_equal(found, truth)


def test_pairs_keep_their_order_and_a_hit_ends_one(sampled, scene_and_meshes):
    """A swapped pair flags its own first object; of pairs within reach for_any visits few faces."""
    scene, plate, ball, _ = scene_and_meshes
    there = sampled["near_faces"](scene, len(plate.faces), [(0, 1)], 0.1)
    back = sampled["near_faces"](scene, len(ball.faces), [(1, 0)], 0.1)
    assert there.shape != back.shape and there.any() and 0 < back.sum() < back.size
    own, distances = LeastDistance(), scene.intersect([(0, 1), (2, 0), (0, 3)], "distance").distance
    own.least = wp.full(3, 2**40, dtype=wp.int64, device=scene.device)
    query = FaceQuery(scene, visit_least, own, [(0, 1), (2, 0), (0, 3)], within=0.6)
    every = query.run()
    np.testing.assert_array_equal(own.least.numpy()[:2], (distances[:2] * 2**20).astype(int))
    assert own.least.numpy()[2] == 2**40 and every.any.tolist() == [True, True, False]
    assert (every.count[:2] == every.triangle_tests[:2]).all() and (every.count[:2] > 100).all()
    first = FaceQuery(scene, visit_least, own, [(0, 1), (2, 0), (0, 3)], within=0.6, for_any=True).run()
    refused(ValueError, "within", FaceQuery, scene, visit_least, own, [(0, 1)], within=-1.0)
    np.testing.assert_array_equal(first.any, every.any)
    assert first.count is None and (first.triangle_tests[:2] < every.triangle_tests[:2]).all()


@wp.func
def visit_less(pair: wp.int32, faces: wp.vec2i):
    return True


@wp.func
def visit_other(pair: wp.int32, faces: wp.vec2i, trees: Trees, pose: wp.int32, own: LeastDistance):
    return True


@wp.func
def visit_without_value(pair: wp.int32, faces: wp.vec2i, trees: Trees, pose: PairPose, own: LeastDistance):
    wp.atomic_min(own.least, pair, wp.int64(0))


@wp.func
def visit_half(pair: wp.int32, faces: wp.vec2i, trees: Trees, pose: PairPose, own: LeastDistance):
    if pair > 0:
        return True


@wp.func
def visit_none(pair: wp.int32, faces: wp.vec2i, trees: Trees, pose: PairPose, own: LeastDistance):
    return None


@wp.func_native("own.least[pair] = 0;")
def visit_native(pair: wp.int32, faces: wp.vec2i, trees: Trees, pose: PairPose, own: LeastDistance): ...


@wp.func
def visit_all_ways(pair: wp.int32, faces: wp.vec2i, trees: Trees, pose: PairPose, own: LeastDistance):
    if pair > 1:
        return True
    elif pair == 1:
        for i in range(2):
            if i == pair:
                return True
        return False
    else:
        return False


@wp.func_native("return true;")
def visit_in_cpp(pair: wp.int32, faces: wp.vec2i, trees: Trees, pose: PairPose, own: LeastDistance) -> wp.bool: ...


@pytest.mark.parametrize(("visit", "hits"), [(visit_all_ways, [False, True]), (visit_in_cpp, [True, True])])
def test_takes_what_returns_on_all_ways(device, visit, hits):
    box = ab.Model.load(trimesh.creation.box())
    query = FaceQuery(scene_with(device, box, box), visit, LeastDistance(), [(0, 1), (1, 0)])
    assert query.run().any.tolist() == hits


def test_refuses_what_cannot_be_called():
    box = ab.Model.load(trimesh.creation.box())
    scene = scene_with("cpu", box, box)
    for visit, own, message in (
        (visit_without_value, LeastDistance(), "visit_without_value: ends without a value; return a bool"),
        (visit_half, LeastDistance(), "visit_half: ends without a value"),
        (visit_none, LeastDistance(), "visit_none: ends without a value"),
        (visit_native, LeastDistance(), "visit_native: ends without a value"),
        (lambda *given: True, LeastDistance(), "visit: a Warp function .* not a function"),
        (visit_less, LeastDistance(), r"visit_less: takes \(pair, faces\), not \(pair, faces, trees, pose, own\)"),
        (visit_other, LeastDistance(), "visit_other: pose is a int32, given is a .*PairPose"),
        (visit_least, Trees(), "visit_least: own is a .*LeastDistance, given is a .*Trees"),
        (visit_least, LeastDistance, "own: an instance of a Warp struct is expected, not a Struct"),
        (visit_least, None, "own: an instance of a Warp struct is expected, not a NoneType"),
    ):
        refused(TypeError, message, FaceQuery, scene, visit, own, [(0, 1)])
