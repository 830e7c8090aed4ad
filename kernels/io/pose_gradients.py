"""Gradients of a loss with respect to pose rows, from its derivatives by the distances of object pairs.

With g the sum of an object's rotation parts, a rotation vector w turns the unit quaternion u = (v, s) by (w, 0) u / 2,
so the gradient by u is 2 (g, 0) u = 2 (s g + g x v, -g.v), orthogonal to u; that by q = |q| u is the same over |q|. A
matrix R turns by [w] R, so within the rigid motions its gradient is [g] R / 2.
"""

from functools import cache

import warp as wp

from warp_abtree.kernels.distance.report import two_twists
from warp_abtree.kernels.io.place_poses import MODULE_OPTIONS, read_quaternion, read_rotation

wp.set_module_options(MODULE_OPTIONS)


@wp.struct
class ObjectPairs:
    """The pairs that each object is in, in their order."""

    start: wp.array(dtype=wp.int32)  # where an object's entries begin, shape [object + 1]
    entry: wp.array(dtype=wp.int32)  # twice the pair, and 1 more where the object is its second; shape [2 pair]


@wp.func
def sum_twists(i: wp.int32, pairs: ObjectPairs, weight: wp.array(dtype=wp.float64), twist: wp.array(dtype=two_twists)):
    """Return translation and rotation part of the loss's gradient at an object, summed in the order of its pairs."""
    along, turn = wp.vec3d(), wp.vec3d()
    for k in range(pairs.start[i], pairs.start[i + 1]):
        pair, is_second = pairs.entry[k] >> 1, (pairs.entry[k] & 1) == 1
        both, factor = twist[pair], weight[pair]
        for j in range(3):
            along[j] += factor * wp.where(is_second, both[1, j], both[0, j])
            turn[j] += factor * wp.where(is_second, both[1, 3 + j], both[0, 3 + j])
    return along, turn


@cache
def gradient_adder(real, width: int):
    """Return the kernel that adds gradients to rows of 7 or 16 numbers, an object a thread."""

    @wp.func
    def add_quaternion(i: wp.int32, poses: wp.array2d(dtype=real), turn: wp.vec3d, rows: wp.array2d(dtype=real)):
        q = read_quaternion(poses, i)
        norm = wp.length(q)
        u = q / norm
        v = wp.vec3d(u[0], u[1], u[2])
        slope = wp.float64(2.0) * (u[3] * turn + wp.cross(turn, v)) / norm
        for j in range(3):
            rows[i, 3 + j] = rows[i, 3 + j] + real(slope[j])
        rows[i, 6] = rows[i, 6] + real(wp.float64(-2.0) * wp.dot(turn, v) / norm)

    @wp.func
    def add_matrix(i: wp.int32, poses: wp.array2d(dtype=real), turn: wp.vec3d, rows: wp.array2d(dtype=real)):
        slope = wp.float64(0.5) * wp.skew(turn) * read_rotation(poses, i)
        for j in range(3):
            for k in range(3):
                rows[i, 4 * j + k] = rows[i, 4 * j + k] + real(slope[j, k])

    add_turn = add_quaternion if width == 7 else add_matrix
    step = 1 if width == 7 else 4  # from one number of the translation to the next
    first = 0 if width == 7 else 3

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def add_gradient_kernel(
        pairs: ObjectPairs,
        weight: wp.array(dtype=wp.float64),
        twist: wp.array(dtype=two_twists),
        poses: wp.array2d(dtype=real),
        rows_inout: wp.array2d(dtype=real),
    ):
        i = wp.tid()
        along, turn = sum_twists(i, pairs, weight, twist)
        for j in range(3):
            rows_inout[i, first + step * j] = rows_inout[i, first + step * j] + real(along[j])
        add_turn(i, poses, turn, rows_inout)

    return add_gradient_kernel
