"""Baselines find what brute force finds, or are named as skipped."""

import numpy as np
import pytest
import trimesh
import warp as wp

import warp_abtree as ab
from bench.baselines import fcl_cpp, newton, wp_bvh
from bench.shapes import knot, pair_poses, scene_of_pairs
from bench.verify import count_differences, load_oracle

pytestmark = pytest.mark.slow


def cube(size=1.0):
    box = trimesh.creation.box((size,) * 3)
    return np.asarray(box.vertices), np.asarray(box.faces, np.int32)


def test_wp_bvh_finds_what_brute_force_finds(device):
    """Separate boxes far above its epsilon: 12 faces each, poses without rotation."""
    box, faces = cube()
    poses = np.zeros((4, 7), np.float32)
    poses[:, 6] = 1
    poses[1, :3] = 0.41, 0.27, 0.33
    poses[3, :3] = 3
    found = wp_bvh.BvhFaces(box, faces, poses, 144, wp.get_device(device))
    found.launch()
    scene, pairs = scene_of_pairs(device, ab.Model.from_arrays(box, faces, base_faces=12), poses)
    truth = scene.intersect(pairs, "faces").faces
    assert len(truth) > 6 and count_differences(found.result(), truth) == (0, 0)
    found.rebuild()
    found.launch()
    assert np.array_equal(found.result(), truth)
    small = wp_bvh.BvhFaces(box, faces, poses, 3, wp.get_device(device))
    small.launch()
    with pytest.raises(RuntimeError, match="with room for 3"):
        small.result()


def test_fcl_in_cpp_finds_what_brute_force_finds():
    """Two meshes that differ, and one with itself; B is placed by its matrix."""
    try:
        fcl_cpp.load_library()
    except ImportError as error:
        pytest.skip(str(error))
    matrices = np.tile(np.eye(4), (3, 1, 1))
    matrices[:, :3, 3] = [[0.41, 0.27, 0.33], [5, 0, 0], [-0.4, -0.3, 0.2]]
    for a, b in ((cube(), cube(0.7)), (cube(),) * 2):
        found = fcl_cpp.FclCpp(a, b, matrices)
        assert found.any().tolist() == [True, False, True]
        for answer, matrix in zip(found.faces(), matrices, strict=True):
            truth = load_oracle().brute_force_faces(*a, *b, np.eye(4), matrix)
            assert sorted(map(tuple, found.face_pairs(answer))) == sorted(map(tuple, truth.tolist()))


def test_fcl_in_cpp_is_named_where_it_cannot_be_compiled(monkeypatch):
    for name, value in (("PATH", "/nowhere"), ("CXX", "no-such-compiler")):
        fcl_cpp.load_library.cache_clear()
        with monkeypatch.context() as patch:
            patch.setenv(name, value)
            with pytest.raises(ImportError, match="no "):
                fcl_cpp.FclCpp(cube(), cube(), np.eye(4)[None])
    fcl_cpp.load_library.cache_clear()


def test_newton_is_named_where_it_is_not_asked(device):
    made, skipped = newton.make_newton(*knot(200), pair_poses(1, 0.2), 10, wp.get_device(device), "too many")
    assert made == {} and set(skipped.values()) == {"too many"} and len(skipped) == 2


def test_newton_agrees_on_which_pairs_intersect(device):
    pytest.importorskip("newton")
    poses = pair_poses(6, 0.2)
    poses[1::2, :3][3:] += 5
    made, skipped = newton.make_newton(*knot(300), poses, 600, wp.get_device(device))
    assert "newton_bvh" in made, skipped
    for other in made.values():
        other.launch()
        found = other.compare(np.arange(6) < 3)
        assert found["contacts"] > 0 and found["any_missed"] == found["any_invented"] == 0
        assert other.compare(np.arange(6) < 2)["any_invented"] == 1
