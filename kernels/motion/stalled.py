"""Double-word fallback of linear CCD: vertex-face and edge-edge pairs on which float64 advancement stalls.

Faces that are apart at first meet first where a corner of one meets the other face, or two edges meet. Each of these 15
pairs is proved apart on the way (`native/exact/moving_features.h`), from one time to the next:

* the four corners are in no plane, a cubic of time that has no root; or
* seen along some fixed direction, an edge of one, on its way, leaves both features on either side; or
* there is a gap along a fixed direction at both ends of that time, hence between.

Any direction proves it. Where nothing does, the next time comes nearer, down to 2^-90 of the motion: the features then
meet, or come as near as double words err, some 2^-93 of the sizes. After 512 tries a pair that is no nearer than 2^10
times that is undecided.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.exact.double_word import add_double
from warp_abtree.kernels.exact.expansion import two_product
from warp_abtree.kernels.motion.face_pair import FirstContact, separating_direction
from warp_abtree.kernels.triangle.distance import largest_coordinate

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Rows are corners of A's face and then of B's; columns coordinates rounded, and what is left of them.
words_type = wp.types.matrix(shape=(6, 6), dtype=wp.float64)
row_type = wp.types.vector(length=6, dtype=wp.float64)
# Beyond the best time so far, so that a contact at that time is found whatever the order of pairs.
BEYOND = wp.constant(wp.float64(2.0**-50))


@native.func_native()
def apart_until(
    starts: words_type,
    ends: words_type,
    away: wp.vec3d,
    error: wp.float64,
    start: wp.float64,
    limit: wp.float64,
    contact: wp.ref[FirstContact],
):
    """Find the time until which faces stay apart, up to a limit, and the outcome: CLEAR, TOUCHES or UNDECIDED.

    Args:
        starts, ends: Where corners are at first and at last, in any frame.
        away: How far from there B's face is past all of A's, for certain: they may intersect at first.
        error: What coordinates err by.
    """


@wp.func
def rounded(row: row_type):
    return wp.vec3d(row[0], row[1], row[2])


@wp.func
def plain_row(x: wp.vec3d):
    """Return coordinates that are float64 numbers."""
    zero = wp.float64(0.0)
    return row_type(x[0], x[1], x[2], zero, zero, zero)


@wp.func
def posed_row(rotation: wp.mat33d, position: wp.vec3d, v: wp.vec3d):
    """Return rotation v + position, to 9 u^2 of the magnitudes that are summed up."""
    row = row_type()
    for i in range(3):
        total = wp.vec2d(position[i], wp.float64(0.0))
        for k in range(3):
            high, low = two_product(rotation[i, k], v[k])
            total = add_double(total, wp.vec2d(high, low))
        row[i] = total[0]
        row[3 + i] = total[1]
    return row


@wp.func
def resolve_in_double_words(
    starts: words_type, ends: words_type, error: wp.float64, start: wp.float64, best: wp.float64
):
    """Find the first contact of faces that are apart before a start, up to the best time so far."""
    size, away = wp.float64(0.0), wp.vec3d()
    if start == wp.float64(0.0):
        for k in range(6):
            size = wp.max(size, largest_coordinate(rounded(starts[k])))
        a = wp.matrix_from_rows(rounded(starts[0]), rounded(starts[1]), rounded(starts[2]))
        b = wp.matrix_from_rows(rounded(starts[3]), rounded(starts[4]), rounded(starts[5]))
        # A unit vector has a coordinate over a half, and 8 sizes along it are farther than boxes reach.
        away = wp.float64(16.0) * size * separating_direction(a, b)
    contact = FirstContact()
    apart_until(starts, ends, away, error, start, wp.min(best + BEYOND, wp.float64(1.0)), contact)
    return contact
