"""Baselines find what brute force finds, or are named as skipped."""

import numpy as np
import pytest
import warp as wp

import warp_abtree as ab
from bench.baselines import fcl_cpp, newton, wp_bvh
from bench.shapes import knot, pair_poses, scene_of_pairs
from bench.verify import count_differences, load_oracle

pytestmark = pytest.mark.slow


def cube(size=1.0):
    corners = size * np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    return corners, np.array([*faces, [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]], np.int32)


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


def test_wp_bvh_of_yes_or_no_finds_what_that_of_pairs_finds(device):
    poses = pair_poses(4, 0.2)
    poses[5, :3] += 7
    asked = [*knot(300), poses]
    yes_no = wp_bvh.BvhAny(*asked, wp.get_device(device))
    every = wp_bvh.BvhFaces(*asked, 5000, wp.get_device(device))
    for other in (yes_no, yes_no, every):
        other.launch()
    found = np.isin(np.arange(4), every.result()[:, 0])
    assert np.array_equal(yes_no.result(), found) and found.tolist() == [True, True, False, True]


def test_best_constructor_is_one_of_them(device):
    name = wp_bvh.find_constructor(*knot(200), pair_poses(2, 0.5), wp.get_device(device), repeats=1)
    assert name in wp_bvh.CONSTRUCTORS


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


def test_differences_are_counted():
    truth = np.array([[0, 1, 2], [0, 2, 1], [1, 0, 0]])
    assert count_differences(truth, truth) == (0, 0)
    assert count_differences([[0, 1, 2], [0, 2, 2], [1, 0, 1], [1, 0, 0]], truth) == (1, 2)
    assert count_differences(np.empty((0, 3)), truth) == (3, 0)
