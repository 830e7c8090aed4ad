"""Signs of the corners of two triangles against one another's planes, and what order of corners they ask for.

The word of six signs, two bits each, + where the sign is positive and - where it is negative, or -1 for SEPARATED:

    11 10 9  8  7  6  5  4  3  2  1  0
    [+|-][+|-][+|-][+|-][+|-][+|-]
     a0   a1   a2   b0   b1   b2      a corner of A against B's plane, then of B against A's
"""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

SEPARATED = wp.constant(-1)
SIGNS_OF_A, SIGNS_OF_B, POSITIVE = wp.constant(0xFC0), wp.constant(0x3F), wp.constant(0xAAA)


@wp.func
def is_one_sided(s0: wp.int32, s1: wp.int32, s2: wp.int32):
    return wp.abs(s0 + s1 + s2) == 3


@wp.func
def pack_sign(k: wp.int32, sign: wp.int32):
    """Return the bits of the k-th sign of a word."""
    return wp.where(sign > 0, 2, wp.where(sign < 0, 1, 0)) << (10 - 2 * k)


@wp.func
def pack_signs(s0: wp.int32, s1: wp.int32, s2: wp.int32):
    """Return three signs as two bits each, whether it is positive and whether negative.

    5   4 3   2 1   0
    [ s0 | s1 | s2 ]    of each: positive, negative
    """
    over = wp.where(s0 > 0, 32, 0) | wp.where(s1 > 0, 8, 0) | wp.where(s2 > 0, 2, 0)
    under = wp.where(s0 < 0, 16, 0) | wp.where(s1 < 0, 4, 0) | wp.where(s2 < 0, 1, 0)
    return over | under


@wp.func
def have_one_side(signs: wp.int32):
    """Return whether the signs say that one triangle lies on one side of the other's plane."""
    over, under = signs & POSITIVE, (signs << 1) & POSITIVE
    one_of_a = (over & SIGNS_OF_A) == (POSITIVE & SIGNS_OF_A) or (under & SIGNS_OF_A) == (POSITIVE & SIGNS_OF_A)
    one_of_b = (over & SIGNS_OF_B) == (POSITIVE & SIGNS_OF_B) or (under & SIGNS_OF_B) == (POSITIVE & SIGNS_OF_B)
    return one_of_a or one_of_b


@wp.func
def find_alone(signs: wp.int32):
    """Return which corner is alone on its closed side of a plane, of three signs, and whether that is the negative one.

    The others lie on the other closed side. Where one corner touches and two lie on one side, it is alone on the other.
    """
    over = signs & 42
    under = (signs & 21) << 1
    one_over = wp.bit_count(over) == 1
    one_under = wp.bit_count(under) == 1
    alone = wp.where(one_over, over, wp.where(one_under, under, 42 ^ (over | under)))
    corner = wp.where(alone == 32, 0, wp.where(alone == 8, 1, 2))
    return corner, wp.where(one_over, False, wp.where(one_under, True, over != 0))


@wp.func
def rotate_first(i: wp.int32, a: Any, b: Any, c: Any):
    """Return the corners rotated so that corner i comes first."""
    first = wp.where(i == 0, a, wp.where(i == 1, b, c))
    second = wp.where(i == 0, b, wp.where(i == 1, c, a))
    third = wp.where(i == 0, c, wp.where(i == 1, a, b))
    return first, second, third


@wp.func
def rotate_corners(signs: wp.int32, a: Any, b: Any):
    """Return both triangles' corners, or their ids, the one first that is alone on its side of the other's plane.

    Each is rotated so that the other's lone corner lies on the positive side of its plane; in any order where both are
    coplanar. The planes meet in a line; on it the triangles are the intervals between edges p q and p r, and two more
    signs order the ends: they meet unless orient_edges(p1, q1, p2, q2) or orient_edges(p1, r1, r2, p2) is 1.
    """
    alone_a, back_a = find_alone(signs >> 6)
    alone_b, back_b = find_alone(signs)
    p1, q1, r1 = rotate_first(alone_a, a[0], a[1], a[2])
    p2, q2, r2 = rotate_first(alone_b, b[0], b[1], b[2])
    return (
        p1,
        wp.where(back_b, r1, q1),
        wp.where(back_b, q1, r1),
        p2,
        wp.where(back_a, r2, q2),
        wp.where(back_a, q2, r2),
    )
