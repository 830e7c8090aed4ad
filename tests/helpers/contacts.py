"""Contacts by definition: exact clipping of triangles, distances, and sums over a pair's contacts to the bit."""

from fractions import Fraction

import numpy as np
from oracles.triangle import cross, dot, sub

import warp_abtree as ab
from helpers.scenes import scene_with

CHUNK = 32  # contacts that are summed from left to right before sums are; part of the definition


def exact_normal(triangle):
    a, b, c = ([Fraction(x) for x in p] for p in np.asarray(triangle).tolist())
    return cross(sub(b, a), sub(c, a))


def lies_in_plane(b, a):
    """Whether triangle B lies in the plane of A; of any that has no area, always."""
    origin = [Fraction(x) for x in a[0].tolist()]
    return all(dot(exact_normal(a), sub([Fraction(x) for x in p], origin)) == 0 for p in b.tolist())


def unit(v):
    """Unit vector of exact components; zero stays."""
    scale = max(abs(x) for x in v)
    if scale == 0:
        return np.zeros(3)
    v = np.array([float(x / scale) for x in v])
    return v / np.linalg.norm(v)


def scaled(v):
    """Return the largest component's magnitude, and the vector divided by it."""
    largest = np.abs(v).max()
    return largest, v / largest if largest else v


def length(v):
    largest, u = scaled(v)
    return largest * np.sqrt(dot(u, u))


def summed(terms):
    """Sum chunks of terms from left to right, then their sums."""
    zero = terms[0] * 0.0
    return sum((sum(terms[k : k + CHUNK], zero) for k in range(0, len(terms), CHUNK)), zero)


def summary(rows):
    """Return (point, normal) of a pair's contacts; None for a normal that the mean does not tell."""
    origin, count = rows["p0"][0], len(rows)
    lengths = [length(q - p) for p, q in zip(rows["p0"], rows["p1"])]
    total = summed(lengths)
    weights = [x / total for x in lengths] if total else [1.0 / count] * count
    ends = list(zip(weights, rows["p0"], rows["p1"]))
    middle = summed([w * (0.5 * (p - origin) + 0.5 * (q - origin)) for w, p, q in ends])
    mean = summed([w * n for w, n in zip(weights, rows["normal"])])
    if length(mean) <= 2.0**-20:
        return origin + middle, None
    _, n = scaled(mean)
    return origin + middle, n / np.sqrt(dot(n, n))


def check_summaries(result):
    """Compare every pair's summary to the bit."""
    assert len(result.pair_contacts) == len(result.pairs) and result.pair_contacts["count"].dtype == np.int64
    np.testing.assert_array_equal(result.pair_contacts["count"], result.count)
    for p, got in enumerate(result.pair_contacts):
        rows = result.contacts[result.contacts["pair"] == p]
        assert len(rows) == result.count[p]
        if not len(rows):
            assert np.isnan(got["point"]).all() and np.isnan(got["normal"]).all()
            continue
        point, normal = summary(rows)
        assert got["point"].tobytes() == point.tobytes()
        assert normal is None or got["normal"].tobytes() == normal.tobytes()
        assert abs(np.linalg.norm(got["normal"]) - 1) < 1e-15


def check_mirrored(rows, swapped):
    """Check that contacts are those of the same pairs named the other way, in their order."""
    rows = rows[np.lexsort((*rows["faces"].T, rows["pair"]))]
    np.testing.assert_array_equal(swapped["faces"], rows["faces"][:, ::-1])
    np.testing.assert_array_equal(swapped["normal"], -rows["normal"])
    other = {"p0": "p1", "p1": "p0", "normal_a": "normal_b", "normal_b": "normal_a"}
    for name in set(rows.dtype.names) - {"faces", "normal"}:
        np.testing.assert_array_equal(swapped[name], rows[other.get(name, name)])


def ask_points(device, *placed, **options):
    """Return the query of contact points in a scene of (model, pose), and what it finds."""
    query = ab.ManifoldQuery(scene_with(device, *placed), **options)
    return query, query.run()
