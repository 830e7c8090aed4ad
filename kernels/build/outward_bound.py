"""Certified one-sided Hausdorff distance of the surface at a LOD from the original: branch and bound over active faces.

A face is cut into convex polygons. The distance to ONE original face is a convex function, so its maximum over a
polygon is at a corner: any original face gives an upper bound, the face nearest to the polygon's middle a good one. The
distance of that middle is a lower bound, so the gap between both is known.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.build import polygon
from warp_abtree.kernels.build.triangle_cover import FLOOR

wp.set_module_options(native.options("build/one_polygon.h"))

DEPTH = wp.constant(48)  # of the subdivision, each level at most four cuts: 192 cuts in all
ROWS = 3 * int(DEPTH) + 8  # of the stack: a polygon is replaced by at most four, one level deeper
TREE_ROOM = wp.constant(64)  # depth first keeps one node of each of at most 31 levels
SLACK_SQ = wp.constant(wp.float64(1.01 * 1.01))  # bounds within 1 % of a distance found are not refined
SLACK_PERIOD = wp.constant(8192)  # the slack doubles after so many polygons of one face, which bounds the work
# How far a polygon may extend beyond the edge of a prism, as a fraction of the gap to a distance found.
MARGIN = wp.constant(wp.float64(0.5))


@wp.struct
class Original:
    """The original surface, normalised, with boxes at the nodes of its AB-Tree."""

    face_pos: wp.array2d(dtype=wp.vec3d)  # [face_count, 3]
    node_lower: wp.array(dtype=wp.vec3)  # [node_count], rounded down; inf where no face lies
    node_upper: wp.array(dtype=wp.vec3)  # [node_count], rounded up; -inf where no face lies
    node_face: wp.array(dtype=int)  # [node_count], face of a leaf, else -1


@wp.func
def node_distance_sq(original: Original, node: int, p: wp.vec3d):
    return polygon.box_distance_sq(p, wp.vec3d(original.node_lower[node]), wp.vec3d(original.node_upper[node]))


@wp.func
def nearest_original(original: Original, p: wp.vec3d, guess: int):
    """Return the original face nearest to a point, and its squared distance; `guess` is a face to start from."""
    stack = wp.zeros(shape=(TREE_ROOM,), dtype=wp.int32)
    gap = wp.zeros(shape=(TREE_ROOM,), dtype=wp.float64)
    best = guess
    least = polygon.face_distance_sq(original.face_pos, guess, p)
    stack[0] = 1
    top = int(1)
    while top > 0:
        top -= 1
        if gap[top] < least:
            node = stack[top]
            f = original.node_face[node]
            if f >= 0:
                distance = polygon.face_distance_sq(original.face_pos, f, p)
                if distance < least:
                    least = distance
                    best = f
            else:
                left = node_distance_sq(original, 2 * node, p)
                right = node_distance_sq(original, 2 * node + 1, p)
                # the nearer child is popped first
                far = wp.where(left > right, 2 * node, 2 * node + 1)
                gap[top] = wp.where(left > right, left, right)
                stack[top] = far
                if gap[top] < least:
                    top += 1
                gap[top] = wp.where(left > right, right, left)
                stack[top] = 4 * node + 1 - far
                top += 1
    return best, least


@wp.func
def bound_triangle(
    original: Original, scratch: polygon.Scratch, depth: wp.array(dtype=int), guess: int, found: wp.float64
):
    """Bound the squared distance of any point of the current triangle from the original surface.

    Args:
        depth: Subdivision depth of each polygon on the stack, shape [ROWS].
        guess: An original face to start from.
        found: Squared distance of some point of the whole surface; bounds below it are not refined.
    """
    polygon.store_polygon(scratch, 0, 3)
    depth[0] = 0
    top = int(1)
    visited = int(0)
    slack = SLACK_SQ
    floor = FLOOR * FLOOR
    worst = wp.float64(0.0)
    while top > 0:
        top -= 1
        count = polygon.load_polygon(scratch, top)
        level = depth[top]
        visited += 1
        if visited % SLACK_PERIOD == 0:
            slack = slack * wp.float64(4.0)
            floor = floor * wp.float64(4.0)
        enough = wp.max(slack * found, floor)
        bound = polygon.polygon_distance_sq(original.face_pos, scratch, count, guess, enough)
        if bound > enough:
            guess, reached = nearest_original(original, polygon.polygon_middle(scratch, count), guess)
            found = wp.max(found, reached)
            enough = wp.max(slack * found, floor)
            if level >= DEPTH or count + 4 > polygon.POLYGON_CORNERS:
                enough = wp.float64(wp.inf)
            bound = polygon.polygon_distance_sq(original.face_pos, scratch, count, guess, enough)
            if bound > enough:
                bound = wp.float64(0.0)  # its parts bound it
                first = top
                margin = FLOOR + MARGIN * wp.sqrt(found - reached)
                top = polygon.split_polygon(original.face_pos, scratch, count, top, guess, margin)
                for i in range(first, top):
                    depth[i] = level + 1
        worst = wp.max(worst, bound)
    return worst


@wp.kernel
def measure_points_kernel(
    point: wp.array(dtype=wp.vec3d),
    guess: wp.array(dtype=int),
    original: Original,
    distance_sq_out: wp.array(dtype=wp.float64),
):
    """Measure squared distances of points to the original surface, each from a face that may be near."""
    i = wp.tid()
    _, distance = nearest_original(original, point[i], guess[i])
    distance_sq_out[i] = distance


@wp.kernel
def bound_faces_kernel(
    found_sq: wp.float64,
    corner: wp.array2d(dtype=wp.vec3d),
    face: wp.array(dtype=int),
    original: Original,
    scratch_inout: polygon.Scratch,
    depth_inout: wp.array(dtype=int),
    bound_sq_out: wp.array(dtype=wp.float64),
):
    """Bound the squared distance of every point of each active face to the original surface (serial, dim=1).

    Args:
        found_sq: Squared distance of some point of these faces.
        corner: Corners at the LOD, normalised, shape [count, 3].
        face: Face ids, shape [count].
        depth_inout: Working memory, shape [ROWS], as the stack of `scratch_inout`.
        bound_sq_out: Shape [count]; the maximum is the bound, one entry alone bounds its face only above found_sq.
    """
    for i in range(face.shape[0]):
        for k in range(3):
            scratch_inout.polygon[k] = corner[i, k]
        bound_sq_out[i] = bound_triangle(original, scratch_inout, depth_inout, face[i], found_sq)
