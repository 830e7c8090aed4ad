"""Results: packed, brought over or left on the device, by any device and number of threads, the same bits."""

import gc

import numpy as np
import pytest
import warp as wp
from helpers import refused, scenes
from helpers.faults import MORE_PAIRS, add_objects, describe
from helpers.questions import in_a_row
from helpers.samples import random_poses, sample

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.query.result import COUNTERS
from warp_abtree.query.staging import BLOCK_LEAST, LENT_MAX, PINNED_AT_ONCE, HostPool

OUTPUTS = ["any", "count", "faces", "contacts", "contacts of float32"]  # the last with a gap
AS_FLOAT32 = {"contact_dtype": np.float32, "gap": 0.03}
NAMES = ("pairs", "any", "count", "faces", "contacts", "pair_contacts", "apart", *COUNTERS)


@pytest.fixture(params=[True, False], ids=["packed", "as by default"])
def packs(request):
    """Pack results on every device, or where the library does."""
    with testing.regime(packs_results=request.param or None):
        yield


def make_query(scene, output, pairs=MORE_PAIRS, **options):
    if output.startswith("contacts"):
        return ab.ContactQuery(scene, pairs, **(AS_FLOAT32 if output.endswith("32") else {}), **options)
    return ab.Query(scene, output, pairs=pairs, **options)


def as_host(value):
    if not isinstance(value, dict):
        return value.numpy() if isinstance(value, wp.array) else value
    columns = {name: value[name].numpy() for name in sorted(value, key="coplanar".__eq__)}  # the last of records
    records = np.zeros(len(columns["normal"]), [(name, x.dtype, x.shape[1:]) for name, x in columns.items()])
    for name, column in columns.items():
        records[name] = column
    return records


def repeated(output):
    """Return what is the same in every launch: the tests of `any` end where a warp has found a hit."""
    return [name for name in NAMES if output != "any" or name not in COUNTERS]


def check_same(kept, expected, names=NAMES):
    """Compare a result, on the device or not, with one on the host, to the bit."""
    for name in names:
        found, wanted = as_host(getattr(kept, name)), getattr(expected, name)
        assert (found is None) == (wanted is None), name
        if wanted is not None:
            assert found.dtype == wanted.dtype and found.shape == wanted.shape, name
            assert found.tobytes() == wanted.tobytes(), name


@pytest.mark.parametrize("given", [True, False], ids=["given", "broad phase"])
@pytest.mark.parametrize("output", OUTPUTS)
def test_every_way_of_reading_is_the_same(device, output, given):
    scene = add_objects(device)
    options = {"pairs": MORE_PAIRS if given else None, "within": 0.05}
    if given:
        options["within"] = np.linspace(0.0, 0.5, len(MORE_PAIRS))
    with testing.regime(packs_results=False):
        query = make_query(scene, output, **options)
        expected = query.run()
        assert expected.any.any()
        check_same(query.result(device=True), expected)
        kept = query.run(device=True)
        check_same(kept, expected, repeated(output))
        assert kept.any.device == kept.pairs.device == wp.get_device(device) and kept.any.dtype == wp.bool
        assert kept.pairs.dtype == wp.vec2i and kept.node_tests.dtype == wp.int64
    with testing.regime(packs_results=True):
        packed = make_query(scene, output, **options)
        for found in (packed.run(), packed.result()):
            check_same(found, expected, repeated(output))


@pytest.mark.parametrize("keeps", [False, True], ids=["host", "device"])
@pytest.mark.parametrize("output", OUTPUTS)
def test_later_launches_change_no_result(device, packs, output, keeps):
    scene = add_objects(device)
    query = make_query(scene, output, within=0.1)

    def bits(result):
        return [np.asarray(as_host(getattr(result, name))).tobytes() for name in NAMES]

    poses = np.tile([0, 0, 0, 0, 0, 0, 1.0], (4, 1))
    results, before = [], []
    for shift in (0.1, 0.2, 0.3, 0.4, 0.5):
        poses[:, 0] = shift * np.arange(4)
        scene.set_poses(poses)
        results.append(query.run(device=keeps))
        before.append(bits(results[-1]))
    query.set_pairs(MORE_PAIRS[:1], within=0.1)
    query.run()
    assert [bits(result) for result in results] == before
    assert len({tuple(part) for part in before}) == len(before), "each launch has found something else"


def test_nothing_to_find(device, packs):
    far = in_a_row(device, "box", (0, 5, 10))
    for output in OUTPUTS:
        for pairs in ([], [(0, 1), (1, 2)], None):
            query = make_query(far, output, pairs=pairs)
            expected, kept = query.run(), query.run(device=True)
            check_same(kept, expected)
            assert not expected.any.any() and len(expected.pairs) == (0 if pairs is None else len(pairs))
            if output != "any":
                assert expected.count.sum() == 0
            if output not in ("any", "count"):
                assert expected.faces.shape == (0, 3) and expected.faces.dtype == np.int32
        assert all(len(far.intersect([], output, device=True).any) == 0 for output in ("any", "faces", "contacts"))


@pytest.mark.parametrize("keeps", [False, True], ids=["host", "device"])
@pytest.mark.parametrize("output", ["faces", "contacts"])
def test_overflow_is_told(device, packs, output, keeps):
    """`launch` cannot grow: what there is room for is given, and `check` names the demand. None without a launch."""
    scene = add_objects(device)
    whole = scene.intersect(MORE_PAIRS, output)
    query = make_query(scene, output, capacity=ab.Buffers(hits=5))
    refused(RuntimeError, "nothing was launched", query.result, device=keeps)
    query.launch()
    short = query.result(device=keeps)
    assert len(short.faces) == 5
    refused(ab.CapacityError, rf"Buffers\(hits={len(whole.faces)}\)", short.check)
    assert len(query.run(device=keeps).faces) == len(whole.faces)
    query.set_pairs(MORE_PAIRS)
    refused(RuntimeError, "nothing was launched", query.result, device=keeps)
    found = make_query(scene, output, pairs=None, capacity=ab.Buffers(pairs=2))
    found.launch()
    short = found.result(device=keeps)
    assert len(short.pairs) == 2
    refused(ab.CapacityError, rf"Buffers\(pairs={len(scene.broad_phase())}\)", short.check)


def test_hits_that_vary_are_read_whole(device, packs, monkeypatch):
    """Read along with the counts where the last result makes so many likely, else after these."""
    monkeypatch.setattr("warp_abtree.query.readout.ROWS_STEP", 4)
    scene = add_objects(device)
    poses, seen = random_poses(np.random.default_rng(1), 4, 0.4), []
    query = ab.Query(scene, "faces", pairs=MORE_PAIRS)
    for spread in (0.5, 1.0, 0.97, 0.5, 99.0, 99.0, 0.52, 1.0):
        scene.set_poses(poses * np.repeat([spread, 1.0], [3, 4]))
        fresh = ab.Query(scene, "faces", pairs=MORE_PAIRS).run()
        assert describe(query.run()) == describe(query.result()) == describe(fresh)
        seen.append(len(fresh.faces))
    assert 0 in seen and len(set(seen)) > 4, "they have not varied"
    query.set_pairs(MORE_PAIRS[:2])
    assert describe(query.run()) == describe(scene.intersect(MORE_PAIRS[:2], "faces"))


@pytest.mark.parametrize("output", [*OUTPUTS, "distance"])
def test_calls_that_repeat_follow_what_changes(device, output):
    """On a GPU they are a graph after a few: poses, LODs, pairs, distances and rooms for hits still count."""
    scene, rng, seen = add_objects(device), np.random.default_rng(4), set()
    pairs, tolerance = np.array(MORE_PAIRS), 0.0
    for step in range(24):
        if step % 8 == 5:
            scene.set_poses(random_poses(rng, 4, 2.0 if output == "distance" else 0.4))
        if step % 8 == 6:
            scene.set_lods(rng.integers(0, scene.batch().models.lod_max[scene.object_model] + 1))
        if step % 8 == 7:
            pairs = np.roll(pairs, 1, axis=0) if step > 8 else pairs[:-1]
            tolerance = 0.1
        if output == "distance":
            found = scene.intersect(pairs, output, tolerance=tolerance)
            fresh = ab.DistanceQuery(scene, pairs, tolerance=tolerance).run()
            np.testing.assert_array_equal(found.any, fresh.any)
            assert (found.bracket[:, 0] <= fresh.bracket[:, 1]).all() and (found.any == (found.distance == 0)).all()
            assert (np.diff(found.bracket, axis=1) <= max(tolerance, 1e-9)).all()
            seen.add(found.distance.tobytes())
        else:
            within = np.linspace(0.0, 0.1 * step, len(pairs))
            found = scene.intersect(pairs, output.split()[0], within=within)
            assert describe(found) == describe(make_query(scene, output.split()[0], pairs, within=within).run())
            seen.add(tuple(describe(found)))
    assert len(seen) > 3, "nothing has changed"


def test_points_stay_on_the_device(device):
    query = ab.ManifoldQuery(add_objects(device))
    expected, kept = query.run().points, query.result(device=True).points
    count = kept["count"].numpy()
    assert count.sum() == len(expected["pair"]) > 0
    for name in ("point", "normal", "depth"):
        values = [kept[name].numpy()[p, :n] for p, n in enumerate(count)]
        assert np.concatenate(values).tobytes() == expected[name].tobytes()
    assert query.result(device=True, with_points=False).points is query.result(with_points=False).points is None


def test_memory_is_lent_again_when_no_array_is_left():
    pool = HostPool(wp.get_device("cpu"))
    first, second = pool.take(100), pool.take(200)
    view, places = first[8:16].view(np.int64), {first.ctypes.data, second.ctypes.data}
    assert len(places) == LENT_MAX and pool.take(300).ctypes.data not in places, "too many are lent"
    del first
    gc.collect()
    assert pool.take(100).ctypes.data not in places, "a view is left"
    place = view.ctypes.data - 8
    del view
    again = pool.take(BLOCK_LEAST)
    assert again.ctypes.data == place and again.flags.writeable
    del again, second
    large = [pool.take(PINNED_AT_ONCE + 1) for _ in range(2)]
    assert large[0].base is None and large[1].base is not None, "what is read once is not page-locked"
    assert pool.take(0).shape == (0,)


def test_records_pass_in_parts(device, monkeypatch):
    """More of them than there is memory to pack them in at a time."""
    scene = add_objects(device)
    expected = scene.intersect(MORE_PAIRS, "contacts")
    monkeypatch.setattr("warp_abtree.query.staging.PACKED_AT_ONCE", 1000)
    with testing.regime(packs_results=True):
        query = ab.ContactQuery(scene, MORE_PAIRS)
        assert describe(query.run()) == describe(expected)
    assert len(expected.contacts) > 100


@pytest.mark.parametrize("on_device", [False, True])
def test_results_have_a_length_and_no_truth_value(device, on_device):
    scene = add_objects(device)
    ends = scene.batch().objects
    poses = np.tile(np.eye(4), (scene.object_count, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = ends.pool.rotation.numpy(), ends.pool.position.numpy()
    for pairs in (MORE_PAIRS, MORE_PAIRS[:1], MORE_PAIRS[:0]):
        outputs = ("any", "faces", "contacts", "distance")
        found = [scene.intersect(pairs, output, device=on_device) for output in outputs]
        found.append(scene.first_contact(pairs, poses, device=on_device))
        found.append(ab.ManifoldQuery(scene, pairs).run())
        for result in found:
            assert len(result) == len(pairs)
            for ask in (bool, lambda result: not result, lambda result: any([result])):
                refused(TypeError, "a Result is neither true nor false; ask result", ask, result)


MODELS = ("torus", "small ball", "box", "crumbs", "soup", "twins")
PAIRS = np.array([(i, j) for i in range(18) for j in range(18) if i != j] + [(0, 18), (18, 3)])


def make_scene(device):
    scene = scenes.add_objects(device, MODELS * 3, seed=8, spread=0.9, fractions=np.repeat([1.0, 0.5, 0.2], 6))
    scene.add(sample("torus"), (50, 0, 0, 0, 0, 0, 1))
    return scene


@pytest.mark.parametrize("output", OUTPUTS)
def test_one_thread_and_any_device(device, output):
    query = make_query(make_scene("cpu"), output, PAIRS, within=0.05)
    options = AS_FLOAT32 if output.endswith("32") else {}
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
