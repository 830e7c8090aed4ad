"""Exact determinants, and signs of all stages, against fractions."""

from fractions import Fraction

import numpy as np
import pytest
import warp as wp
from helpers.questions import launch
from oracles.signs import COUNT, KINDS, random_floats, rounded_signs, true_signs, true_terms

from warp_abtree.kernels import native
from warp_abtree.kernels.exact.double_word import add_double, double_orient2d, double_orient3d
from warp_abtree.kernels.exact.expansion import EXPANSION_LANES, expand_area, expand_volume, two_product
from warp_abtree.kernels.exact.integers import (
    exact_orient2d,
    exact_orient3d,
    exact_volume,
    integer_orient2d,
    integer_orient3d,
)
from warp_abtree.kernels.exact.predicates import UNCERTAIN, orient2d, orient3d, orient_edges
from warp_abtree.kernels.triangle.float32_filter import FLOAT32_UNIT, gap_signs, plane_signs, side_of_plane
from warp_abtree.kernels.triangle.signs import SEPARATED, have_one_side

wp.set_module_options(native.options("exact/determinant.cuh", "exact/expansion.cuh", "triangle/float32_filter.cuh"))


@wp.kernel
def words_kernel(a: wp.array[wp.float64], b: wp.array[wp.float64], words_out: wp.array2d[wp.vec2d]):
    """High and low word of a sum, of a product, and of a sum that invites contraction with the product in it."""
    i, zero = wp.tid(), wp.float64(0.0)
    for k in range(3):
        first, second = wp.where(k == 0, a[i], a[i] * b[i]), wp.where(k == 0, b[i], a[i])
        words = add_double(wp.vec2d(first, zero), wp.vec2d(second, zero))
        if k == 1:
            high, low = two_product(a[i], b[i])
            words = wp.vec2d(high, low)
        words_out[i, k] = words


@pytest.mark.parametrize("kind", ["sum", "product", "sum of product"])
def test_sums_and_products_lose_nothing(device, kind):
    """Products where the error is no smaller than float64's grid; whole multiples of 2^-342 are among that."""
    rng = np.random.default_rng(1)
    if kind == "product":
        a, b = random_floats(rng, 3000, -430, 500), random_floats(rng, 3000, -430, 500)
        a[:500] = rng.integers(-(2**53), 2**53, 500) * 2.0**-342
        b[:500] = rng.integers(-(2**53), 2**53, 500) * 2.0**-684
        a[500:510], b[505:515] = 0.0, 0.0
        rounded, exact = a * b, [Fraction(x) * Fraction(y) for x, y in zip(a.tolist(), b.tolist())]
    else:
        a = random_floats(rng, 3000, -500, 450)
        b = np.concatenate([np.ldexp(a[:2000], rng.integers(-110, 50, 2000)), random_floats(rng, 1000, -500, 450)])
        b[:1000] *= -rng.uniform(1, 2, 1000)
        if kind == "sum":
            extreme = [0.0, -0.0, 5e-324, -5e-324, 2.0**-1022, 1.0, -1.0, np.nextafter(1, 2), 2.0**1022, -(2.0**1022)]
            a, b = np.concatenate([[a, b], np.reshape(np.meshgrid(extreme, extreme), (2, -1))], 1)
        first, second = (a, b) if kind == "sum" else (a * b, a)
        rounded, exact = first + second, [Fraction(x) + Fraction(y) for x, y in zip(first.tolist(), second.tolist())]
    words = launch(words_kernel, device, len(a), a, b, columns=3)
    high, low = words[:, ["sum", "product", "sum of product"].index(kind)].T
    np.testing.assert_array_equal(high, rounded)
    assert [Fraction(h) + Fraction(t) for h, t in zip(high.tolist(), low.tolist())] == exact


@wp.kernel
def add_words_kernel(a: wp.array[wp.vec2d], b: wp.array[wp.vec2d], sum_out: wp.array[wp.vec2d]):
    i = wp.tid()
    sum_out[i] = add_double(a[i], b[i])


def test_sums_of_double_words_keep_their_bound(device):
    """Of words of either sign whose high words cancel, whole or but for some units in the last place."""
    rng = np.random.default_rng(2)
    high = random_floats(rng, 800, -40, 40)
    other = np.where(rng.random(800) < 0.7, -high, random_floats(rng, 800, -40, 40))
    other += rng.integers(-2, 3, 800) * np.spacing(other) * (rng.random(800) < 0.5)
    words = [np.stack([x, random_floats(rng, 800, -9, -1) * np.spacing(np.abs(x))], 1) for x in (high, other)]
    found = launch(add_words_kernel, device, 800, *words)
    for got, a, b in zip(found.tolist(), *(w.tolist() for w in words)):
        exact = sum(map(Fraction, (*a, *b)))
        assert abs(sum(map(Fraction, got)) - exact) <= abs(exact) * (3 + Fraction(13, 2**53)) / 2**106
        assert got[0] + got[1] == got[0]


STAGES = ("filter", "float32", "exact", "long", "integer", "double")  # the first three by their modes


@wp.kernel
def stages2d_kernel(points: wp.array2d[wp.vec2d], bound: wp.array[wp.float64], out: wp.array2d[wp.float64]):
    i = wp.tid()
    a, b, c = points[i, 0], points[i, 1], points[i, 2]
    for mode in range(3):
        out[i, mode] = wp.float64(orient2d(mode, a, b, c))
    out[i, 3] = wp.float64(exact_orient2d(a, b, c))
    out[i, 4] = wp.float64(integer_orient2d(a, b, c, bound[i]))
    out[i, 5] = double_orient2d(a, b, c)[0]


@wp.kernel
def stages3d_kernel(points: wp.array2d[wp.vec3d], bound: wp.array[wp.float64], out: wp.array2d[wp.float64]):
    i = wp.tid()
    a, b, c, d = points[i, 0], points[i, 1], points[i, 2], points[i, 3]
    for mode in range(3):
        out[i, mode] = wp.float64(orient3d(mode, a, b, c, d))
    out[i, 3] = wp.float64(exact_orient3d(a, b, c, d))
    out[i, 4] = wp.float64(integer_orient3d(a, b, c, d, bound[i]))
    out[i, 5] = double_orient3d(a, b, c, d)[0]


@wp.kernel
def edges_kernel(points: wp.array2d[wp.vec3d], bound: wp.array[wp.float64], out: wp.array2d[wp.float64]):
    i = wp.tid()
    for mode in range(3):
        out[i, mode] = wp.float64(orient_edges(mode, points[i, 0], points[i, 1], points[i, 2], points[i, 3]))


FORMS = {"2D": (2, stages2d_kernel), "3D": (3, stages3d_kernel), "edges": (3, edges_kernel)}


def ask(device, form, points, bound=None):
    """Return what each stage says of points, by name."""
    bound = np.zeros(len(points)) if bound is None else bound
    return dict(zip(STAGES, launch(FORMS[form][1], device, len(points), points, bound, columns=6).T))


def sure_of(signs, truth):
    """Compare the signs that a stage is sure of; return which those are."""
    sure = signs != int(UNCERTAIN)
    np.testing.assert_array_equal(signs[sure], truth[sure])
    return sure


def check_filter(found, truth):
    """Compare the signs that the filter is sure of, and all exact ones; return which the filter is sure of."""
    np.testing.assert_array_equal(found["exact"], truth)
    return sure_of(found["filter"], truth)


def nearly_collinear(rng, dim):
    """Every difference, product and sum of the determinant of three points nearly on a line rounds."""
    points = np.empty((20_000, 3, 2))
    a, b, c = points[:, 0], points[:, 1], points[:, 2]
    c[:] = rng.uniform(1, 2, c.shape)
    a[:] = rng.uniform(-0.1, 0.1, a.shape)
    b[:] = c + rng.uniform(0.5, 2.0, (len(b), 1)) * (a - c) + 2.0**-52 * rng.integers(-4, 5, b.shape)
    return points


CASES = [(form, kind) for form in FORMS for kind in KINDS] + [("2D", "nearly collinear")]
# Kinds on which determinants rounded to float64 have a wrong sign.
ROUNDED_WRONG = {"coplanar", "large coplanar", "nearly collinear"}


@pytest.mark.parametrize(("form", "kind"), CASES, ids=map("-".join, CASES))
def test_signs(device, form, kind):
    """Exact ones are always right, the filter's wherever it is sure, 0 is as good as any; double words keep a bound."""
    dim, _ = FORMS[form]
    points = KINDS.get(kind, nearly_collinear)(np.random.default_rng([3, dim]), dim)
    truth, found = true_signs(points), ask(device, form, points)
    assert len(np.unique(truth)) >= 2
    sure = check_filter(found, truth)
    if form != "edges":
        np.testing.assert_array_equal(found["long"], truth)
    if kind == "random":
        assert sure.all() and (found["float32"] == truth).mean() > 0.99
    elif kind in ROUNDED_WRONG:
        wrong = rounded_signs(points) != truth
        assert (wrong.any() and not sure[wrong].any()) or form == "edges", "float64 alone is not good enough here"
    if kind == "nearly collinear":
        assert wrong.mean() > 0.1 and sure.any(), "the points are too easy or too hard"
    elif form != "edges":
        for value, rows in zip(found["double"].tolist(), points.tolist()):
            terms = true_terms(rows)
            off = abs(Fraction(value) - sum(terms))
            # The high word alone is returned.
            assert off <= Fraction(2) ** -53 * abs(Fraction(value)) + 20 * Fraction(2) ** -106 * sum(map(abs, terms))


def spread_points(rng, dim):
    """The first row is a large power of two times a sum of the others, less the last point, which rounds nothing."""
    last = rng.integers(-9, 10, (COUNT, 1, dim)).astype(float)
    rows = rng.integers(-9, 10, (COUNT, dim - 1, dim)).astype(float)
    first = (rng.integers(-9, 10, (COUNT, dim - 1, 1)) * rows).sum(1, keepdims=True)
    return np.concatenate([first * 2.0 ** rng.integers(60, 200, (COUNT, 1, 1)), rows + last, last], 1)


@wp.kernel
def volume_kernel(points: wp.array2d[wp.vec3d], out: wp.array2d[wp.float64]):
    """A determinant rounded once, and as expansions have it in 3D and, of its first coordinates, in 2D."""
    i = wp.tid()
    a, b, c, d = points[i, 0], points[i, 1], points[i, 2], points[i, 3]
    out[i, 0] = exact_volume(a, b, c, d)
    out[i, 1] = expand_volume(a, b, c, d)
    out[i, 2] = expand_area(wp.vec2d(a[0], a[1]), wp.vec2d(b[0], b[1]), wp.vec2d(d[0], d[1]))


def tied_points(rng, dim):
    """Determinants with few bits, about half a unit in the last place of others: many are ties, or next to one."""
    rows = np.eye(3)[None] * rng.choice([1.0, -1.0], (COUNT, 1, 1))
    rows[:, 0, 0] = 2.0**53 - rng.integers(0, 3, COUNT)
    rows[:, 0, 1], rows[:, 1, 0] = rng.choice([0.25, 0.5, 1.0, 1.5], COUNT), rng.choice([-1.0, 1.0, 3.0], COUNT)
    rows[:, 0, 2], rows[:, 2, 0] = 2.0 ** -rng.integers(0, 220, COUNT), rng.choice([0.0, 1.0, -1.0], COUNT)
    return np.concatenate([rows, np.zeros((COUNT, 1, 3))], 1)


def word_points(rng, dim):
    """Determinants of whole rows that end with so many zeros that the lowest words of 64 bits hold nothing."""
    points = np.zeros((COUNT, 4, 3))
    points[:, :3, 2] = 1.0
    for k in range(2):
        points[:, k, k] = rng.choice([1.0, -1.0, 3.0], COUNT) * 2.0 ** rng.integers(20, 80, COUNT)
    return points


@pytest.mark.parametrize("kind", [*KINDS, "spread", "tied", "words"])
def test_determinants_are_rounded_once_or_a_few_times(device, kind):
    """Once to nearest, ties to even, as Python rounds fractions; expansions with a few roundings more."""
    kinds = {**KINDS, "spread": spread_points, "tied": tied_points, "words": word_points}
    points = kinds[kind](np.random.default_rng([8, 3]), 3)
    found = launch(volume_kernel, device, len(points), points, columns=3, block_dim=int(EXPANSION_LANES))
    values = [sum(true_terms(rows)) for rows in points.tolist()]
    np.testing.assert_array_equal(found[:, 0], [float(x) for x in values])
    assert not np.signbit(found[found[:, 0] == 0, 0]).any() and len(np.unique(found[:, 0])) > 5
    areas = [sum(true_terms(rows)) for rows in points[:, [0, 1, 3], :2].tolist()]
    for expanded, exact in ((found[:, 1], values), (found[:, 2], areas)):
        assert all(abs(Fraction(x) - y) <= abs(y) / 2**51 for x, y in zip(expanded.tolist(), exact))


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
    sure = check_filter(ask(device, "edges", points), truth)
    assert (truth == 0).all() == shared and sure.mean() >= (1.0 if shared else 0.97)
    assert shared or (ask(device, "3D", points)["filter"] != int(UNCERTAIN)).mean() < 0.3


def test_the_filter_is_tight(device):
    """The bound leaves open what it must and no more than some units in the last place around."""
    rng = np.random.default_rng(5)
    points = rng.normal(size=(2000, 4, 3))
    points[:, 3] = points[:, :3].mean(1) + 1e-12 * rng.normal(size=(2000, 3))
    assert (ask(device, "3D", points)["filter"] != int(UNCERTAIN)).mean() > 0.95


def unit_of(rows):
    """Return the power of two that a determinant is a whole multiple of, None where a row is 0."""
    *rows, last = [[Fraction(x) for x in row] for row in rows]
    used = [[x for x in (*row, *last) if x != 0] for row in rows]
    powers = [[(x.numerator & -x.numerator).bit_length() - x.denominator.bit_length() for x in row] for row in used]
    return sum(map(min, powers)) if all(powers) else None


@pytest.mark.parametrize("share", [1, 4])
@pytest.mark.parametrize("form", ["2D", "3D"])
@pytest.mark.parametrize("kind", [*KINDS, "spread"])
@pytest.mark.slow
def test_integers_tell_small_determinants(device, kind, form, share):
    """Right wherever they tell a sign of one within four times a bound, which they do within 2^122 units."""
    points = KINDS.get(kind, spread_points)(np.random.default_rng([7, FORMS[form][0]]), FORMS[form][0])
    values = [sum(true_terms(rows)) for rows in points.tolist()]
    # No larger than the bound, or than 4 times the bound.
    bound = [float(abs(x)) / share for x in values]
    bound = [np.nextafter(b, np.inf) if 4 * Fraction(b) < abs(x) or b == 0 else b for x, b in zip(values, bound)]
    told = sure_of(ask(device, form, points, bound)["integer"], true_signs(points))
    units = [unit_of(rows) for rows in points.tolist()]
    small = [unit is None or Fraction(b) < Fraction(2) ** (unit + 122) for unit, b in zip(units, bound)]
    assert told[small].all()
    assert sum(small) > 3 or kind == "random"


@pytest.mark.parametrize("form", ["2D", "3D"])
def test_integers_leave_what_128_bits_may_not_hold(device, form):
    """Determinants about 2^127 units, four times their bound: a sign is right or left open, no smaller one is."""
    dim, _ = FORMS[form]
    rng, points = np.random.default_rng(4), np.zeros((COUNT, dim + 1, dim))
    digits, exponents = rng.integers(1 - 2**53, 2**53, (COUNT, dim, dim)), (8, 13) if dim == 2 else (-11, -8)
    points[:, :-1] = np.rint(digits * 2.0 ** rng.integers(*exponents, (COUNT, dim, dim)))
    points[:, range(dim), range(dim)] = 1.0  # the unit of each row
    values = [sum(true_terms(rows)) for rows in points.tolist()]
    bound = [np.nextafter(float(abs(x) / 4), np.inf) for x in values]
    told = sure_of(ask(device, form, points, bound)["integer"], true_signs(points))
    units = [Fraction(2) ** unit_of(rows) for rows in points.tolist()]
    sizes = np.array([abs(value) / unit for value, unit in zip(values, units)])
    assert told[sizes <= 2**124].all()
    assert (sizes > 2**127).sum() > 20 and told.sum() > 20


@pytest.mark.parametrize("form", ["2D", "3D"])
def test_integers_wrap_and_leave_what_is_no_number(device, form):
    """2^e m - 1 and 2^64 over 2^(e - 64) m - 1 and 1: 2^64 - 1, whatever of the first is beyond 128 bits."""
    dim, _ = FORMS[form]
    exponents = np.arange(64, 200)
    points, m = np.zeros((len(exponents), dim + 1, dim)), 2.0**52 + 1
    points[:, 0, 0], points[:, 1, 0], points[:, dim, 0] = m * 2.0**exponents, m * 2.0 ** (exponents - 64), 1.0
    points[:, 0, 1], points[:, 1, 1] = 2.0**64, 1.0
    if form == "3D":
        points[:, 2] = 1.0, 0.0, 1.0
    found = ask(device, form, points, np.full(len(points), 2.0**62))["integer"]
    assert (found == 1).all() and (true_signs(points) == 1).all()
    points = np.tile(np.eye(dim + 1, dim), (4, 1, 1))
    points[1, 0, 0], points[2, dim, 1] = np.nan, np.inf
    found = ask(device, form, points, np.array([1.0, 1.0, 1.0, np.inf]))["integer"]
    assert found.tolist() == [1, *[int(UNCERTAIN)] * 3]


@wp.kernel
def float32_kernel(unit: wp.float32, error: wp.array[wp.float32], points: wp.array2d[wp.vec3], out: wp.array2d[int]):
    """Signs of three points against a plane at once, one by one, and whether all are on one side."""
    i = wp.tid()
    plane = wp.matrix_from_rows(points[i, 0], points[i, 1], points[i, 2])
    over = wp.matrix_from_rows(points[i, 3], points[i, 4], points[i, 5])
    signs = gap_signs(error[i], unit, 2.0**60.0, over, plane)  # all, whatever is on one side
    for k in range(3):
        pair = (signs >> (10 - 2 * k)) & 3
        out[i, k] = wp.where(pair == 2, 1, wp.where(pair == 1, -1, wp.where(unit == 0.0, 0, UNCERTAIN)))
        out[i, 3 + k] = side_of_plane(error[i], unit, plane, points[i, 3 + k])
    out[i, 6] = wp.where(plane_signs(error[i], unit, over, plane) == SEPARATED, 1, 0)
    out[i, 7] = wp.where(have_one_side(signs), 1, 0)


def float32_signs(error, unit, points, device):
    """Return signs (count, 6) of three points against a plane, all at once and one by one; points [count, 6, 3]."""
    signs = launch(float32_kernel, device, len(points), float(unit), error, points.astype(np.float32), columns=8)
    np.testing.assert_array_equal(signs[:, 6], signs[:, 7])
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
    points[:, 3:] += rng.choice([0.0, 0.5, 1.0, 2.0, 4.0], (COUNT, 1, 1)) * off * np.sign(normal)
    truth = true_sides(points)
    worst = np.sign(normal) * np.repeat([1.0, -1.0], 3)[:, None]
    shift = np.where(rng.random((COUNT, 1, 1)) < 0.5, worst, rng.uniform(-1, 1, points.shape)) * off
    moved = (points + shift).astype(np.float32)
    error = 2.02 * np.abs(moved - points).max((1, 2))
    sure = sure_of(float32_signs(error, FLOAT32_UNIT, moved, device), truth)
    plain = float32_signs(0 * error, FLOAT32_UNIT, moved, device)
    if kind != "random":
        assert (plain != truth)[plain != int(UNCERTAIN)].any(), "coordinates that are off must be reckoned with here"
    elif off < 1e-6:
        assert sure[:, [0, 1, 3, 4]].mean() > 0.98, "the sixth point lies in the plane but for the shift"
    assert (float32_signs(np.full(COUNT, np.inf), FLOAT32_UNIT, moved, device) == int(UNCERTAIN)).all()


@pytest.mark.parametrize("kind", ["random", "coplanar", "large coplanar"])
def test_float32_filter_covers_its_own_rounding(device, kind):
    """Coordinates that float32 holds exactly: only the arithmetic rounds."""
    points = float32_points(np.random.default_rng(8), kind).astype(np.float32).astype(float)
    truth = true_sides(points)
    sure_of(float32_signs(np.zeros(COUNT), FLOAT32_UNIT, points, device), truth)
    plain = float32_signs(np.zeros(COUNT), 0.0, points, device)
    assert (plain != int(UNCERTAIN)).all()
    assert (plain != truth).any() == (kind != "random"), "float32 alone is good enough for points at random only"
