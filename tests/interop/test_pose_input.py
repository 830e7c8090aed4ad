"""Poses from arrays of other frameworks on the same memory, and results as such arrays."""

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers import refused
from helpers.samples import random_poses
from helpers.scenes import scene_with

import warp_abtree as ab


@pytest.fixture
def scene(device):
    ring = ab.Model.load(trimesh.creation.torus(0.6, 0.2, 16, 8))
    return scene_with(device, *[(ring, (0.3 * k, 0, 0, 0, 0, 0, 1)) for k in range(6)])


def poses_of(seed, count=6):
    return random_poses(np.random.default_rng(seed), count, 0.8)


def assert_same(scene, query, poses, launch=True):
    """Compare answers with those of another scene, whose poses go through the host."""
    other = scene_with(scene.device, *[(scene.models[0], pose) for pose in poses])
    wanted = other.intersect(other.broad_phase(), output="count")
    if launch:
        query.launch()
    pairs = query.pairs.numpy()[: query.pair_count.numpy()[0]]
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    assert pairs[order].tolist() == wanted.pairs.tolist()
    assert query.hits.count.numpy()[: len(pairs)][order].tolist() == wanted.count.tolist()
    assert wanted.count.sum() > 0


@pytest.mark.parametrize("real", [np.float32, np.float64])
def test_bad_rows_leave_their_objects_and_the_poses_of_the_input(scene, real):
    """Its next launch without poses is of what its owner wrote there, not of rows that were refused."""
    poses, query = ab.PoseInput(scene), ab.Query(scene, "count")
    before = poses.poses.numpy().copy()
    rows = poses_of(1).astype(real)
    rows[2, 0], rows[4, 3:] = np.nan, 0.51
    poses.launch(rows if scene.device.is_cpu else wp.array(rows, device=scene.device))
    refused(ValueError, r"2 rows since the last check .* first object that had one is 2", poses.check)
    poses.check()
    kept = rows.astype(np.float64)
    kept[[2, 4]] = before[[2, 4]]
    assert_same(scene, query, kept)
    assert np.array_equal(poses.poses.numpy(), before)
    poses.launch()
    poses.check()
    assert_same(scene, query, before)


def test_poses_from_warp(scene):
    poses, query = ab.PoseInput(scene), ab.Query(scene, "count")
    found = poses.poses.numpy().copy()
    assert np.allclose(found[:, 0], 0.3 * np.arange(6)) and np.allclose(found[:, 1:], [0, 0, 0, 0, 0, 1])
    rows = poses_of(1)
    poses.launch(wp.array(rows, dtype=wp.float64, device=scene.device))
    assert_same(scene, query, rows)
    assert np.array_equal(poses.poses.numpy(), found), "float64 is read where it lies"
    single = rows.astype(np.float32)
    poses.launch(wp.array(single, dtype=wp.float32, device=scene.device))
    assert_same(scene, query, single)
    assert np.array_equal(poses.poses.numpy(), found), "float32 is widened elsewhere"
    poses.poses.assign(poses_of(2))
    poses.launch()
    assert_same(scene, query, poses_of(2))
    poses.check()
    with wp.ScopedCapture(scene.device) as capture:
        poses.launch()
        query.launch()
    for seed in (3, 4):
        poses.poses.assign(poses_of(seed))
        wp.capture_launch(capture.graph)
        assert_same(scene, query, poses_of(seed), launch=False)


def test_poses_that_are_refused(scene):
    poses = ab.PoseInput(scene)
    cases = [
        (np.zeros((6, 7), int), r"shape \(6, 7\) of int64, not \(6, 7\) of float32 or float64"),
        (np.zeros((5, 7)), r"shape \(5, 7\)"),
        (np.zeros((6, 4, 4)), r"shape \(6, 4, 4\)"),
        ([[0.0] * 7] * 6, "list is no array"),
        (np.array(["x"]), "cannot be shared"),
    ]
    cases += [(poses_of(5), "on cpu, the scene is on cuda")] if scene.device.is_cuda else []
    for bad, message in cases:
        refused(ValueError, message, poses.launch, bad)
    scene.add(scene.models[0])
    refused(RuntimeError, "make a new one", poses.launch)


def numpy_array(rows, device):
    if device.is_cuda:
        pytest.skip("NumPy has no arrays on a GPU")
    part = np.repeat(rows, 2, 0)[::2]  # not contiguous
    part.setflags(write=False)
    return part, part.ctypes.data, wp.array.numpy, lambda view: view.ctypes.data


def torch_array(rows, device):
    torch = pytest.importorskip("torch")
    tensor = torch.tensor(rows, device=wp.device_to_torch(device), requires_grad=True)
    return tensor, tensor.data_ptr(), wp.to_torch, lambda view: view.data_ptr()


def jax_array(rows, device):
    jax = pytest.importorskip("jax")
    jax.config.update("jax_enable_x64", True)
    try:
        place = wp.device_to_jax(device)
    except RuntimeError as error:  # a jax without this kind of device
        pytest.skip(str(error))
    array = jax.device_put(rows, place)
    return array, array.unsafe_buffer_pointer(), wp.to_jax, lambda view: view.unsafe_buffer_pointer()


def cupy_array(rows, device):
    cupy = pytest.importorskip("cupy")
    if not device.is_cuda:
        pytest.skip("CuPy has no arrays on the CPU")
    array = cupy.asarray(rows)
    return array, array.data.ptr, cupy.from_dlpack, lambda view: view.data.ptr


@pytest.mark.parametrize("framework", [numpy_array, torch_array, jax_array, cupy_array])
def test_arrays_of_frameworks_share_memory(scene, framework):
    poses, query = ab.PoseInput(scene), ab.Query(scene, "count")
    for kind in (np.float64, np.float32):
        rows = poses_of(10).astype(kind)
        array, address, view_of, address_of = framework(rows, scene.device)
        shared = ab.wrap_array(array)
        assert shared.ptr == address and shared.shape == rows.shape and wp.dtype_to_numpy(shared.dtype) == kind
        poses.launch(array)
        assert_same(scene, query, rows)
    assert address_of(view_of(query.hits.any_hit)) == query.hits.any_hit.ptr
