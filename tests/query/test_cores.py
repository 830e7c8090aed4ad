"""Several cores of the CPU at one launch: the same answers as one, whatever their number."""

import numpy as np
import pytest
import warp as wp
from helpers.samples import random_poses, sample

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.kernels.traversal.simd import take_slots
from warp_abtree.query.cpu_threads import core_count, launch_on_cores

PAIRS = np.array([(i, j) for i in range(12) for j in range(12) if i != j])


@wp.kernel
def count_item_kernel(count: wp.int32, taken_inout: wp.array(dtype=wp.int32), seen_inout: wp.array(dtype=wp.int32)):
    i = take_slots(taken_inout, 1)
    while i < count:
        seen_inout[i] = seen_inout[i] + 1
        i = take_slots(taken_inout, 1)


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(3)
    scene = ab.Scene("cpu")
    for k, pose in enumerate(random_poses(rng, 12, 1.0)):
        scene.add(sample(("torus", "soup", "twins")[k % 3]), pose)
    return scene


@pytest.mark.parametrize("cores", [1, 2, 3, 7])
def test_every_item_once(cores):
    for count in (1, 15, 16, 17, 1000):
        seen, taken = (wp.zeros(length, dtype=wp.int32, device="cpu") for length in (count, 1))
        launch_on_cores(count_item_kernel, count, [count, taken, seen], wp.get_device("cpu"), cores)
        assert (seen.numpy() == 1).all() and taken.numpy()[0] == count + min(cores, count)


@pytest.mark.parametrize("output", ["any", "count", "faces"])
@pytest.mark.slow
def test_same_answers(scene, output):
    def ask(cores, within=None):
        query = ab.Query(scene, output, pairs=PAIRS, within=within)
        with testing.regime(cpu_threads=cores):
            return query, query.run()

    expected = ask(1, within=0.5)[1]
    assert 10 < expected.any.sum()
    for cores in (2, 3, 5):
        query, result = ask(cores, within=0.5)
        for _ in range(8):
            for name in ("any", "count", "faces", "node_tests", "triangle_tests", "exact_tests", "apart"):
                np.testing.assert_array_equal(getattr(result, name), getattr(expected, name))
            query.launch()
            result = query.result()
            result.check()


def test_a_capture_records_all(scene):
    query = ab.Query(scene, "faces", pairs=PAIRS)
    with testing.regime(cpu_threads=4):
        expected = query.run().faces
        with wp.ScopedCapture("cpu") as capture:
            query.launch()
    query.hits.total.fill_(-1)
    query.hits.face.fill_(0)
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(query.result().faces, expected)


def test_a_failure_is_raised():
    seen, taken = (wp.zeros(length, dtype=wp.int32, device="cpu") for length in (100, 1))
    with pytest.raises(Exception, match="seen_inout"):
        launch_on_cores(count_item_kernel, 100, [100, taken, 3.5], wp.get_device("cpu"), 2)
    assert not seen.numpy().any()


def test_cores_are_counted():
    assert core_count() >= 1
