"""Arrays of other frameworks wherever poses, LODs and pairs go in; what lies on a GPU is read without its framework."""

import numpy as np
import pytest
import warp as wp
from helpers import refused
from helpers.faults import describe
from helpers.questions import to_matrix
from helpers.samples import STILL, random_poses, sample
from helpers.scenes import add_objects, scene_with
from oracles.triangle import pose_matrix

import warp_abtree as ab
from warp_abtree.scene import sweep as pose_sweep
from warp_abtree.state.poses import device_rows


def speaking(array, *names):
    """Return an array that has some attributes of another and nothing else."""
    own = {name: property(lambda _, name=name: getattr(array, name)) for name in names}
    return type("Array", (), own)()


def on_gpu(make):
    """Return a maker of arrays that skips the test on a CPU."""

    def make_there(values, device):
        if not device.is_cuda:
            pytest.skip("arrays of GPUs alone")
        return make(values, device)

    return make_there


def to_jax(values, device):
    jax = pytest.importorskip("jax")
    jax.config.update("jax_enable_x64", True)
    return jax.device_put(values, jax.devices(name_of(device))[0])


def name_of(device):
    return "cuda" if device.is_cuda else "cpu"


def to_transforms(values, device):
    """Return an array of Warp's transforms, of what is shaped like them, with gaps between them."""
    kinds = {np.dtype(np.float32): wp.transformf, np.dtype(np.float64): wp.transformd}
    options = {"dtype": kinds[values.dtype]} if values.shape[1:] == (7,) and values.dtype in kinds else {}
    return wp.array(np.repeat(values, 2, 0), device=device, **options)[::2]


FRAMEWORKS = {
    "warp": lambda values, device: wp.array(values, device=device),
    "strided": lambda values, device: wp.array(np.repeat(values, 2, 0), device=device)[::2],
    "transforms": to_transforms,
    "dlpack": lambda values, device: speaking(wp.array(values, device=device), "__dlpack__", "__dlpack_device__"),
    "interface": on_gpu(lambda values, device: speaking(wp.array(values, device=device), "__cuda_array_interface__")),
    "torch": lambda values, device: pytest.importorskip("torch").asarray(values, device=name_of(device)),
    "cupy": on_gpu(lambda values, _: pytest.importorskip("cupy").asarray(values)),
    "jax": to_jax,
}


@pytest.fixture(params=FRAMEWORKS)
def framework(request, device):
    make = FRAMEWORKS[request.param]
    return lambda values: make(np.ascontiguousarray(values), wp.get_device(device))


PAIRS = np.array([(0, 1), (1, 2), (3, 1), (2, 0)])


def make_scene(device):
    return add_objects(device, ["torus"] * 4, seed=1, spread=0.4)


def poses_of(shape, real, count=4):
    poses = random_poses(np.random.default_rng(2), count, 0.4)
    if shape == "matrices":
        return np.array([to_matrix(*pose_matrix(pose)) for pose in poses]).astype(real)
    return poses.astype(real)


@pytest.mark.parametrize(
    ("shape", "real"), [("quaternions", np.float32), ("quaternions", np.float64), ("matrices", np.float32)]
)
def test_poses(device, framework, shape, real, monkeypatch):
    monkeypatch.setattr(pose_sweep, "CHUNKS", (64,))
    poses = poses_of(shape, real)
    first, second = make_scene(device), make_scene(device)
    first.set_poses(poses)
    second.set_poses(framework(poses))
    for name in ("rotation", "position"):
        expected = getattr(first.batch().objects.pool, name).numpy()
        assert getattr(second.batch().objects.pool, name).numpy().tobytes() == expected.tobytes()
    model, many = sample("torus"), poses_of(shape, real, 200)
    scene = scene_with(device, *[(model, pose) for pose in (STILL, *many)])
    expected = scene.intersect([(0, i + 1) for i in range(200)], output="faces")
    assert expected.any.any()
    for output in ("count", "faces"):
        found = ab.sweep(model, model, framework(many), output=output, device=device)
        np.testing.assert_array_equal(found, getattr(expected, output))


def test_lods_pairs_distances_and_transforms(device, framework):
    first, second = make_scene(device), make_scene(device)
    lods = first.lods - [0, 30, 60, 90]
    first.set_lods(lods)
    second.set_lods(framework(lods))
    np.testing.assert_array_equal(second.lods, lods)
    within = np.array([0.01, 0.02, 0.03, 0.04])
    expected = describe(first.intersect(PAIRS, output="faces", within=within))
    assert describe(second.intersect(framework(PAIRS), output="faces", within=framework(within))) == expected
    query = ab.Query(second, "faces", pairs=framework(PAIRS), within=framework(within))
    assert describe(query.run()) == expected
    query.set_pairs(framework(PAIRS[:2]), framework(within[:2]))
    assert describe(query.run()) == describe(first.intersect(PAIRS[:2], output="faces", within=within[:2]))
    assert describe(ab.ContactQuery(second, framework(PAIRS)).run()) == describe(first.intersect(PAIRS, "contacts"))
    frame = ab.Pipeline(second, output="count", pairs=framework(PAIRS), groups=framework(np.arange(4)))
    np.testing.assert_array_equal(frame.run().count, first.intersect(PAIRS, output="count").count)
    second.filter(framework(PAIRS[:2]))
    np.testing.assert_array_equal(second.broad_phase(), [(0, 2), (0, 3), (1, 3), (2, 3)])
    manager, transforms = ab.CollisionManager(device), poses_of("matrices", np.float64)
    manager.add_object("a", sample("torus"), framework(transforms[0]))
    manager.add_object("b", sample("torus"))
    manager.set_transform("b", framework(transforms[1]))
    assert manager.in_collision_internal()


def test_what_is_wrong_is_refused_and_told(device, framework):
    """Nothing has changed then. Of a matrix that drifted in float32 it is told how to mend it, and that mends it."""
    scene, torus = make_scene(device), sample("torus")
    before = scene.batch().objects.pool.position.numpy().copy()
    poses, matrices = poses_of("quaternions", np.float64), np.tile(np.eye(4, dtype=np.float32), (4, 1, 1))
    bad = poses.copy()
    bad[2, 3:] *= 1.5
    turn = np.asarray(scene.batch().objects.pool.rotation.numpy()[1], np.float32)
    drifted = np.eye(3, dtype=np.float32)
    while np.abs(drifted.T @ drifted - np.eye(3)).max() < 2e-6:
        drifted = drifted @ turn
    matrices[1, :3, :3] = drifted
    row = np.tile(np.eye(4), (4, 1, 1))
    row[3, 3, 0] = 1e-3
    stretched = np.eye(4) * np.array([1, 1, 1 + 1e-5])[[0, 1, 2, 0]][:, None, None]
    for call, values, what in (
        (scene.set_poses, bad, "pose 2 has a quaternion of norm 1.5"),
        (scene.set_poses, np.where(np.arange(7) == 1, np.nan, poses), "pose 0 is not finite"),
        (scene.set_poses, poses[:3], "3 given for 4 objects"),
        (scene.set_poses, poses[:, :6], "neither"),
        (scene.set_poses, np.ones((4, 7), bool), "poses: "),
        (scene.set_poses, stretched, "matrix 2 is not rigid"),
        (scene.set_poses, matrices, "matrix 1 is not rigid.*off the identity by .*e-06.*svd"),
        (scene.set_poses, row, r"matrix 3 .*last row is \[0.001, "),
        (scene.set_poses, np.diag([1, -1, 1, 1.0]) * np.ones((4, 1, 1)), "matrix 0 is not rigid.*it mirrors"),
        (scene.set_poses, np.diag([2, 2, 2, 1.0]) * np.ones((4, 1, 1)), "matrix 0 .*off the identity by 3; a scale"),
        (scene.set_lods, np.array([0, 1, 2, 10**6]), "object 3 asks"),
        (scene.intersect, np.array([(0, 7)]), "has 4 objects"),
        (lambda given: ab.sweep(torus, torus, given, device=device), bad, "pose 2 has a quaternion"),
    ):
        refused(ValueError, what, call, framework(values))
        np.testing.assert_array_equal(scene.batch().objects.pool.position.numpy(), before)
    u, _, v = np.linalg.svd(drifted)
    matrices[1, :3, :3] = u @ v
    scene.set_poses(framework(matrices))


def test_what_is_on_the_gpu_is_read_there(device):
    """Contiguous rows without a copy, Warp's transforms and matrices too; other types and devices are brought over."""
    target = wp.get_device(device)
    rows = wp.array(poses_of("quaternions", np.float64), device=device)
    assert device_rows(wp.array(rows.numpy(), device="cpu"), target) is None
    if not target.is_cuda:
        return
    matrices = wp.array(poses_of("matrices", np.float32), device=device)
    for array, width in ((rows, 7), (matrices, 16), (wp.array(rows.numpy(), dtype=wp.transformd, device=device), 7)):
        assert device_rows(array, target).ptr == array.ptr and device_rows(array, target).shape == (4, width)
    across = wp.array(np.ascontiguousarray(rows.numpy().T), device=device).transpose()
    np.testing.assert_array_equal(device_rows(across, target).numpy(), rows.numpy())
