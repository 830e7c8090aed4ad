"""Signs of small determinants by integers that wrap, against fractions."""

from fractions import Fraction

import numpy as np
import pytest
import warp as wp
from oracles.signs import COUNT, KINDS, true_terms

from warp_abtree.kernels.arithmetic.int128 import integer_orient2d, integer_orient3d
from warp_abtree.kernels.arithmetic.predicates import UNCERTAIN

pytestmark = pytest.mark.slow


@wp.kernel
def integer3d_kernel(bound: wp.array(dtype=wp.float64), points: wp.array2d(dtype=wp.vec3d), out: wp.array(dtype=int)):
    i = wp.tid()
    out[i] = integer_orient3d(points[i, 0], points[i, 1], points[i, 2], points[i, 3], bound[i])


@wp.kernel
def integer2d_kernel(bound: wp.array(dtype=wp.float64), points: wp.array2d(dtype=wp.vec2d), out: wp.array(dtype=int)):
    i = wp.tid()
    out[i] = integer_orient2d(points[i, 0], points[i, 1], points[i, 2], bound[i])


def lowest_power(x):
    """Return the power of two of the lowest bit of a number that is not 0."""
    x = Fraction(x)
    return (x.numerator & -x.numerator).bit_length() - x.denominator.bit_length()


def unit_of(rows):
    """Return the power of two that a determinant is a whole multiple of, None where a row is 0."""
    *rows, last = rows
    powers = [[lowest_power(x) for x in [*row, *last] if x != 0] for row in rows]
    return sum(map(min, powers)) if all(powers) else None


def spread_points(rng, dim):
    """The first row is a large power of two times a sum of the others, less the last point, which rounds nothing."""
    last = rng.integers(-9, 10, (COUNT, 1, dim)).astype(float)
    rows = rng.integers(-9, 10, (COUNT, dim - 1, dim)).astype(float)
    first = (rng.integers(-9, 10, (COUNT, dim - 1, 1)) * rows).sum(1, keepdims=True)
    return np.concatenate([first * 2.0 ** rng.integers(60, 200, (COUNT, 1, 1)), rows + last, last], 1)


KINDS = KINDS | {"spread": spread_points}


@pytest.mark.parametrize("share", [1, 4])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_integers_tell_small_determinants(device, kind, dim, share):
    """Right wherever they tell a sign of one within four times a bound, which they do within 2^122 units."""
    points = KINDS[kind](np.random.default_rng([7, dim]), dim)
    values = [sum(true_terms(rows)) for rows in points.tolist()]
    # No larger than the bound, or than 4 times the bound.
    bound = [float(abs(x)) / share for x in values]
    bound = [np.nextafter(b, np.inf) if 4 * Fraction(b) < abs(x) or b == 0 else b for x, b in zip(values, bound)]
    out = wp.zeros(len(points), dtype=int, device=device)
    kernel, dtype = (integer3d_kernel, wp.vec3d) if dim == 3 else (integer2d_kernel, wp.vec2d)
    arrays = [wp.array(bound, dtype=wp.float64, device=device), wp.array(points, dtype=dtype, device=device)]
    wp.launch(kernel, len(points), [*arrays, out], device=device)
    told = 0
    for rows, value, b, sign in zip(points.tolist(), values, bound, out.numpy().tolist(), strict=True):
        assert sign in ((value > 0) - (value < 0), int(UNCERTAIN))
        unit = unit_of(rows)
        small = unit is None or Fraction(b) < Fraction(2) ** (unit + 122)
        assert sign != int(UNCERTAIN) or not small
        told += small
    assert told > 3 or kind == "random"


@pytest.mark.parametrize("dim", [2, 3])
def test_integers_leave_what_is_no_number(device, dim):
    points = np.tile(np.eye(dim + 1, dim), (4, 1, 1))
    points[1, 0, 0], points[2, dim, 1] = np.nan, np.inf
    out = wp.zeros(4, dtype=int, device=device)
    kernel, dtype = (integer3d_kernel, wp.vec3d) if dim == 3 else (integer2d_kernel, wp.vec2d)
    bounds = wp.array([1.0, 1.0, 1.0, np.inf], dtype=wp.float64, device=device)
    wp.launch(kernel, 4, [bounds, wp.array(points, dtype=dtype, device=device), out], device=device)
    assert out.numpy().tolist() == [1, int(UNCERTAIN), int(UNCERTAIN), int(UNCERTAIN)]
