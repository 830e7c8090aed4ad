"""Point-triangle distance, and convex polygons cut from a triangle by planes.

One polygon is current (`scratch.polygon`; its corner count is a variable of the caller), others lie on a stack.
"""

import warp as wp

from warp_abtree.kernels import native

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

STACK = wp.constant(64)  # polygons on the stack
POLYGON_CORNERS = wp.constant(16)  # of a polygon


@wp.struct
class Scratch:
    """Working memory of one triangle that is cut into polygons."""

    near: wp.array(dtype=int)  # [face_count], faces to cover with; those of the merge before those of the triangle
    used: wp.array(dtype=int)  # [SLOTS], faces that cover a polygon
    stack: wp.array2d(dtype=wp.vec3d)  # [STACK, POLYGON_CORNERS], polygons still to be covered
    stack_count: wp.array(dtype=int)  # [STACK], corners of each
    polygon: wp.array(dtype=wp.vec3d)  # [POLYGON_CORNERS], current polygon


@native.func_native(cpu=True)
def face_distance_sq(face_pos: wp.array2d(dtype=wp.vec3d), f: wp.int32, p: wp.vec3d) -> wp.float64:
    """Return the squared distance of a point to face f, never less than the true one up to rounding."""


@wp.func
def box_distance_sq(p: wp.vec3d, lower: wp.vec3d, upper: wp.vec3d):
    return wp.length_sq(wp.max(wp.max(lower - p, p - upper), wp.vec3d()))


@wp.func
def polygon_distance_sq(face_pos: wp.array2d(dtype=wp.vec3d), scratch: Scratch, count: int, f: int, enough: wp.float64):
    """Return the largest squared distance of the current polygon's corners to face f.

    The maximum over corners is that over the polygon, as the distance to one triangle is a convex function. Stops at
    the first value above `enough`.
    """
    worst = wp.float64(0.0)
    i = int(0)
    while i < count and worst <= enough:
        worst = wp.max(worst, face_distance_sq(face_pos, f, scratch.polygon[i]))
        i += 1
    return worst


@wp.func
def polygon_middle(scratch: Scratch, count: int):
    sum = wp.vec3d()
    for i in range(count):
        sum = sum + scratch.polygon[i]
    return sum / wp.float64(count)


@wp.func
def load_polygon(scratch: Scratch, row: int):
    for i in range(scratch.stack_count[row]):
        scratch.polygon[i] = scratch.stack[row, i]
    return scratch.stack_count[row]


@wp.func
def store_polygon(scratch: Scratch, row: int, count: int):
    for i in range(count):
        scratch.stack[row, i] = scratch.polygon[i]
    scratch.stack_count[row] = count


@native.func_native(cpu=True)
def split_polygon(
    face_pos: wp.array2d(dtype=wp.vec3d),
    scratch: Scratch,
    count: wp.int32,
    top: wp.int32,
    f: wp.int32,
    margin: wp.float64,
) -> wp.int32:
    """Cut the current polygon by the prism over face f, or in half if that leaves it whole; return the new top."""
