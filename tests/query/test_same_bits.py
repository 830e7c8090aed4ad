"""Whole results, byte for byte: every device, and any number of threads, gives what one thread of the CPU gives."""

from functools import partial

import numpy as np
import pytest
import warp as wp
from helpers.faults import describe
from helpers.samples import random_poses, sample
from helpers.scenes import add_objects

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.checks.cpu_threads import cores_for, launch_on_cores
from warp_abtree.kernels import native
from warp_abtree.kernels.base.counters import take_slots

MODELS = ("torus", "small ball", "box", "crumbs", "soup", "twins")
COUNTERS = ("node_tests", "triangle_tests", "exact_tests")
PAIRS = np.array([(i, j) for i in range(18) for j in range(18) if i != j] + [(0, 18), (18, 3)])


def make_scene(device):
    scene = add_objects(device, MODELS * 3, seed=8, spread=0.9, fractions=np.repeat([1.0, 0.5, 0.2], 6))
    scene.add(sample("torus"), (50, 0, 0, 0, 0, 0, 1))
    return scene


@pytest.mark.parametrize("output", ["any", "count", "faces", "contacts", "contacts of float32"])
def test_one_thread_and_any_device(device, output):
    options, scene = {"contact_dtype": np.float32} if output.endswith("32") else {}, make_scene("cpu")
    if "contacts" in output:
        query = ab.ContactQuery(scene, pairs=PAIRS, within=0.05, **options)
    else:
        query = ab.Query(scene, output, pairs=PAIRS, within=0.05)
    with testing.regime(cpu_threads=1):
        expected = query.run()
    found = make_scene(device).intersect(PAIRS, output.split()[0], within=0.05, **options)
    assert describe(found) == describe(expected)
    assert expected.any.any() and not expected.any.all()


def ask_manifolds(device):
    result = ab.ManifoldQuery(make_scene(device)).run()
    return [*describe(result), *(result.points[name].tobytes() for name in ("pair", "point", "normal", "depth"))]


def ask_pipeline(device):
    frame = ab.Pipeline(make_scene(device), output="contacts", pairs=PAIRS, capacity=2**17)
    frame.launch()
    frame.check()
    return describe(frame.result())


def read_trees(device):
    scene, names = make_scene(device), ("status", "lower", "upper", "skip", "face_node")
    states = [scene.tree_state(i) for i in range(scene.object_count)]
    return [getattr(state, name).tobytes() for state in states for name in names]


def ask_sweeps(device):
    poses = random_poses(np.random.default_rng(9), 400, 1.6)
    models = sample("torus"), sample("twins")
    found = [ab.sweep(*models, poses, output=output, device=device) for output in ("any", "count", "faces")]
    assert all(len(np.unique(values)) > 1 for values in found)
    return [values.tobytes() for values in found]


@pytest.mark.parametrize("ask", [ask_manifolds, ask_pipeline, read_trees, ask_sweeps])
def test_any_device(device, ask):
    assert ask(device) == ask("cpu")


@pytest.mark.slow
@pytest.mark.parametrize("with_slabs", [False, True])
def test_any_number_of_threads(with_slabs):
    with testing.regime(cpu_threads=5, plain_tests=0 if with_slabs else 10**9):
        query, found = ab.Query(make_scene("cpu"), "faces", pairs=PAIRS, within=0.05), []
    for threads in (1, *(2, 3, 5) * 8):
        with testing.regime(cpu_threads=threads):
            result = query.run()
        result.check()
        found.append([describe(result), *(getattr(result, name).tolist() for name in COUNTERS)])
        assert found[-1] == found[0]


def test_a_capture_records_all_threads():
    query = ab.Query(make_scene("cpu"), "faces", pairs=PAIRS)
    with testing.regime(cpu_threads=4):
        expected = query.run().faces
        with wp.ScopedCapture("cpu") as capture:
            query.launch()
    query.hits.total.fill_(-1)
    query.hits.face.fill_(0)
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(query.result().faces, expected)


@wp.kernel(module="unique", module_options=native.options("base/counters.cuh"))
def count_item_kernel(count: int, taken: wp.array[int], seen: wp.array[int]):
    i = take_slots(taken, 1)
    while i < count:
        seen[i] = seen[i] + 1
        i = take_slots(taken, 1)


def test_threads_take_every_item_once_and_raise_what_fails():
    for threads, count in ((1, 17), (2, 1), (3, 1000), (7, 16), (2, 100)):
        seen, taken = (wp.zeros(length, dtype=int, device="cpu") for length in (count, 1))
        inputs = [count, taken, seen]
        launch_on_cores(partial(wp.launch, count_item_kernel, 1, inputs, device="cpu"), cores_for(count, 1, threads))
        # Each thread that began before the items were gone has found that none is left.
        assert (seen.numpy() == 1).all() and 1 <= taken.numpy()[0] - count <= min(threads, count)
    with pytest.raises(Exception, match="'seen'"):
        launch_on_cores(partial(wp.launch, count_item_kernel, 1, [100, taken, 3.5], device="cpu"), 2)
