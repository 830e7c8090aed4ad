"""Forward kinematics: the pose of every frame of a robot at many configurations.

u = 2^-53. Angles are reduced by multiples of a quarter turn in three parts, the first of which has 33 bits, so that its
product with up to 2^20 is exact; sines are those of `motion.turn`: the same bits on every device.
"""

import math

import warp as wp

from warp_abtree.kernels.base.arrays import ObjectPool
from warp_abtree.kernels.motion.turn import cross_matrix, sin_cos_quarter

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

FIXED, REVOLUTE, PRISMATIC = wp.constant(0), wp.constant(1), wp.constant(2)

ANGLE_MAX = 2.0**20
"""Angles are less than this in magnitude [rad]."""

QUARTERS = wp.constant(wp.float64(2.0 / math.pi))
# A quarter turn less its first 33 bits, and less the next 33, by the expansion of pi / 2.
QUARTER_1 = wp.constant(wp.float64(1.57079632673412561417e00))
QUARTER_2 = wp.constant(wp.float64(6.07710050630396597660e-11))
QUARTER_3 = wp.constant(wp.float64(2.02226624879595063154e-21))

# Of the greater limit: what rounding may put a value beyond one of them, as lower + 1 * (upper - lower) does.
LIMIT_ROUNDING = wp.constant(wp.float64(2.0**-22))
LIMIT_ROUNDING_DOUBLE = wp.constant(wp.float64(2.0**-51))

NO_BAD_NUMBER = wp.constant(wp.int64(2**63 - 1))


@wp.struct
class Chain:
    """The frames of a robot, parents first: a frame is its parent's, moved by a fixed transform, then by a joint."""

    parent: wp.array(dtype=wp.int32)  # -1 at a root, shape [frame]
    kind: wp.array(dtype=wp.int32)  # FIXED, REVOLUTE or PRISMATIC, shape [frame]
    column: wp.array(dtype=wp.int32)  # of a configuration, that moves the joint; -1 for none, shape [frame]
    scale: wp.array(dtype=wp.float64)  # joint value = scale * column + offset, shape [frame]
    offset: wp.array(dtype=wp.float64)  # [rad or robot units], shape [frame]
    axis: wp.array(dtype=wp.vec3d)  # unit, shape [frame]
    rotation: wp.array(dtype=wp.mat33d)  # of the fixed transform, shape [frame]
    position: wp.array(dtype=wp.vec3d)  # of the fixed transform [robot units], shape [frame]
    lower: wp.array(dtype=wp.float64)  # limits of a configuration, shape [column]
    upper: wp.array(dtype=wp.float64)  # shape [column]


@wp.struct
class Frames:
    """Poses of the frames of a chunk of configurations: those of a configuration side by side."""

    rotation: wp.array2d(dtype=wp.mat33d)  # shape [configuration, frame]
    position: wp.array2d(dtype=wp.vec3d)  # [robot units], shape [configuration, frame]


@wp.func
def sin_cos(angle: wp.float64):
    """Return sine and cosine of an angle below ANGLE_MAX in magnitude, each within 10 u."""
    k = wp.floor(angle * QUARTERS + wp.float64(0.5))
    r = ((angle - k * QUARTER_1) - k * QUARTER_2) - k * QUARTER_3
    s, c = sin_cos_quarter(wp.abs(r))
    if r < wp.float64(0.0):
        s = -s
    turn = wp.int32(k) & 3
    if turn == 1:
        return c, -s
    if turn == 2:
        return -s, -c
    if turn == 3:
        return -c, s
    return s, c


@wp.func
def turn_about(axis: wp.vec3d, angle: wp.float64):
    """Return the rotation about a unit axis."""
    s, c = sin_cos(angle)
    one = wp.float64(1.0)
    return wp.identity(n=3, dtype=wp.float64) * c + wp.outer(axis, axis) * (one - c) + cross_matrix(axis) * s


@wp.func
def move_joint(chain: Chain, configurations: wp.array2d(dtype=wp.float64), i: wp.int32, f: wp.int32):
    """Return rotation and position of a frame in its parent."""
    rotation = chain.rotation[f] * wp.float64(1.0)
    position = chain.position[f] * wp.float64(1.0)
    kind = chain.kind[f]
    if kind == FIXED:
        return rotation, position
    value = wp.float64(chain.offset[f])
    if chain.column[f] >= 0:
        value += chain.scale[f] * configurations[i, chain.column[f]]
    if kind == REVOLUTE:
        rotation = rotation * turn_about(chain.axis[f], value)
    else:
        position = position + rotation * (chain.axis[f] * value)
    return rotation, position


@wp.func
def keeps_limits(value: wp.float64, lower: wp.float64, upper: wp.float64):
    """Return whether a value is within limits, or beyond one by rounding alone, of float32 if it is such a number."""
    none = wp.float64(0.0)
    beyond = wp.max(lower - value, value - upper)
    size = wp.max(wp.where(wp.isfinite(lower), wp.abs(lower), none), wp.where(wp.isfinite(upper), wp.abs(upper), none))
    rounded = wp.float64(wp.float32(value)) == value
    return beyond <= none or beyond <= wp.where(rounded, LIMIT_ROUNDING, LIMIT_ROUNDING_DOUBLE) * size


@wp.kernel
def check_configuration_kernel(
    limited: wp.int32,
    count: wp.int32,
    chain: Chain,
    configurations: wp.array2d(dtype=wp.float64),
    first_inout: wp.array(dtype=wp.int64),
):
    """Find the first value of configurations that is not finite, too large, or out of its limits.

    Args:
        limited: Whether limits are kept to, 0 or 1.
        first_inout: Where it is, configuration * values + value, NO_BAD_NUMBER for none, shape [1].
    """
    i = wp.tid()
    if i >= count:
        return
    width = chain.lower.shape[0]
    for k in range(width):
        value = configurations[i, k]
        fine = wp.abs(value) < wp.float64(wp.static(ANGLE_MAX))  # false for NaN
        if limited != 0:
            fine = fine and keeps_limits(value, chain.lower[k], chain.upper[k])
        if not fine:
            wp.atomic_min(first_inout, 0, wp.int64(i) * wp.int64(width) + wp.int64(k))


@wp.kernel
def forward_kernel(chain: Chain, configurations: wp.array2d(dtype=wp.float64), frames_out: Frames):
    """Pose all frames at a configuration a thread."""
    i = wp.tid()
    for f in range(chain.parent.shape[0]):
        rotation, position = move_joint(chain, configurations, i, f)
        parent = chain.parent[f]
        if parent >= 0:
            base = frames_out.rotation[i, parent]
            position = base * position + frames_out.position[i, parent]
            rotation = base * rotation
        frames_out.rotation[i, f] = rotation
        frames_out.position[i, f] = position


@wp.kernel
def write_link_kernel(link_frame: wp.array(dtype=wp.int32), frames: Frames, pose_out: wp.array2d(dtype=wp.mat44d)):
    """Write poses of links as matrices, one link of one configuration a thread."""
    i, k = wp.tid()
    f = link_frame[k]
    r, t = frames.rotation[i, f], frames.position[i, f]
    o, one = wp.float64(0.0), wp.float64(1.0)
    pose_out[i, k] = wp.mat44d(
        r[0, 0], r[0, 1], r[0, 2], t[0],
        r[1, 0], r[1, 1], r[1, 2], t[1],
        r[2, 0], r[2, 1], r[2, 2], t[2],
        o, o, o, one,
    )  # fmt: skip


@wp.kernel
def place_part_kernel(first: wp.int32, part_frame: wp.array(dtype=wp.int32), frames: Frames, objects_inout: ObjectPool):
    """Pose the objects of a robot's parts, one part of one configuration a thread.

    Args:
        first: Object of the first configuration's first part; the others follow, configuration by configuration.
    """
    i, k = wp.tid()
    at = first + i * part_frame.shape[0] + k
    objects_inout.rotation[at] = frames.rotation[i, part_frame[k]]
    objects_inout.position[at] = frames.position[i, part_frame[k]]
