"""Boxes of objects on their whole way, for the broad phase.

A way is cut into parts. Within a part of length h a point leaves the chord between its ends by at most M h^2 / 8, M the
bound of its acceleration: turn^2 times its distance from the anchor. So the boxes at the ends of all parts, each wider
by that, hold it all.
"""

import warp as wp

from warp_abtree.kernels.arrays import ModelPool, ObjectPool, StatePool
from warp_abtree.kernels.broad_phase import ROUNDING_64, measure_skew
from warp_abtree.kernels.generation import LaunchRecord, is_stale
from warp_abtree.kernels.motion.path import make_path
from warp_abtree.kernels.motion.turn import turn_matrix
from warp_abtree.kernels.traversal.boxes import round_down, round_up
from warp_abtree.kernels.traversal.nodes import load_node

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

PARTS = wp.constant(8)


@wp.func
def extend_box(
    lower: wp.vec3d, upper: wp.vec3d, r: wp.mat33d, p: wp.vec3d, middle: wp.vec3d, half: wp.vec3d, more: wp.float64
):
    """Return corners that also hold a box posed by r and p, wider by rounding and more."""
    low, high = lower, upper
    for k in range(3):
        terms = wp.vec3d(r[k, 0] * middle[0], r[k, 1] * middle[1], r[k, 2] * middle[2])
        centre = terms[0] + terms[1] + terms[2] + p[k]
        side = wp.abs(r[k, 0]) * half[0] + wp.abs(r[k, 1]) * half[1] + wp.abs(r[k, 2]) * half[2]
        side = side + more
        low[k] = wp.min(low[k], centre - side)
        high[k] = wp.max(high[k], centre + side)
    return low, high


@wp.kernel
def sweep_box_kernel(
    linear: bool,
    screw: bool,
    models: ModelPool,
    states: StatePool,
    objects: ObjectPool,
    ends: ObjectPool,
    record: LaunchRecord,
    lower_out: wp.array(dtype=wp.vec3),
    upper_out: wp.array(dtype=wp.vec3),
):
    """Box the root box of each object on its way in the world; as `broad_phase.pose_box_kernel`."""
    i = wp.tid()
    state = objects.state[i]
    root = load_node(states, states.node_start[state] + 1)
    lower, upper = wp.vec3d(root.lower), wp.vec3d(root.upper)
    middle = models.centre[states.model[state]] + wp.float64(0.5) * (lower + upper)
    half = wp.float64(0.5) * (upper - lower)
    path = make_path(screw, objects, ends, i)
    r, p, q = objects.rotation[i], objects.position[i], ends.position[i]
    reach = wp.length(middle - path.anchor) + wp.length(half)
    sizes = wp.length(middle) + wp.length(half) + wp.length(path.anchor) + wp.length(p) + wp.length(q)
    skew = wp.float64(3.0) * wp.max(measure_skew(r), measure_skew(ends.rotation[i]))
    more = (skew + wp.float64(16.0) * ROUNDING_64) * sizes
    infinite = wp.float64(wp.inf)
    low, high = wp.vec3d(infinite, infinite, infinite), wp.vec3d(-infinite, -infinite, -infinite)
    low, high = extend_box(low, high, ends.rotation[i], q, middle, half, more)
    if linear or path.angle < wp.float64(0.0):
        low, high = extend_box(low, high, r, p, middle, half, more)
    else:
        part = wp.float64(1.0 / 8.0)
        sag = path.angle * path.angle * reach * (part * part * wp.float64(0.126))
        for k in range(PARTS + 1):
            t = part * wp.float64(k)
            turned = r * turn_matrix(path.axis, t * path.angle)
            place = (path.start + t * path.travel) - turned * path.anchor
            low, high = extend_box(low, high, turned, place, middle, half, more + sag)
    box_lower = wp.vec3(round_down(low[0]), round_down(low[1]), round_down(low[2]))
    box_upper = wp.vec3(round_up(high[0]), round_up(high[1]), round_up(high[2]))
    if is_stale(record):
        box_lower = wp.vec3(wp.float32(i), 0.0, 0.0)
        box_upper = box_lower
    lower_out[i] = box_lower
    upper_out[i] = box_upper
