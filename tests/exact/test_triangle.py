"""The triangle test against exact arithmetic, degenerate cases above all."""

from functools import partial

import numpy as np
import pytest
import warp as wp
from conftest import slow
from helpers.questions import launch
from oracles import triangle as oracle

from warp_abtree.kernels import native
from warp_abtree.kernels.exact.predicates import EXACT, FILTER, UNCERTAIN
from warp_abtree.kernels.triangle.float64_filter import decide_triangles

wp.set_module_options(native.options("base/lanes.cuh", "exact/determinant.cuh"))


@wp.kernel
def intersect_kernel(mode: int, corners: wp.array2d[wp.vec3d], meet_out: wp.array[int]):
    """Test triangles corners[i, :3] and corners[i, 3:]."""
    i = wp.tid()
    a, b, c, d, e, f = corners[i, 0], corners[i, 1], corners[i, 2], corners[i, 3], corners[i, 4], corners[i, 5]
    meet_out[i] = decide_triangles(mode, a, b, c, d, e, f)


def meet(pairs, device):
    """Return the kernel's answers for triangle pairs (k, 2, 3, 3), with which the filter agrees where it is sure."""
    corners = pairs.reshape(-1, 6, 3)
    exact, found = (launch(intersect_kernel, device, len(pairs), int(mode), corners) for mode in (EXACT, FILTER))
    sure = found != int(UNCERTAIN)
    np.testing.assert_array_equal(found[sure], exact[sure])
    return exact != 0


def generic(rng, count):
    """Triangles of all sizes near each other."""
    size = 2.0 ** rng.uniform(-3, 1, (count, 2, 1, 1))
    return rng.normal(size=(count, 2, 3, 3)) * size + 0.5 * rng.normal(size=(count, 2, 1, 3))


def lattice(size, rng, count):
    """Corners on a small lattice: most pairs touch, are coplanar or have zero area."""
    return rng.integers(0, size, (count, 2, 3, 3)).astype(float)


def in_plane(rng, count):
    """Both triangles in one oblique plane, some of them segments and points."""
    u, v, origin = (rng.integers(-(2**9), 2**9, (count, 1, 1, 3)).astype(float) for _ in range(3))
    s, t = (rng.integers(-2, 3, (count, 2, 3, 1)).astype(float) for _ in range(2))
    return u * s + v * t + origin


def grazing(rng, count):
    """An edge of either passes the other's a rounding away: planes are sure, and one sign of edges is not."""
    a, b = rng.normal(size=(2, count, 3, 3))
    foot = a[:, :1] + rng.uniform(0.1, 0.9, (count, 1, 1)) * (a[:, 1:2] - a[:, :1])
    way = rng.normal(size=(count, 1, 3))
    b[:, :2] = foot + np.array([[-1.0], [1.0]]) * rng.uniform(0.2, 1, (count, 2, 1)) * way
    return np.stack([a, b], 1)


def along_axes(rng, count):
    """A segment on an axis, and corners in the planes of coordinates that hold it: zeros that float64 is sure of."""
    pairs = rng.integers(-3, 4, (count, 2, 3, 3)).astype(float)
    pairs[:, 0, :, 1:] = 0.0
    rows, other = np.nonzero(np.ones((count, 3)))
    pairs[rows, 1, other, rng.integers(1, 3, 3 * count)] = 0.0
    return np.take_along_axis(pairs, rng.permuted(np.tile(np.arange(3), (count, 1)), axis=1)[:, None, None], 3)


def hardly_off(rng, count):
    """As touching, but corners that leave the plane do so by less than float64 is sure of."""
    pairs = touching(rng, count)
    pairs[:, 1] += 2.0**-40 * rng.integers(-1, 2, (count, 3, 1)) * rng.integers(-3, 4, (count, 3, 3))
    return pairs


def touching(rng, count):
    """The second triangle starts on a corner, an edge or the inside of the first, and some of it lies in its plane."""
    a = 4.0 * rng.integers(-(2**8), 2**8, (count, 3, 3))
    weight = rng.choice([0.0, 0.25, 0.5, 1.0, -0.5], (count, 3, 3))
    weight[:, :, 2] = 1 - weight[:, :, 0] - weight[:, :, 1]
    b = (weight[:, :, :, None] * a[:, None]).sum(2)
    off = rng.integers(0, 2, (count, 3, 1)) * rng.integers(-64, 65, (count, 3, 3))
    off[:, 0] = 0
    return np.stack([a, b + off], 1)


def collinear(lines, rng, count):
    """Segments and points of one line, or of two and against triangles."""
    origin, way = rng.integers(-4, 5, (2, count, lines, 1, 3)).astype(float)
    segment = origin + way * rng.integers(-4, 5, (count, 2, 3, 1))
    whole = rng.random((count, 2, 1, 1)) < (0.3 if lines > 1 else 0.0)
    return np.where(whole, rng.integers(-4, 5, (count, 2, 3, 3)), segment).astype(float)


# Determinants of these small integers are exact in float64, so no answer may differ; generic ones are never so near.
KINDS = {
    "generic": (generic, 20_000),
    "lattice of 2": (partial(lattice, 2), 10_000),
    "lattice of 3": (partial(lattice, 3), 20_000),
    "lattice of 6": (partial(lattice, 6), 15_000),
    "in one plane": (in_plane, 15_000),
    "touching": (touching, 15_000),
    "hardly off": (hardly_off, 15_000),
    "grazing": (grazing, 15_000),
    "along axes": (along_axes, 10_000),
    "collinear": (partial(collinear, 2), 15_000),
    "on one line": (partial(collinear, 1), 5_000),
}


@pytest.mark.parametrize("share", [5, *slow(1)])
@pytest.mark.parametrize("kind", KINDS)
def test_answers_are_exact(device, kind, share):
    make, count = KINDS[kind]
    rng, count = np.random.default_rng(1), count // share
    pairs = make(rng, count)
    faces, rows = np.arange(3 * count).reshape(-1, 3), np.tile(np.arange(count)[:, None], 2)
    points_a, points_b = pairs[:, 0].reshape(-1, 3), pairs[:, 1].reshape(-1, 3)
    expected = oracle.pairs_intersect(points_a, faces, points_b, faces, rows)
    assert 0.02 < expected.mean() < 0.99, "both answers need to occur"
    order = rng.permuted(np.tile(np.arange(3), (count, 2, 1)), axis=2)
    pairs = np.take_along_axis(pairs, order[:, :, :, None], 2)
    pairs = np.where(rng.random((count, 1, 1, 1)) < 0.5, pairs, pairs[:, ::-1])
    scale = rng.choice([0, -280, -100, -30, 30, 100, 280], (count, 1, 1, 1))
    wrong = pairs[meet(np.ldexp(pairs, scale), device) != expected]
    assert len(wrong) == 0, f"{len(wrong)} wrong, first: {wrong[0].tolist()}"
