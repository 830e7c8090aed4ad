"""Hits sorted by a segment a pair: rows and starts of any sizes, full buffers, and the same answers as a radix sort."""

import numpy as np
import pytest
import warp as wp
from helpers.samples import sample

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.kernels.contacts.chunks import locate_chunk_kernel
from warp_abtree.kernels.intersect.face_pairs import NEAR_BIT, Hits
from warp_abtree.kernels.io.sort_segments import SEGMENT_KEYS, SEGMENT_THREADS
from warp_abtree.query.sorting import make_segment_sort, segment_threads

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


@pytest.mark.parametrize("threads", [32, 128, 256])
def test_pairs_of_many_tiles(device, threads):
    """More pairs than a block has threads, most of them of few hits, the last of none."""
    rng = np.random.default_rng(1)
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


def laid_out(device, pairs=40):
    """A scene of pairs of objects, some of them apart, the pairs, and the poses of all objects."""
    scene, rng, given, poses = ab.Scene(device), np.random.default_rng(5), [], []
    for p in range(pairs):
        turn = rng.normal(size=4)
        place = rng.uniform(-1, 1, 3) * (0.6 if p % 5 else 3)
        poses.append((9.0 * p, 0, 0, 0, 0, 0, 1))
        poses.append((*(place + (9.0 * p, 0, 0)), *(turn / np.linalg.norm(turn))))
        scene.add(sample("ball" if p % 2 else "torus"), poses[-2])
        scene.add(sample("ball"), poses[-1])
        given.append((2 * p, 2 * p + 1) if p % 3 else (2 * p + 1, 2 * p))
    return scene, np.array(given), np.array(poses)


@pytest.mark.parametrize("options", [{}, {"gap": 0.05}, {"precision": "float32"}])
def test_answers_of_either_sort(device, options):
    scene, pairs, _ = laid_out(device)
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
    scene, pairs, poses = laid_out(device)
    query = ab.ContactQuery(scene, pairs)
    query.run()
    query.resize(4 * len(query.hits.face))
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
