"""Contacts as an operator: order of rows, sums to the bit, capacities and capture; hits sorted by a segment a pair."""

import numpy as np
import pytest
import warp as wp
from helpers.contacts import CHUNK, check_summaries
from helpers.faults import describe
from helpers.questions import in_a_row, launch, pairs_of, scene_of
from helpers.samples import contact_poses, sample

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.kernels import native
from warp_abtree.kernels.contacts.summary import locate_chunk_kernel
from warp_abtree.kernels.intersect.face_pairs import NEAR_BIT, Hits
from warp_abtree.kernels.io.sort_segments import SEGMENT_KEYS, SEGMENT_THREADS
from warp_abtree.kernels.triangle.segment import divide_vector
from warp_abtree.query.sorting import make_segment_sort, segment_threads

wp.set_module_options(native.options())


def teeth(count, seed, points=False):
    """So many triangles that cross the plane z = 0, or touch it with a corner, each alone."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-0.1, 0.1, (count, 3, 3))
    corners += np.append(rng.uniform(0, 1, (count, 2)), np.zeros((count, 1)), 1)[:, None]
    corners[:, 0, 2] = 0 if points else rng.uniform(-1.5, -0.5, count)
    corners[:, 1:, 2] = rng.uniform(0.5, 1.5, (count, 2))
    return ab.Model.from_arrays(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


@pytest.mark.parametrize("points", [False, True])
def test_sums_of_every_length(device, points):
    """Counts around whole chunks, weighted by length or all alike."""
    counts, scene = (1, 2, 31, 32, 33, 63, 64, 65, 96, 97, 300), ab.Scene(device)
    scene.add(ab.Model.from_arrays(np.array([[-9.0, -9, 0], [30, -9, 0], [-9, 30, 0]]), [[0, 1, 2]]))
    for count in counts:
        scene.add(teeth(count, count, points))
    pairs = np.array([(0, i + 1) if i % 2 else (i + 1, 0) for i in range(len(counts))])
    result = ab.ContactQuery(scene, pairs).run()
    np.testing.assert_array_equal(result.count, counts)
    check_summaries(result)


def touching(device, pairs=12):
    """A scene of pairs of objects (2 p, 2 p + 1) in contact, and one object far away."""
    rng, cases, names = np.random.default_rng(0), [], ("ball", "torus", "soup", "lattice soup")
    for p in range(pairs):
        a, b = sample(names[p % 4]), sample(names[(p // 2 + 1) % 4])
        pose_a, pose_b = contact_poses(rng, a, a.lod_max, b, b.lod_max)
        cases.append((a, None, pose_a, b, None, pose_b))
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    scene.add(sample("ball"), (50.0, 0, 0, 0, 0, 0, 1))
    pairs[1::2] = pairs[1::2, ::-1]
    return scene, np.concatenate([pairs, [(0, len(pairs) * 2)], pairs[:3]])


def test_any_order_of_hits(device):
    scene, pairs = touching(device)
    expected = ab.ContactQuery(scene, pairs).run()
    check_summaries(expected)
    assert (expected.count > 2 * CHUNK).sum() > 3
    rng, k = np.random.default_rng(1), len(expected.faces)
    # 20 bits are too few for a pair and two faces: sorted twice. The CPU has vector code of its own, warps have not.
    for regime in ({"key_bits": 63}, {"key_bits": 20}, {"warps": True}, {"warps": True, "key_bits": 20}):
        with testing.regime(**regime):
            query = ab.ContactQuery(scene, pairs)
            assert describe(query.run()) == describe(expected)
        for _ in range(2):
            hits = query.hits.face.numpy().copy()
            hits[:k], hits[k:] = rng.permutation(hits[:k]), -1
            query.hits.face.assign(hits)
            query.report()
            assert describe(query.result()) == describe(expected)


@wp.kernel
def divide_kernel(v: wp.array[wp.vec3d], s: wp.array[wp.float64], quotient_out: wp.array[wp.vec3d]):
    i = wp.tid()
    quotient_out[i] = divide_vector(v[i], s[i])


def test_divisions_are_rounded(device):
    """By the reciprocal on CUDA: usual numbers, powers of two and their neighbours, all exponents, zeros."""
    rng, count = np.random.default_rng(4), 300_000
    v, s = rng.uniform(1, 2, (count, 3)), rng.uniform(1, 2, count)
    near, odd = rng.integers(-9, 9, (count, 3)) * 2.0**-52, rng.integers(-9, 9, count) * 2.0**-52
    v[::3], s[::4] = 1 + near[::3], 1 + odd[::4]
    wide = rng.random(count) < 0.3
    v[wide], s[wide] = np.ldexp(v[wide], rng.integers(-1060, 1000, (wide.sum(), 3))), np.ldexp(s[wide], 30)
    v[rng.random((count, 3)) < 0.02] = -0.0
    assert launch(divide_kernel, device, count, v, s).tobytes() == (v / s[:, None]).tobytes()


def test_any_batch(device):
    scene, pairs = touching(device)
    whole, query = ab.ContactQuery(scene, pairs).run(), ab.ContactQuery(scene, pairs[:1])
    batch = np.append(np.random.default_rng(2).integers(0, len(pairs), 30), [12, 12, 0])
    query.set_pairs(pairs[batch])
    mixed = query.run()
    assert (mixed.count == 0).any()
    for row, p in enumerate(batch):
        mine, theirs = (part.contacts[part.contacts["pair"] == q] for part, q in ((mixed, row), (whole, p)))
        assert all(mine[name].tobytes() == theirs[name].tobytes() for name in mine.dtype.names[1:])
        assert mixed.pair_contacts[row].tobytes() == whole.pair_contacts[p].tobytes()
    query.set_pairs(pairs[[12, 12]])
    check_device_arrays(query, query.run())


def check_device_arrays(query, result):
    """What lies on the device is what the host was given; starts cover the rows of each pair."""
    start, k = query.start.numpy(), len(result.faces)
    assert len(start) == len(query.pairs) + 1 == len(query.pair_contacts.point) + 1
    rows = result.faces[:, 0]
    np.testing.assert_array_equal(start, np.searchsorted(rows, np.arange(len(start))))
    np.testing.assert_array_equal(query.faces.numpy()[:k], result.faces)
    for name in result.contacts.dtype.names[2:]:
        np.testing.assert_array_equal(getattr(query.contacts, name).numpy()[:k], result.contacts[name])
    for name in ("point", "normal"):
        found = getattr(query.pair_contacts, name).numpy()
        np.testing.assert_array_equal(found[: len(result.pairs)], result.pair_contacts[name])
        assert np.isnan(found[len(result.pairs) :]).all()


def test_pairs_of_the_broad_phase(device):
    scene, _ = touching(device, pairs=8)
    query = ab.ContactQuery(scene, capacity=ab.Buffers(pairs=7))
    result = query.run()
    assert len(result.pairs) == len(scene.broad_phase()) > 8
    check_device_arrays(query, result)
    assert describe(result) == describe(scene.intersect(result.pairs, output="contacts"))


def test_float32(device):
    scene, pairs = touching(device, pairs=3)
    full, query = ab.ContactQuery(scene, pairs).run(), ab.ContactQuery(scene, pairs, contact_dtype=np.float32)
    for small in (query.run(), scene.intersect(pairs, output="contacts", contact_dtype=np.float32)):
        for found, wanted in ((small.contacts, full.contacts), (small.pair_contacts, full.pair_contacts)):
            for name in wanted.dtype.names:
                real = wanted[name].dtype == np.float64
                expected = wanted[name].astype(np.float32) if real else wanted[name]
                assert found[name].dtype == expected.dtype and found[name].tobytes() == expected.tobytes()
    assert query.contacts.p0.dtype == wp.vec3d


def test_skewed_matrices(device):
    """A rotation that is off orthonormal by s carries ends off the posed mesh by at most 3 s of their distance."""
    rng, worst, matrices = np.random.default_rng(4), 0.0, np.tile(np.eye(4), (2, 1, 1))
    scene = in_a_row(device, "ball", (0,))
    scene.add(ab.Model.from_arrays(np.array([[-99.0, -99, 0], [99, -99, 0], [0, 99, 0]]), [[0, 1, 2]]))
    for _ in range(20):
        skew = rng.uniform(-1, 1, (3, 3))
        skew = np.eye(3) + (skew + skew.T) * 2e-7
        s = np.abs(skew.T @ skew - np.eye(3)).max()
        matrices[0, :3, :3], matrices[0, :3, 3] = skew, rng.uniform(-0.5, 0.5, 3)
        scene.set_poses(matrices)
        ends = scene.intersect([(0, 1)], output="contacts").contacts["p0"]
        off = np.abs(ends[:, 2]) / (s * np.linalg.norm(ends - matrices[0, :3, 3], axis=1))
        worst = max(worst, off.max())
        assert s < 1e-6 and len(ends) > 10
    assert 0.1 < worst <= 3.0


NEAR = int(NEAR_BIT)


def hits_of(device, rng, sizes, faces=2**31 - 1):
    """Hits of so many of each pair, each once, some apart, in any order; a few pairs of large and equal faces."""
    rows = []
    for pair, size in enumerate(sizes):
        a = rng.integers(0, faces if pair % 3 else 1 + pair, 2 * size + 8)
        unique = np.unique(np.stack([a, rng.integers(0, faces, len(a))], axis=1), axis=0)
        chosen = unique[rng.permutation(len(unique))[:size]]
        assert len(chosen) == size
        rows.append(np.column_stack([np.full(size, pair) | NEAR * rng.integers(0, 2, size), chosen]))
    return rng.permutation(np.concatenate(rows)).astype(np.int32)


def in_order(rows):
    return rows[np.lexsort((rows[:, 2], rows[:, 1], rows[:, 0] & (NEAR - 1)))]


def sort(device, found, sizes, threads, capacity=None, room=None, total=None, deferred=1):
    """Rows in order, starts and the deferred total, by a buffer of so much room, of which the first are sorted."""
    room = len(found) if room is None else room
    capacity = room if capacity is None else capacity
    hits = Hits()
    stored = np.full((room, 3), 7, np.int32)
    stored[: len(found)] = found[:room]
    hits.face = wp.array(stored, dtype=wp.vec3i, device=device)
    hits.count = wp.array(np.asarray(sizes, np.int64), device=device)
    hits.total = wp.array([len(found) if total is None else total], dtype=wp.int32, device=device)
    start = wp.full(len(sizes) + 1, -5, dtype=wp.int32, device=device)
    later = wp.full(deferred, 3, dtype=wp.int32, device=device)
    key = wp.full(2 * capacity, -1, dtype=wp.int64, device=device)
    rows = wp.full(capacity, wp.vec3i(-1, -1, -1), dtype=wp.vec3i, device=device)
    chunk = wp.zeros(capacity // 32 + len(sizes) if deferred else 0, dtype=wp.vec3i, device=device)
    make_segment_sort(hits, capacity, threads, key, rows, (start, later, chunk), wp.launch)
    if deferred:
        searched = wp.zeros_like(chunk)
        wp.launch(locate_chunk_kernel, dim=len(chunk), inputs=[start], outputs=[searched], device=device)
        used = int(start.numpy()[-1]) // 32 + len(sizes)
        np.testing.assert_array_equal(chunk.numpy()[:used], searched.numpy()[:used])
    return rows.numpy(), start.numpy(), later.numpy()


# Around a warp's keys, what a group holds in shared memory, and twice that.
SIZES = [0, 1, 2, 31, 0, 33, 64, 100, 255, 256, 257, 372, 1023, 1024, 1025, 2047, 2048, 2049, 4095, 4097, 20_000, 0, 5]


@pytest.mark.parametrize("threads", [32, 128, 256])
def test_segments_of_any_size(device, threads):
    rng = np.random.default_rng(threads)
    for round in range(3):
        sizes = rng.permutation(SIZES) if round else SIZES
        found = hits_of(device, rng, sizes)
        rows, start, deferred = sort(device, found, sizes, threads, room=len(found) + 50 * round)
        np.testing.assert_array_equal(rows[: len(found)], in_order(found))
        assert (rows[len(found) :] == -1).all() and deferred == 0
        np.testing.assert_array_equal(start, np.append(0, np.cumsum(sizes)))
    # More pairs than a block has threads, most of them of few hits, the last of none.
    for pairs in (1, SEGMENT_THREADS, SEGMENT_THREADS + 1, 3 * SEGMENT_THREADS + 77):
        sizes = rng.integers(0, 40, pairs) * (rng.random(pairs) < 0.7)
        sizes[-1] = pairs == 1
        found = hits_of(device, rng, sizes)
        rows, start, _ = sort(device, found, sizes, threads, deferred=0)
        np.testing.assert_array_equal(rows, in_order(found))
        np.testing.assert_array_equal(start, np.append(0, np.cumsum(sizes)))


@pytest.mark.parametrize("total", [None, -(2**31), 2**31 - 1])
def test_what_a_full_buffer_holds(device, total):
    """Counts are the demand, more than was stored: the rows there are stand in order."""
    rng = np.random.default_rng(2)
    sizes = rng.integers(0, 60, 2 * SEGMENT_THREADS + 9)
    found = hits_of(device, rng, sizes)
    for room, capacity in ((len(found) - 1, None), (2000, None), (1, None), (3000, 1200), (len(found) + 9, 2500)):
        if total is not None and room > len(found):
            continue
        rows, start, deferred = sort(device, found, sizes, 128, capacity, room, total)
        stored = found[: min(room, len(rows))]
        np.testing.assert_array_equal(rows, in_order(stored))
        pairs = np.sort(stored[:, 0] & (NEAR - 1))
        np.testing.assert_array_equal(start, np.searchsorted(pairs, np.arange(len(start))))
        assert deferred == 0


def test_counts_that_are_wrong_do_no_harm(device):
    """As where face pairs are missing that wait for a later stage, or totals have wrapped."""
    rng = np.random.default_rng(3)
    sizes = rng.integers(0, 50, 40)
    found = hits_of(device, rng, sizes)
    for wrong in (np.zeros(40), sizes + 1, sizes + np.arange(40) * 2**32, np.full(40, 2**62)):
        rows, start, _ = sort(device, found, wrong, 32)
        np.testing.assert_array_equal(rows, in_order(found))
        np.testing.assert_array_equal(start, np.append(0, np.cumsum(sizes)))


def test_which_sort():
    assert [segment_threads(k * 1024, 1024, None) for k in (1, 64, 65, 500, 600, 2048)] == [32, 32, 128, 128, 256, 256]
    assert segment_threads(60_000, 1, None) == segment_threads(2049 * 64, 64, None) == 0
    assert segment_threads(60_000, 1, True) == 256 and segment_threads(1024, 1024, False) == 0
    assert segment_threads(2**30, 2**19, True) == segment_threads(2**17, 2**18, None) == 0
    assert SEGMENT_KEYS * 256 == 2048


@pytest.mark.parametrize("options", [{}, {"gap": 0.05}, {"precision": "float32"}])
def test_answers_of_either_sort(device, options):
    scene, pairs = touching(device, pairs=6)
    answers = []
    for segments in (False, True):
        with testing.regime(segments=segments, warps=True, packs_results=True):
            query = ab.ContactQuery(scene, pairs, **options)
            result = query.run()
            faces = ab.Query(scene, "faces", pairs=pairs, precision=options.get("precision", "exact"))
            listed = [faces.run().faces, faces.run().faces, faces.result(device=True).faces.numpy()]
            assert (int(query.hits.count.numpy().sum()) == len(result.faces)) and len(result.faces) > 500
        answers.append([getattr(result, name).tobytes() for name in ("count", "faces", "contacts", "pair_contacts")])
        with testing.regime(segments=segments, warps=True):
            points = ab.ManifoldQuery(scene, pairs, gap=options.get("gap")).run().points
        answers[-1] += [values.tobytes() for values in points.values()]
        assert len(points["pair"]) > 0
        answers[-1] += [query.start.numpy().tobytes(), *(rows.tobytes() for rows in listed)]
    assert answers[0] == answers[1]


def test_sort_in_a_graph(device):
    """Captured with its launch, and replayed at other poses, in a buffer that becomes full."""
    if not wp.get_device(device).is_cuda:
        pytest.skip("one thread of the CPU sorts")
    scene, pairs = touching(device, pairs=6)
    query, poses = ab.ContactQuery(scene, pairs), scene.poses
    query.run()
    query.make_room(hits=4 * len(query.hits.face))
    query.launch()
    with wp.ScopedCapture(device) as capture:
        query.launch()
    for step in range(4):
        poses[1::2, 1] += 0.2 * step
        scene.set_poses(poses)
        wp.capture_launch(capture.graph)
        found = query.result()
        with testing.regime(segments=False):
            expected = ab.ContactQuery(scene, pairs).run()
        assert found.contacts.tobytes() == expected.contacts.tobytes() and len(found.faces) > 0


def with_margins(count, dtype, device):
    """Return an array, and the whole of which it is the middle."""
    whole = wp.zeros(3 * count, dtype=dtype, device=device)
    whole.fill_(-9)
    return whole[count : 2 * count], whole


@pytest.mark.parametrize("threads", [32, 256])
@pytest.mark.parametrize("lowest, highest", [(0, 2**30), (0, 1), (99, 100), (-(2**31), 2**31)])
def test_rows_that_no_launch_has_written_stay_in_bounds(device, threads, lowest, highest):
    """A buffer may be new where a readout sorts ahead of the check that there was a launch; counts are of before."""
    rng, sizes = np.random.default_rng(3), np.full(40, 70)
    capacity, hits = int(sizes.sum()), Hits()
    rows = rng.integers(lowest, highest, (capacity, 3), dtype=np.int64).astype(np.int32)
    hits.face = wp.array(rows, dtype=wp.vec3i, device=device)
    hits.count = wp.array(sizes, dtype=wp.int64, device=device)
    hits.total = wp.array([capacity], dtype=wp.int32, device=device)
    key, keys = with_margins(2 * capacity, wp.int64, device)
    found, all_found = with_margins(3 * capacity, wp.int32, device)
    start, starts = with_margins(len(sizes) + 1, wp.int32, device)
    none = wp.empty(0, dtype=wp.int32, device=device), wp.empty(0, dtype=wp.vec3i, device=device)
    found = wp.array(ptr=found.ptr, shape=capacity, dtype=wp.vec3i, device=device)
    make_segment_sort(hits, capacity, threads, key, found, (start, *none), wp.launch)
    for whole in (keys, all_found, starts):
        third = len(whole) // 3
        assert (whole.numpy()[:third] == -9).all() and (whole.numpy()[2 * third :] == -9).all()
