"""Triangle against triangle as closed sets: touching and coplanar overlap count, zero-area faces are segments."""

from typing import Any

import warp as wp

from warp_abtree.kernels.base.lanes import lowest_bit
from warp_abtree.kernels.exact.predicates import EXACT, FILTER, UNCERTAIN, orient3d, orient_edges
from warp_abtree.kernels.triangle.coplanar import intersect_special
from warp_abtree.kernels.triangle.signs import (
    SIGNS_OF_A,
    SIGNS_OF_B,
    have_one_side,
    is_one_sided,
    pack_sign,
    pack_signs,
    rotate_corners,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def pick_corners(k: wp.int32, a0: Any, a1: Any, a2: Any, b0: Any, b1: Any, b2: Any):
    """Return the corners whose sign is the k-th of `intersect_triangles`: a face and a corner of the other."""
    of_a = k < 3
    d = wp.where(of_a, a0, b0)
    if k % 3 == 1:
        d = wp.where(of_a, a1, b1)
    if k % 3 == 2:
        d = wp.where(of_a, a2, b2)
    return wp.where(of_a, b0, a0), wp.where(of_a, b1, a1), wp.where(of_a, b2, a2), d


@wp.func
def find_signs(a0: wp.vec3d, a1: wp.vec3d, a2: wp.vec3d, b0: wp.vec3d, b1: wp.vec3d, b2: wp.vec3d):
    """Return the word of the six exact signs of `intersect_triangles`; for a coplanar A not all of B's.

    Threads of a warp have different signs open: each takes its own next, so that they need not wait for one another.
    """
    signs = wp.int32(0)
    pending = wp.int32(0)
    for k in range(6):
        a, b, c, d = pick_corners(k, a0, a1, a2, b0, b1, b2)
        sign = orient3d(FILTER, a, b, c, d)
        if sign == UNCERTAIN:
            pending |= 1 << k
        else:
            signs |= pack_sign(k, sign)
    while pending != 0:
        k = lowest_bit(pending)
        pending &= pending - 1
        a, b, c, d = pick_corners(k, a0, a1, a2, b0, b1, b2)
        signs |= pack_sign(k, orient3d(EXACT, a, b, c, d))
        if (pending & 7) == 0 and (signs & SIGNS_OF_A) == 0:
            pending = 0  # zeros take longest: not three more of them
    return signs


@wp.func
def intersect_exactly(a0: wp.vec3d, a1: wp.vec3d, a2: wp.vec3d, b0: wp.vec3d, b1: wp.vec3d, b2: wp.vec3d):
    """Return what `intersect_triangles` does by exact signs, the same for neighbouring threads at the same time."""
    signs = find_signs(a0, a1, a2, b0, b1, b2)
    if have_one_side(signs):
        return 0
    if (signs & SIGNS_OF_A) == 0 or (signs & SIGNS_OF_B) == 0:
        return wp.where(intersect_special(EXACT, a0, a1, a2, b0, b1, b2), 1, 0)
    a, b = wp.matrix_from_rows(a0, a1, a2), wp.matrix_from_rows(b0, b1, b2)
    p1, q1, r1, p2, q2, r2 = rotate_corners(signs, a, b)
    first = orient_edges(FILTER, p1, q1, p2, q2)
    second = orient_edges(FILTER, p1, r1, r2, p2)
    while first != 1 and second != 1 and wp.max(first, second) == UNCERTAIN:
        one = first == UNCERTAIN
        sign = orient3d(EXACT, p1, wp.where(one, q1, r1), wp.where(one, p2, r2), wp.where(one, q2, p2))
        first = wp.where(one, sign, first)
        second = wp.where(one, second, sign)
    return wp.where(first == 1 or second == 1, 0, 1)


@wp.func
def intersect_triangles(
    mode: wp.int32, a0: wp.vec3d, a1: wp.vec3d, a2: wp.vec3d, b0: wp.vec3d, b1: wp.vec3d, b2: wp.vec3d
):
    """Return whether two closed triangles meet, 1 or 0, by exact signs or rounded ones.

    Source: Guigue and Devillers 2003, Fast and robust triangle-triangle overlap test using orientation predicates.
    """
    if mode == EXACT:
        return intersect_exactly(a0, a1, a2, b0, b1, b2)
    sa0 = orient3d(mode, b0, b1, b2, a0)
    sa1 = orient3d(mode, b0, b1, b2, a1)
    sa2 = orient3d(mode, b0, b1, b2, a2)
    if is_one_sided(sa0, sa1, sa2):
        return 0
    sb0 = orient3d(mode, a0, a1, a2, b0)
    sb1 = orient3d(mode, a0, a1, a2, b1)
    sb2 = orient3d(mode, a0, a1, a2, b2)
    if is_one_sided(sb0, sb1, sb2):
        return 0
    # A zero-area face sees every corner of the other on its "plane".
    special = (sa0 == 0 and sa1 == 0 and sa2 == 0) or (sb0 == 0 and sb1 == 0 and sb2 == 0)
    if special:
        return wp.where(intersect_special(mode, a0, a1, a2, b0, b1, b2), 1, 0)
    signs = (pack_signs(sa0, sa1, sa2) << 6) | pack_signs(sb0, sb1, sb2)
    a, b = wp.matrix_from_rows(a0, a1, a2), wp.matrix_from_rows(b0, b1, b2)
    p1, q1, r1, p2, q2, r2 = rotate_corners(signs, a, b)
    first = orient_edges(mode, p1, q1, p2, q2)
    second = orient_edges(mode, p1, r1, r2, p2)
    return wp.where(first == 1 or second == 1, 0, 1)
