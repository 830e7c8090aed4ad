"""How far the surface at a LOD lies from the original surface: branch and bound over every active face.

A face is cut into convex pieces. The distance to ONE original face is a convex function, so its largest value on a
piece is that of a corner: whichever original face is taken, the bound holds. The nearest to the middle of the piece
makes it good, and the distance of that middle is one that the surface reaches, so bound and truth are known to meet.
"""

import warp as wp

from warp_abtree.kernels.progressive.polygon import (
    CORNERS,
    Scratch,
    face_distance_sq,
    load_piece,
    split_piece,
    store_piece,
)
from warp_abtree.kernels.progressive.triangle_cover import FLOOR, outside

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

DEPTH = wp.constant(48)  # of pieces in one another, each within four cuts of the one before: 192 cuts at most
ROWS = 3 * int(DEPTH) + 8  # a piece is replaced by four at most, one deeper
TREE_ROOM = wp.constant(64)  # depth first leaves one node a level, 31 levels deep
SLACK_SQ = wp.constant(wp.float64(1.01 * 1.01))  # what exceeds a distance found by 1 % at most is not cut further
PATIENCE = wp.constant(8192)  # pieces of one face after which the slack doubles, lest hopeless ones take for ever
# How far a piece may reach over the edge of a prism, as part of what is left up to a distance found.
MARGIN = wp.constant(wp.float64(0.5))


@wp.struct
class Original:
    """The original surface, normalised, with boxes at the nodes of its AB-Tree."""

    face_pos: wp.array2d(dtype=wp.vec3d)  # [face_count, 3]
    node_lower: wp.array(dtype=wp.vec3)  # [node_count], rounded down; inf where no face lies
    node_upper: wp.array(dtype=wp.vec3)  # [node_count], rounded up; -inf where no face lies
    node_face: wp.array(dtype=int)  # [node_count], face of a leaf, else -1


@wp.func
def original_distance_sq(original: Original, f: int, p: wp.vec3d):
    return face_distance_sq(p, original.face_pos[f, 0], original.face_pos[f, 1], original.face_pos[f, 2])


@wp.func
def node_distance_sq(original: Original, node: int, p: wp.vec3d):
    """Return the squared distance to the box of a node."""
    lower = wp.vec3d(original.node_lower[node])
    upper = wp.vec3d(original.node_upper[node])
    x = outside(p[0], lower[0], upper[0])
    y = outside(p[1], lower[1], upper[1])
    z = outside(p[2], lower[2], upper[2])
    return x * x + y * y + z * z


@wp.func
def nearest_face(original: Original, p: wp.vec3d, guess: int):
    """Return the original face nearest to a point, and the square of its distance; `guess` is a face to begin with."""
    stack = wp.zeros(shape=(TREE_ROOM,), dtype=wp.int32)
    gap = wp.zeros(shape=(TREE_ROOM,), dtype=wp.float64)
    best = guess
    least = original_distance_sq(original, guess, p)
    stack[0] = 1
    top = int(1)
    while top > 0:
        top -= 1
        if gap[top] < least:
            node = stack[top]
            f = original.node_face[node]
            if f >= 0:
                distance = original_distance_sq(original, f, p)
                if distance < least:
                    least = distance
                    best = f
            else:
                left = node_distance_sq(original, 2 * node, p)
                right = node_distance_sq(original, 2 * node + 1, p)
                # the nearer child comes off the stack first
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
def piece_bound_sq(original: Original, scratch: Scratch, count: int, f: int, enough: wp.float64):
    """Return the largest corner distance of the piece in hand to face f, or anything above `enough` once it is."""
    worst = wp.float64(0.0)
    i = int(0)
    while i < count and worst <= enough:
        worst = wp.max(worst, original_distance_sq(original, f, scratch.piece[i]))
        i += 1
    return worst


@wp.func
def piece_middle(scratch: Scratch, count: int):
    sum = wp.vec3d()
    for i in range(count):
        sum = sum + scratch.piece[i]
    return sum / wp.float64(count)


@wp.func
def bound_triangle(original: Original, scratch: Scratch, depth: wp.array(dtype=int), guess: int, found: wp.float64):
    """Return a bound on the squared distance of every point of the triangle in hand from the original surface.

    Args:
        depth: Of each piece that waits, shape [ROWS].
        guess: An original face that may be near.
        found: Squared distance that some point of the whole surface has; no bound below it is worth a cut.
    """
    store_piece(scratch, 0, 3)
    depth[0] = 0
    top = int(1)
    pieces = int(0)
    slack = SLACK_SQ
    floor = FLOOR * FLOOR
    worst = wp.float64(0.0)
    while top > 0:
        top -= 1
        count = load_piece(scratch, top)
        level = depth[top]
        pieces += 1
        if pieces % PATIENCE == 0:
            slack = slack * wp.float64(4.0)
            floor = floor * wp.float64(4.0)
        enough = wp.max(slack * found, floor)
        bound = piece_bound_sq(original, scratch, count, guess, enough)
        if bound > enough:
            guess, reached = nearest_face(original, piece_middle(scratch, count), guess)
            found = wp.max(found, reached)
            enough = wp.max(slack * found, floor)
            if level >= DEPTH or count + 4 > CORNERS:
                enough = wp.float64(wp.inf)
            bound = piece_bound_sq(original, scratch, count, guess, enough)
            if bound > enough:
                bound = wp.float64(0.0)  # that of its parts counts
                first = top
                margin = FLOOR + MARGIN * wp.sqrt(found - reached)
                top = split_piece(original.face_pos, scratch, count, top, guess, margin)
                for i in range(first, top):
                    depth[i] = level + 1
        worst = wp.max(worst, bound)
    return worst


@wp.kernel
def measure_points_kernel(
    point: wp.array(dtype=wp.vec3d),
    guess: wp.array(dtype=int),
    original: Original,
    # Out:
    distance_sq_out: wp.array(dtype=wp.float64),
):
    """Measure squared distances of points to the original surface, beginning with a face that may be near each."""
    i = wp.tid()
    _, distance = nearest_face(original, point[i], guess[i])
    distance_sq_out[i] = distance


@wp.kernel
def bound_faces_kernel(
    found_sq: wp.float64,
    corner: wp.array2d(dtype=wp.vec3d),
    face: wp.array(dtype=int),
    original: Original,
    # In and out:
    scratch_inout: Scratch,
    depth_inout: wp.array(dtype=int),
    # Out:
    bound_sq_out: wp.array(dtype=wp.float64),
):
    """Bound the squared distance of every point of each active face to the original surface (serial, dim=1).

    Args:
        found_sq: Squared distance that some point of them has.
        corner: Corners where they are at the LOD, normalised, shape [count, 3].
        face: Their ids, shape [count].
        depth_inout: Room of one number for each row of `scratch_inout`, ROWS.
        bound_sq_out: Shape [count]; the greatest is a bound, each alone only if it exceeds found_sq.
    """
    for i in range(face.shape[0]):
        for k in range(3):
            scratch_inout.piece[k] = corner[i, k]
        bound_sq_out[i] = bound_triangle(original, scratch_inout, depth_inout, face[i], found_sq)
