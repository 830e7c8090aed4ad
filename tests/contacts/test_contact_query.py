"""Contacts as an operator: the order of rows, the shape of sums to the bit, capacities, and capture."""

import numpy as np
import pytest
import warp as wp
from helpers.contacts import CHUNK, check_summaries
from helpers.faults import describe
from helpers.questions import in_a_row, pairs_of, scene_of
from helpers.samples import STILL, contact_poses, sample

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.kernels.triangle.segment import divide_vector

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


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
    assert check_summaries(expected) > 5 and (expected.count > 2 * CHUNK).sum() > 3
    rng, k = np.random.default_rng(1), len(expected.faces)
    for bits in (63, 20):  # too few for a pair and two faces: sorted twice
        with testing.regime(key_bits=bits):
            query = ab.ContactQuery(scene, pairs)
        assert describe(query.run()) == describe(expected)
        for _ in range(2):
            hits = query.hits.face.numpy().copy()
            hits[:k], hits[k:] = rng.permutation(hits[:k]), -1
            query.hits.face.assign(hits)
            query.find_contacts()
            assert describe(query.result()) == describe(expected)


@pytest.mark.parametrize("gap", [None, 0.05])
def test_vector_code_is_the_same_as_one_by_one(gap):
    """The CPU's kernels against those that warps run, each of one thread: sorting, contacts and sums."""
    scene, pairs = touching("cpu")
    expected = ab.ContactQuery(scene, pairs, gap=gap).run()
    for regime in ({"warps": True}, {"warps": True, "key_bits": 20}):
        with testing.regime(**regime):
            query = ab.ContactQuery(scene, pairs, gap=gap)
            assert describe(query.run()) == describe(expected)


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
    quotient = wp.empty(count, dtype=wp.vec3d, device=device)
    inputs = [wp.array(v, dtype=wp.vec3d, device=device), wp.array(s, dtype=wp.float64, device=device), quotient]
    wp.launch(divide_kernel, count, inputs, device=device)
    assert quotient.numpy().tobytes() == (v / s[:, None]).tobytes()


def test_any_batch(device):
    """A pair's contacts and their sum are the same alone, repeated and in any place."""
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


def check_device_arrays(query, result):
    """What lies on the device is what the host was given; starts cover the rows of each pair."""
    start, k = query.start.numpy(), len(result.faces)
    assert len(start) == len(query.pairs) + 1 == len(query.pair_contacts.travel) + 1
    rows = result.faces[:, 0]
    np.testing.assert_array_equal(start, np.searchsorted(rows, np.arange(len(start))))
    np.testing.assert_array_equal(query.faces.numpy()[:k], result.faces)
    for name in result.contacts.dtype.names[2:]:
        np.testing.assert_array_equal(getattr(query.contacts, name).numpy()[:k], result.contacts[name])
    for name in ("point", "normal", "travel"):
        found = getattr(query.pair_contacts, name).numpy()
        np.testing.assert_array_equal(found[: len(result.pairs)], result.pair_contacts[name])
        beyond = found[len(result.pairs) :]
        assert (beyond == 0).all() if name == "travel" else np.isnan(beyond).all()


def test_pairs_of_the_broad_phase(device):
    scene, _ = touching(device, pairs=8)
    query = ab.ContactQuery(scene, capacity=ab.Buffers(pairs=7))
    result = query.run()
    assert len(result.pairs) == len(scene.broad_phase()) > 8
    check_device_arrays(query, result)
    assert describe(result) == describe(scene.intersect(result.pairs, output="contacts"))


def test_nothing_to_find(device):
    scene, pairs = touching(device, pairs=2)
    query = ab.ContactQuery(scene, pairs)
    assert len(query.run().contacts) > 0
    query.set_pairs(np.array([(0, 4), (4, 1)]))
    result = query.run()
    assert len(result.contacts) == 0 and result.faces.shape == (0, 3) and len(result.pair_contacts) == 2
    check_summaries(result)
    check_device_arrays(query, result)
    query.set_pairs([])
    lone = ab.ContactQuery(in_a_row(device, "box", (0,)))
    for none in (query.run(), scene.intersect([], output="contacts"), lone.run()):
        assert none.contacts.shape == none.pair_contacts.shape == none.count.shape == (0,)
        assert none.faces.shape == (0, 3) and none.faces.dtype == np.int32 and none.contacts["p0"].shape == (0, 3)


def test_other_poses_and_distances(device):
    """A query goes on with the poses of each launch, and proves distances beside contacts."""
    scene = in_a_row(device, "ball", (0, 1.5, 4))
    query = ab.ContactQuery(scene, [(0, 1), (1, 2), (0, 2)], within=1.0)
    first = query.run()
    np.testing.assert_array_equal(first.apart, [False, False, True])
    kept = first.contacts.copy()
    scene.set_poses([(9, 0, 0, 0, 0, 0, 1), STILL, (0.2, 1.5, 0, 0, 0, 0, 1)])
    assert describe(query.run()) == describe(scene.intersect(query.pairs.numpy(), output="contacts", within=1.0))
    np.testing.assert_array_equal(query.result().any, [False, True, False])
    np.testing.assert_array_equal(first.contacts, kept, "results on the host stay as they were")


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
