"""Whole results, byte for byte: every device gives what one core of the CPU gives, NaNs of no contacts too."""

import numpy as np
import pytest
from helpers.samples import random_poses, sample

import warp_abtree as ab
from warp_abtree import testing

MODELS = ("torus", "small ball", "box", "crumbs", "soup", "twins")
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
    one_core = ab.ContactQuery if output == "contacts" else ab.Query
    scene = make_scene("cpu")
    query = one_core(scene, pairs=pairs(), within=0.05, **({} if output == "contacts" else {"output": output}))
    if output == "contacts":
        query.contact_dtype = real
    with testing.regime(cpu_threads=1):
        expected = query.run()
    found = make_scene(device).intersect(pairs(), **options)
    assert fields(found) == fields(expected)
    assert expected.any.any() and not expected.any.all()


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
        frame = ab.FrameGraph(make_scene(where), output="contacts", pairs=pairs(), capacity=2**17)
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
