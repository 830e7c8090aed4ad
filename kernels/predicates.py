"""Orientation signs in float64. The float32 filter and the expansions of the exact predicates take their place here."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def orient3d(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Return a value whose sign says on which side of plane (a, b, c) point d lies.

    Positive where (b - a) x (c - a) points away from d. Source: Shewchuk 1997, section 4, without the adaptive stages.
    """
    ad = a - d
    bd = b - d
    cd = c - d
    x = ad[0] * (bd[1] * cd[2] - bd[2] * cd[1])
    y = bd[0] * (cd[1] * ad[2] - cd[2] * ad[1])
    z = cd[0] * (ad[1] * bd[2] - ad[2] * bd[1])
    return (x + y) + z


@wp.func
def orient2d(a: wp.vec2d, b: wp.vec2d, c: wp.vec2d):
    """Return a value that is positive where a, b, c turn counterclockwise, zero where they are collinear."""
    return (a[0] - c[0]) * (b[1] - c[1]) - (a[1] - c[1]) * (b[0] - c[0])


@wp.func
def drop_axis(p: wp.vec3d, axis: wp.int32):
    """Project along an axis; the others keep their cyclic order."""
    if axis == 0:
        return wp.vec2d(p[1], p[2])
    if axis == 1:
        return wp.vec2d(p[2], p[0])
    return wp.vec2d(p[0], p[1])
