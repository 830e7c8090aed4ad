"""First of three stages: triangle against triangle in float32, with a proven bound on the error of each sign.

It comes in two parts: planes separate most face pairs; only of those that straddle both planes, edges are compared.
Source: as `intersect_triangles`.

Coordinates are about A's centre, scaled to about unit size; differences of corners are off by less than `error`, and
the arithmetic of a determinant by `unit` of its size. docs/exactness.md, bound 2. With both 0 every sign is the
computed one.

`native/triangle/float32_filter.cuh` has the determinants, of one pair or, for `simd.simd_float32_filter`, of 16.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.exact.predicates import UNCERTAIN
from warp_abtree.kernels.triangle.signs import POSITIVE, SEPARATED, SIGNS_OF_A, SIGNS_OF_B, rotate_corners

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

FLOAT32_UNIT = wp.constant(9.0 * 2.0**-24)


@native.func_native()
def plane_signs(error: wp.float32, unit: wp.float32, a: wp.mat33, b: wp.mat33) -> wp.int32:
    """Return SEPARATED where one triangle lies on one side of the other's plane, else all signs. No branches.

    Args:
        a, b: Corners, a row each.
    """


@native.func_native()
def gap_signs(error: wp.float32, unit: wp.float32, gap: wp.float32, a: wp.mat33, b: wp.mat33) -> wp.int32:
    """Return what `plane_signs` does, SEPARATED only where a face lies farther than a gap from a plane or an edge."""


@wp.func
def are_uncertain(unit: wp.float32, signs: wp.int32):
    """Return whether signs of straddling triangles leave it to the next stage: a shared plane, or a sign unknown.

    A sign that is neither positive nor negative is unknown, or 0 where there are no errors.
    """
    known = ((signs >> 1) | signs) & (POSITIVE >> 1)
    coplanar = (known & SIGNS_OF_A) == 0 or (known & SIGNS_OF_B) == 0
    return coplanar or (known != (POSITIVE >> 1) and unit != 0.0)


@native.func_native()
def side_of_plane(error: wp.float32, unit: wp.float32, plane: wp.mat33, d: wp.vec3) -> wp.int32:
    """Return on which side of a plane a point lies, as `orient3d`, or UNCERTAIN; as `intersect_straddling` finds it."""


@native.func_native()
def intersect_straddling(error: wp.float32, unit: wp.float32, a: wp.mat33, b: wp.mat33) -> wp.int32:
    """Return 1 where two closed triangles meet whose planes tell all signs, 0 where not, UNCERTAIN where it is open.

    The corners come rotated.
    """


@wp.func
def float32_filter_triangles(error: wp.float32, unit: wp.float32, a: wp.mat33, b: wp.mat33):
    """Return 1 where two closed triangles meet, 0 where not, UNCERTAIN where float32 cannot tell: both parts."""
    signs = plane_signs(error, unit, a, b)
    p1, q1, r1, p2, q2, r2 = rotate_corners(signs, a, b)
    meet = intersect_straddling(error, unit, wp.matrix_from_rows(p1, q1, r1), wp.matrix_from_rows(p2, q2, r2))
    return wp.where(signs == SEPARATED, 0, wp.where(are_uncertain(unit, signs), UNCERTAIN, meet))
