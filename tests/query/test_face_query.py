"""Questions of one's own about face pairs: the sample against brute force in integers, and one of order and of ends."""

import runpy
from pathlib import Path

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers import refused
from helpers.scenes import scene_with
from oracles.triangle import into_frame_of_a
from oracles.triangle_distance import near_faces

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.query.stages.faces import FaceQuery, PairPose, Trees, face_distance

SAMPLE = Path(__file__).resolve().parents[2] / "scenes" / "06_your_own_query.py"
SCALE = wp.constant(wp.float64(2.0**20))


@wp.struct
class LeastDistance:
    """A distance in units of 2^-20, the same whatever the order of visits."""

    least: wp.array(dtype=wp.int64)


@wp.func
def visit_least(pair: wp.int32, faces: wp.vec2i, trees: Trees, pose: PairPose, own: LeastDistance):
    wp.atomic_min(own.least, pair, wp.int64(face_distance(trees, pose, faces) * SCALE))
    return True


@pytest.fixture(scope="module")
def sampled():
    return runpy.run_path(str(SAMPLE))


@pytest.fixture(params=[True, False], ids=["warps", "threads"])
def scene_and_meshes(request, device):
    """Give a plate and a ball that crosses it, one beside it and one far away, turned."""
    if wp.get_device(device).is_cuda and not request.param:
        pytest.skip("CUDA has warps alone")
    plate = trimesh.creation.box((2.0, 1.0, 0.1)).subdivide()
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.4)
    rng, scene = np.random.default_rng(3), ab.Scene(device=device)
    poses = np.zeros((4, 7))
    poses[1:, :3] = (0.1, 0, 0.3), (-0.5, 0.2, 0.5), (0, 0, 3)
    poses[:, 3:] = rng.normal(size=(4, 4))
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1)[:, None]
    turn = trimesh.transformations.quaternion_matrix(poses[0, [6, 3, 4, 5]])[:3, :3]
    poses[:, :3] = poses[:, :3] @ turn.T
    for mesh, pose in zip((plate, ball, ball, ball), poses, strict=True):
        scene.add(ab.Model.load(mesh), pose=pose)
    with testing.regime(warps=request.param):
        yield scene, plate, ball, poses


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


@pytest.mark.parametrize(
    ("visit", "own", "message"),
    [
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
    ],
)
def test_refuses_what_cannot_be_called(visit, own, message):
    box = ab.Model.load(trimesh.creation.box())
    refused(TypeError, message, FaceQuery, scene_with("cpu", box, box), visit, own, [(0, 1)])
