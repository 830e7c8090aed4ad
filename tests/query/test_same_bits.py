"""Whole results, byte for byte: every device, and any number of threads, gives what one thread of the CPU gives."""

import numpy as np
import pytest
import warp as wp
from helpers.samples import random_poses, sample

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.kernels.traversal.warp_stack import take_slots
from warp_abtree.query.cpu_threads import launch_on_cores

MODELS = ("torus", "small ball", "box", "crumbs", "soup", "twins")
COUNTERS = ("node_tests", "triangle_tests", "exact_tests")
NAN_BITS = 0x7FF8000000000000


def make_scene(device):
    scene = ab.Scene(device)
    rng = np.random.default_rng(8)
    for k, pose in enumerate(random_poses(rng, 18, 0.9)):
        model = sample(MODELS[k % len(MODELS)])
        scene.add(model, pose, lod=model.lod_for(fraction=(1.0, 0.5, 0.2)[k // 6]))
    scene.add(sample("torus"), (50, 0, 0, 0, 0, 0, 1))
    return scene


def pairs():
    return np.array([(i, j) for i in range(18) for j in range(18) if i != j] + [(0, 18), (18, 3)])


def fields(result):
    """Return the bytes of all that a result answers."""
    names = ("pairs", "any", "count", "faces", "contacts", "pair_contacts", "apart")
    found = {name: getattr(result, name) for name in names if getattr(result, name) is not None}
    return {name: np.ascontiguousarray(array).tobytes() for name, array in found.items()}


@pytest.mark.parametrize("real", [np.float64, np.float32])
@pytest.mark.parametrize("output", ["any", "count", "faces", "contacts"])
def test_results(device, output, real):
    options = {"output": output, "within": 0.05, "contact_dtype": real}
    operator = ab.ContactQuery if output == "contacts" else ab.Query
    scene = make_scene("cpu")
    query = operator(scene, pairs=pairs(), within=0.05, **({} if output == "contacts" else {"output": output}))
    if output == "contacts":
        query.contact_dtype = real
    with testing.regime(cpu_threads=1):
        expected = query.run()
    found = make_scene(device).intersect(pairs(), **options)
    assert fields(found) == fields(expected)
    assert expected.any.any() and not expected.any.all()


@pytest.mark.parametrize("output", ["any", "count", "faces"])
@pytest.mark.slow
def test_any_number_of_threads(output):
    query = ab.Query(make_scene("cpu"), output, pairs=pairs(), within=0.05)

    def ask(threads):
        with testing.regime(cpu_threads=threads):
            result = query.run()
        result.check()
        return [fields(result), *(getattr(result, name).tolist() for name in COUNTERS)]

    expected = ask(1)
    for threads in (2, 3, 5):
        assert all(ask(threads) == expected for _ in range(8))


def test_a_capture_records_all_threads():
    query = ab.Query(make_scene("cpu"), "faces", pairs=pairs())
    with testing.regime(cpu_threads=4):
        expected = query.run().faces
        with wp.ScopedCapture("cpu") as capture:
            query.launch()
    query.hits.total.fill_(-1)
    query.hits.face.fill_(0)
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(query.result().faces, expected)


@wp.kernel
def count_item_kernel(count: wp.int32, taken_inout: wp.array(dtype=wp.int32), seen_inout: wp.array(dtype=wp.int32)):
    i = take_slots(taken_inout, 1)
    while i < count:
        seen_inout[i] = seen_inout[i] + 1
        i = take_slots(taken_inout, 1)


@pytest.mark.parametrize("threads", [1, 2, 3, 7])
def test_threads_take_every_item_once(threads):
    for count in (1, 15, 16, 17, 1000):
        seen, taken = (wp.zeros(length, dtype=wp.int32, device="cpu") for length in (count, 1))
        launch_on_cores(count_item_kernel, count, [count, taken, seen], wp.get_device("cpu"), threads)
        assert (seen.numpy() == 1).all() and taken.numpy()[0] == count + min(threads, count)


def test_a_failure_on_a_thread_is_raised():
    seen, taken = (wp.zeros(length, dtype=wp.int32, device="cpu") for length in (100, 1))
    with pytest.raises(Exception, match="seen_inout"):
        launch_on_cores(count_item_kernel, 100, [100, taken, 3.5], wp.get_device("cpu"), 2)
    assert not seen.numpy().any()


def test_pairs_without_contacts(device):
    """Their point and normal are one stated NaN, in the results and in the arrays on the device."""
    query = ab.ContactQuery(make_scene(device), pairs=pairs())
    result = query.run()
    without = result.count == 0
    assert without.sum() > 2
    for name in ("point", "normal"):
        for array in (result.pair_contacts[name], getattr(query.pair_contacts, name).numpy()):
            assert (np.ascontiguousarray(array[without]).view(np.uint64) == NAN_BITS).all()
            assert np.isfinite(array[~without]).all()
    assert (result.pair_contacts["depth"][without].view(np.uint64) == 0).all()


def test_manifolds(device):
    expected, found = (ab.ManifoldQuery(make_scene(where)).run() for where in ("cpu", device))
    assert fields(found) == fields(expected)
    for name in ("pair", "point", "normal", "depth"):
        assert found.points[name].tobytes() == expected.points[name].tobytes()


def test_frames(device):
    """Poses and LODs set on the device."""
    results = []
    for where in ("cpu", device):
        frame = ab.Pipeline(make_scene(where), output="contacts", pairs=pairs(), capacity=2**17)
        frame.launch()
        frame.check()
        results.append(fields(frame.result()))
    assert results[0] == results[1]


def test_trees(device):
    expected, found = make_scene("cpu"), make_scene(device)
    for i in range(expected.object_count):
        one, other = expected.tree_state(i), found.tree_state(i)
        for name in ("status", "lower", "upper", "skip", "face_node"):
            assert getattr(other, name).tobytes() == getattr(one, name).tobytes()


@pytest.mark.parametrize("output", ["any", "count", "faces"])
def test_sweeps(device, output):
    poses = random_poses(np.random.default_rng(9), 400, 1.6)
    expected, found = (
        ab.sweep(sample("torus"), sample("twins"), poses, output=output, device=where) for where in ("cpu", device)
    )
    assert found.tobytes() == expected.tobytes() and len(np.unique(expected)) > 1
