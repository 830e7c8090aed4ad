"""Expansions and signs of all stages against fractions."""

from fractions import Fraction

import numpy as np
import pytest
import warp as wp
from helpers.orient import orient2d_kernel, sum_of_product_kernel
from oracles.signs import COUNT, KINDS, find_signs, random_floats, rounded_signs, true_signs, true_terms

from warp_abtree.kernels.arithmetic.double_word import double_orient2d, double_orient3d
from warp_abtree.kernels.arithmetic.expansion import exact_orient2d, exact_orient3d, two_product, two_sum
from warp_abtree.kernels.arithmetic.predicates import (
    EXACT,
    FILTER,
    FLOAT32,
    UNCERTAIN,
    orient3d,
    orient_edges,
)
from warp_abtree.kernels.triangle.float32_filter import (
    FLOAT32_UNIT,
    add_signs,
    heights_over_plane,
    one_sided,
    side_of_plane,
)

MODULE_OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(MODULE_OPTIONS)


@wp.kernel
def two_sum_kernel(a: wp.array(dtype=wp.float64), b: wp.array(dtype=wp.float64), out: wp.array2d(dtype=wp.float64)):
    i = wp.tid()
    high, low = two_sum(a[i], b[i])
    out[0, i] = high
    out[1, i] = low


@wp.kernel
def two_product_kernel(a: wp.array(dtype=wp.float64), b: wp.array(dtype=wp.float64), out: wp.array2d(dtype=wp.float64)):
    i = wp.tid()
    high, low = two_product(a[i], b[i])
    out[0, i] = high
    out[1, i] = low


@wp.kernel
def orient3d_kernel(mode: wp.int32, points: wp.array2d(dtype=wp.vec3d), out: wp.array(dtype=wp.int32)):
    i = wp.tid()
    out[i] = orient3d(mode, points[i, 0], points[i, 1], points[i, 2], points[i, 3])


@wp.kernel
def orient_edges_kernel(mode: wp.int32, points: wp.array2d(dtype=wp.vec3d), out: wp.array(dtype=wp.int32)):
    i = wp.tid()
    out[i] = orient_edges(mode, points[i, 0], points[i, 1], points[i, 2], points[i, 3])


@wp.kernel
def expansion3d_kernel(mode: wp.int32, points: wp.array2d(dtype=wp.vec3d), out: wp.array(dtype=wp.int32)):
    i = wp.tid()
    out[i] = exact_orient3d(points[i, 0], points[i, 1], points[i, 2], points[i, 3])


@wp.kernel
def expansion2d_kernel(mode: wp.int32, points: wp.array2d(dtype=wp.vec2d), out: wp.array(dtype=wp.int32)):
    i = wp.tid()
    out[i] = exact_orient2d(points[i, 0], points[i, 1], points[i, 2])


@wp.kernel
def double3d_kernel(points: wp.array2d(dtype=wp.vec3d), out: wp.array(dtype=wp.float64)):
    i = wp.tid()
    out[i] = double_orient3d(points[i, 0], points[i, 1], points[i, 2], points[i, 3])[0]


@wp.kernel
def double2d_kernel(points: wp.array2d(dtype=wp.vec2d), out: wp.array(dtype=wp.float64)):
    i = wp.tid()
    out[i] = double_orient2d(points[i, 0], points[i, 1], points[i, 2])[0]


@wp.kernel
def float32_signs_kernel(
    error: wp.array(dtype=wp.float32),
    unit: wp.float32,
    points: wp.array2d(dtype=wp.vec3),
    out: wp.array2d(dtype=wp.int32),
):
    i = wp.tid()
    a, b, c, d, e, f = points[i, 0], points[i, 1], points[i, 2], points[i, 3], points[i, 4], points[i, 5]
    heights, bound = heights_over_plane(error[i], unit, b - a, c - a, a - d, a - e, a - f)
    signs = add_signs(0, heights, bound)
    for k in range(3):
        pair = (signs >> (4 - 2 * k)) & 3
        out[i, k] = wp.where(pair == 2, 1, wp.where(pair == 1, -1, wp.where(bound == 0.0, 0, UNCERTAIN)))
    out[i, 6] = one_sided(heights, bound)
    out[i, 3] = side_of_plane(error[i], unit, a, b, c, d)
    out[i, 4] = side_of_plane(error[i], unit, a, b, c, e)
    out[i, 5] = side_of_plane(error[i], unit, a, b, c, f)


def apply(kernel, a, b, device):
    arrays = [wp.array(x, dtype=wp.float64, device=device) for x in (a, b)]
    out = wp.zeros((2, len(a)), dtype=wp.float64, device=device)
    wp.launch(kernel, dim=len(a), inputs=arrays, outputs=[out], device=device)
    return out.numpy()


def check_exact(got, expected, rounded):
    high, low = got
    np.testing.assert_array_equal(high, rounded)
    for h, t, x in zip(high.tolist(), low.tolist(), expected):
        assert Fraction(h) + Fraction(t) == x


@pytest.mark.parametrize("kernel", [two_sum_kernel, sum_of_product_kernel], ids=lambda k: k.key)
def test_two_sum_loses_nothing(device, kernel):
    rng = np.random.default_rng(1)
    a = random_floats(rng, 3000, -500, 450)
    b = np.concatenate([np.ldexp(a[:2000], rng.integers(-110, 50, 2000)), random_floats(rng, 1000, -500, 450)])
    b[:1000] *= -rng.uniform(1, 2, 1000)
    if kernel is two_sum_kernel:
        extreme = [0.0, -0.0, 5e-324, -5e-324, 2.0**-1022, 1.0, -1.0, np.nextafter(1, 2), 2.0**1022, -(2.0**1022)]
        x, y = np.meshgrid(extreme, extreme)
        a, b = np.concatenate([a, x.ravel()]), np.concatenate([b, y.ravel()])
        first, second = a, b
    else:
        first, second = a * b, a
    expected = [Fraction(x) + Fraction(y) for x, y in zip(first.tolist(), second.tolist())]
    check_exact(apply(kernel, a, b, device), expected, first + second)


def test_two_product_loses_nothing(device):
    """Wherever the error is no smaller than float64's grid; whole multiples of 2^-342 are among that."""
    rng = np.random.default_rng(2)
    a, b = random_floats(rng, 3000, -430, 500), random_floats(rng, 3000, -430, 500)
    a[:500] = rng.integers(-(2**53), 2**53, 500) * 2.0**-342
    b[:500] = rng.integers(-(2**53), 2**53, 500) * 2.0**-684
    a[500:510], b[505:515] = 0.0, 0.0
    expected = [Fraction(x) * Fraction(y) for x, y in zip(a.tolist(), b.tolist())]
    check_exact(apply(two_product_kernel, a, b, device), expected, a * b)


# --- signs ------------------------------------------------------------------------------------------------------------


def nearly_collinear(rng, dim):
    """Every difference, product and sum of the determinant of three points nearly on a line rounds."""
    points = np.empty((20_000, 3, 2))
    a, b, c = points[:, 0], points[:, 1], points[:, 2]
    c[:] = rng.uniform(1, 2, c.shape)
    a[:] = rng.uniform(-0.1, 0.1, a.shape)
    b[:] = c + rng.uniform(0.5, 2.0, (len(b), 1)) * (a - c) + 2.0**-52 * rng.integers(-4, 5, b.shape)
    return points


FORMS = {"2D": (2, orient2d_kernel), "3D": (3, orient3d_kernel), "edges": (3, orient_edges_kernel)}
EXPANSIONS = {"2D": expansion2d_kernel, "3D": expansion3d_kernel}
CASES = [(form, kind) for form in FORMS for kind in KINDS] + [("2D", "nearly collinear")]
# Kinds on which determinants rounded to float64 have a wrong sign.
ROUNDED_WRONG = {"coplanar", "large coplanar", "nearly collinear"}


def check_filter(kernel, points, truth, device):
    """Compare the signs that the filter is sure of; return which those are."""
    signs = find_signs(kernel, FILTER, points, device)
    sure = signs != int(UNCERTAIN)
    np.testing.assert_array_equal(signs[sure], truth[sure])
    return sure


@pytest.mark.parametrize(("form", "kind"), CASES, ids=map("-".join, CASES))
def test_signs(device, form, kind):
    """EXACT and the expansions alone are always right, FILTER wherever it is sure, and 0 is as good as any sign."""
    dim, kernel = FORMS[form]
    make = KINDS.get(kind, nearly_collinear)
    points = make(np.random.default_rng([3, dim]), dim)
    truth = true_signs(points)
    assert len(np.unique(truth)) >= 2
    np.testing.assert_array_equal(find_signs(kernel, EXACT, points, device), truth)
    if form in EXPANSIONS:
        np.testing.assert_array_equal(find_signs(EXPANSIONS[form], 0, points, device), truth)
    sure = check_filter(kernel, points, truth, device)
    if kind == "random":
        assert sure.all()
        assert (find_signs(kernel, FLOAT32, points, device) == truth).mean() > 0.99
    elif kind in ROUNDED_WRONG:
        wrong = rounded_signs(points) != truth
        assert (wrong.any() and not sure[wrong].any()) or form == "edges", "float64 alone is not good enough here"
    if kind == "nearly collinear":
        assert wrong.mean() > 0.1 and sure.any(), "the points are too easy or too hard"


@pytest.mark.parametrize("across", [False, True])
@pytest.mark.parametrize("shared", [False, True])
def test_edges_laid_on_one_another_need_no_more_than_float64(device, across, shared):
    """Ends some units in the last place apart, in either order, and ends that coincide."""
    rng = np.random.default_rng(9)
    first = rng.normal(size=(COUNT, 2, 3))
    second = first + rng.integers(-3, 4, first.shape) * np.spacing(first)
    if shared:
        second[:, 0] = first[:, 0]
    points = np.concatenate([first, second[:, ::-1] if across else second], 1)
    truth = true_signs(points)
    sure = check_filter(orient_edges_kernel, points, truth, device)
    np.testing.assert_array_equal(find_signs(orient_edges_kernel, EXACT, points, device), truth)
    assert (truth == 0).all() == shared and sure.mean() >= (1.0 if shared else 0.97)
    assert shared or (find_signs(orient3d_kernel, FILTER, points, device) != int(UNCERTAIN)).mean() < 0.3


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_double_words_keep_their_bound(device, kind, dim):
    points = KINDS[kind](np.random.default_rng([6, dim]), dim)
    out = wp.zeros(len(points), dtype=wp.float64, device=device)
    kernel, dtype = (double3d_kernel, wp.vec3d) if dim == 3 else (double2d_kernel, wp.vec2d)
    wp.launch(kernel, len(points), [wp.array(points, dtype=dtype, device=device), out], device=device)
    for value, rows in zip(out.numpy().tolist(), points.tolist()):
        terms = true_terms(rows)
        off = abs(Fraction(value) - sum(terms))
        # The high word alone is returned.
        assert off <= Fraction(2) ** -53 * abs(Fraction(value)) + 20 * Fraction(2) ** -106 * sum(map(abs, terms))


def test_the_filter_is_tight(device):
    """The bound leaves open what it must and no more than some units in the last place around."""
    rng = np.random.default_rng(5)
    points = rng.normal(size=(2000, 4, 3))
    points[:, 3] = points[:, :3].mean(1) + 1e-12 * rng.normal(size=(2000, 3))
    assert (find_signs(orient3d_kernel, FILTER, points, device) != int(UNCERTAIN)).mean() > 0.95


# --- float32, the first stage ----------------------------------------------------------------------------------------


def float32_signs(error, unit, points, device):
    """Return signs (count, 6) of three points against a plane, all at once and one by one; points [count, 6, 3]."""
    out = wp.zeros((len(points), 7), dtype=wp.int32, device=device)
    error = wp.array(error, dtype=wp.float32, device=device)
    points = wp.array(points.astype(np.float32), dtype=wp.vec3, device=device)
    wp.launch(float32_signs_kernel, len(points), [error, float(unit), points, out], device=device)
    signs = out.numpy()
    np.testing.assert_array_equal(signs[:, 6] < 0, np.abs(signs[:, :3].sum(1)) == 3)
    return signs[:, :6]


def float32_points(rng, kind):
    """Six points about the origin of at most unit size: the fourth is that of a kind, two more lie nearby."""
    points = KINDS[kind](rng, 3)
    points = np.concatenate([points, points[:, 3:] + 1e-3 * rng.normal(size=points[:, 3:].shape), points[:, :1]], 1)
    points -= points[:, :1] + 1e-2 * rng.normal(size=(COUNT, 1, 3))
    return points / np.maximum(1e-200, np.abs(points).max((1, 2), keepdims=True))


def true_sides(points):
    return np.stack([true_signs(points[:, [0, 1, 2, k]]) for k in (3, 4, 5)] * 2, 1)


@pytest.mark.parametrize("off", [2.0**-26, 2.0**-20, 2.0**-10])
@pytest.mark.parametrize("kind", ["random", "lattice", "coplanar", "large coplanar"])
def test_float32_filter_is_right_where_it_is_sure(device, kind, off):
    """Coordinates moved by up to `off`, in a random or in the worst direction, and rounded to float32."""
    rng = np.random.default_rng(7)
    points = float32_points(rng, kind)
    normal = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])[:, None]
    height = rng.choice([0.0, 0.5, 1.0, 2.0, 4.0], (COUNT, 1, 1)) * off * np.sign(normal)
    points[:, 3:] += height
    truth = true_sides(points)
    worst = np.concatenate([np.sign(normal) * np.ones((1, 3, 1)), -np.sign(normal) * np.ones((1, 3, 1))], 1)
    shift = np.where(rng.random((COUNT, 1, 1)) < 0.5, worst, rng.uniform(-1, 1, points.shape)) * off
    moved = (points + shift).astype(np.float32)
    error = 2.02 * np.abs(moved - points).max((1, 2))
    signs = float32_signs(error, FLOAT32_UNIT, moved, device)
    sure = signs != int(UNCERTAIN)
    np.testing.assert_array_equal(signs[sure], truth[sure])
    plain = float32_signs(0 * error, FLOAT32_UNIT, moved, device)
    if kind != "random":
        assert (plain != truth)[plain != int(UNCERTAIN)].any(), "coordinates that are off must be reckoned with here"
    elif off < 1e-6:
        assert sure[:, [0, 1, 3, 4]].mean() > 0.98, "the sixth point lies in the plane but for the shift"
    far = float32_signs(np.full(COUNT, np.inf), FLOAT32_UNIT, moved, device)
    assert (far == int(UNCERTAIN)).all()


@pytest.mark.parametrize("kind", ["random", "coplanar", "large coplanar"])
def test_float32_filter_covers_its_own_rounding(device, kind):
    """Coordinates that float32 holds exactly: only the arithmetic rounds."""
    points = float32_points(np.random.default_rng(8), kind).astype(np.float32).astype(float)
    truth = true_sides(points)
    signs = float32_signs(np.zeros(COUNT), FLOAT32_UNIT, points, device)
    sure = signs != int(UNCERTAIN)
    np.testing.assert_array_equal(signs[sure], truth[sure])
    plain = float32_signs(np.zeros(COUNT), 0.0, points, device)
    assert (plain != int(UNCERTAIN)).all()
    assert (plain != truth).any() == (kind != "random"), "float32 alone is good enough for points at random only"
