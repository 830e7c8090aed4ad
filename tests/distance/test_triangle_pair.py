"""Distances of face pairs against integers: random ones, and those that are hard for float64."""

import numpy as np
import pytest
import warp as wp
from helpers.questions import launch
from oracles.triangle import pairs_intersect
from oracles.triangle_distance import triangle_distance as true_distance

from warp_abtree.kernels.triangle.distance import scale_triangles
from warp_abtree.kernels.triangle.triangle_pair import PAIR_ROUNDING, feature_weights, nearest_features

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

KINDS = ("random", "parallel edges", "nearly parallel edges", "shared corners", "slivers", "caps", "zero area")
KINDS += ("coplanar", "nearly touching", "huge and tiny", "lattice", "far from the origin")
ROUNDING = float(PAIR_ROUNDING)


@wp.kernel
def measure_pair_kernel(corners: wp.array2d[wp.vec3d], answer_out: wp.array2d[wp.float64]):
    i = wp.tid()
    t = scale_triangles(corners[i, 0], corners[i, 1], corners[i, 2], corners[i, 3], corners[i, 4], corners[i, 5])
    near = nearest_features(t)
    a, b = feature_weights(near)
    answer_out[i, 0] = wp.sqrt(near.square) * t.size
    for k in range(3):
        answer_out[i, 1 + k] = a[k]
        answer_out[i, 4 + k] = b[k]


def measure(device, pairs):
    """Return distances and weights of the nearest points, (k,) and (k, 2, 3)."""
    answers = launch(measure_pair_kernel, device, len(pairs), pairs.reshape(-1, 6, 3), columns=7)
    return answers[:, 0], answers[:, 1:].reshape(-1, 2, 3)


def make_pairs(kind, rng, count):
    """Return pairs of triangles, float64 (count, 2, 3, 3), some of them crossing."""
    pairs = rng.normal(size=(count, 2, 3, 3))
    pairs[:, 1] += rng.normal(size=(count, 1, 3)) * rng.choice([0.1, 1, 10], (count, 1, 1))
    a, b = pairs[:, 0], pairs[:, 1]
    small = 2.0 ** -rng.integers(5, 50, (count, 1))
    if kind == "parallel edges":
        b[:, 1] = b[:, 0] + (a[:, 1] - a[:, 0]) * rng.choice([-1, 0.5, 1, 2], (count, 1))
    elif kind == "nearly parallel edges":
        b[:, 1] = b[:, 0] + (a[:, 1] - a[:, 0]) + small * rng.normal(size=(count, 3))
        b += (a[:, :1] - b[:, :1]) * (1 - small[:, None] * rng.choice([1, 0.1, 1e-3], (count, 1, 1)))
    elif kind == "shared corners":
        b[:, 0] = a[:, rng.integers(3)] + small * rng.normal(size=(count, 3)) * rng.choice([0, 1], (count, 1))
    elif kind in ("slivers", "caps"):
        for t in (a, b):
            at = rng.random((count, 1)) if kind == "caps" else 0.0
            t[:, 2] = t[:, 0] + at * (t[:, 1] - t[:, 0]) + small * rng.normal(size=(count, 3))
    elif kind == "zero area":
        pairs[:] = np.round(pairs * 64) / 64
        a[:, 2] = np.where(rng.random((count, 1)) < 0.5, (a[:, 0] + a[:, 1]) / 2, a[:, 0])
        b[:, 1:] = np.where(rng.random((count, 1, 1)) < 0.5, b[:, :1], b[:, 1:])
    elif kind == "coplanar":
        pairs[..., 2] = rng.integers(0, 2, (count, 2, 1)) * small[:, :, None]
    elif kind == "nearly touching":
        weights = rng.dirichlet(np.ones(3), count)
        b += np.einsum("nk,nkx->nx", weights, a)[:, None] - b[:, :1]
        normal = np.cross(a[:, 1] - a[:, 0], a[:, 2] - a[:, 0])
        b += (small * normal)[:, None]
        turn = np.sign(np.einsum("nkx,nx->nk", b - b[:, :1], normal))[..., None]
        b[:, 1:] = (b[:, :1] + (b - b[:, :1]) * turn)[:, 1:]
    elif kind == "huge and tiny":
        pairs *= 2.0 ** rng.integers(-90, 90, (count, 1, 1, 1))
        b *= 2.0 ** rng.integers(-60, 5, (count, 1, 1))
    elif kind == "lattice":
        pairs[:] = np.round(1.5 * pairs)
    elif kind == "far from the origin":
        pairs += 2.0 ** rng.integers(0, 40, (count, 1, 1, 1))
    return pairs


def apart(pairs):
    """Return the pairs that do not intersect, decided exactly."""
    index = np.arange(6 * len(pairs)).reshape(-1, 2, 3)
    points, rows = pairs.reshape(-1, 3), np.arange(len(pairs))
    return pairs[~pairs_intersect(points, index[:, 0], points, index[:, 1], np.stack([rows, rows], 1))]


@pytest.mark.parametrize("kind", KINDS)
def test_equals_integers(device, kind):
    pairs = apart(make_pairs(kind, np.random.default_rng(1), 800))
    assert len(pairs) > 100
    distances, weights = measure(device, pairs)
    truth = np.array([true_distance(a, b) for a, b in pairs])
    size = np.abs(pairs[:, :, :, None] - pairs[:, :1, :1, None]).max((1, 2, 3, 4))
    assert (np.abs(distances - truth) / size).max() < ROUNDING
    assert ((weights >= -(2.0**-52)) & (weights <= 1)).all()
    np.testing.assert_allclose(weights.sum(2), 1, rtol=0, atol=2.0**-51)
    points = np.einsum("npk,npkx->npx", weights, pairs)
    between = np.linalg.norm(points[:, 0] - points[:, 1], axis=1)
    reach = np.abs(pairs).max((1, 2, 3))
    assert (np.abs(between - distances) <= 2.0**-49 * reach).all()
    swapped, _ = measure(device, pairs[:, ::-1])
    assert (np.abs(swapped - distances) / size).max() < ROUNDING


def test_oracle_knows_distances():
    flat = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]])
    above = np.array([[1.0, 1, 3], [2, 2, 5], [0, 1, 6]])
    assert true_distance(flat, above) == 3
    assert true_distance(flat, flat + [7, -8, 0]) == 5
    assert true_distance(flat, np.array([[-1.0, 1, 1], [-1, 1, 2], [-1, 2, 1]])) == np.sqrt(2)
    crossing_lines = np.array([[3.0, -1, 2], [3, 1, 2], [9, 0, 9]])
    assert true_distance(np.array([[0.0, 0, 0], [4, 0, 0], [0, 0, -9]]), crossing_lines) == 2
    assert true_distance(np.ldexp(flat, 600), np.ldexp(above, 600)) == np.ldexp(3.0, 600)
