"""Start of a search for first contacts: swept boxes, each pair's motion, and advancement of both roots.

A way is cut into parts for the boxes of the broad phase. Within a part of length h a point leaves the chord between
its ends by at most M h^2 / 8, M the bound of its acceleration: turn^2 times its distance from the anchor. So the boxes
at the ends of all parts, each wider by that, hold it all.
"""

from functools import cache

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ObjectPool, StatePool, Trees
from warp_abtree.kernels.base.boxes import round_down_vec, round_up_vec
from warp_abtree.kernels.base.generation import STALE, LaunchRecord, is_stale
from warp_abtree.kernels.base.nodes import load_node
from warp_abtree.kernels.base.poses import ROUNDING_64, PairBatch, PairPose, measure_skew
from warp_abtree.kernels.intersect.broad_phase import PosedBounds, write_bounds
from warp_abtree.kernels.intersect.face_pairs import Hits
from warp_abtree.kernels.motion.face_pair import CLEAR, TOUCHES, UNDECIDED
from warp_abtree.kernels.motion.kinds import STEPS
from warp_abtree.kernels.motion.path import Path, make_path
from warp_abtree.kernels.motion.turn import turn_matrix
from warp_abtree.kernels.search.item import DROPPED, first_item

MODULE_OPTIONS = native.options()
wp.set_module_options(MODULE_OPTIONS)

# Beside the ends of face pairs: to be searched from `time` on; of an object without a shortest turn.
OPEN, HALF_TURN = wp.constant(3), wp.constant(4)
ROOT_STEPS = wp.constant(16)
# Of a way, for its box.
PARTS = wp.constant(8)


@wp.struct
class FirstContacts:
    """First contacts, an entry an object pair."""

    time: wp.array(dtype=wp.float64)  # of first contact, 1 where clear
    end: wp.array(dtype=wp.int32)  # CLEAR, TOUCHES, UNDECIDED, OPEN or HALF_TURN
    counter: wp.array(dtype=wp.int32)  # of threads and object pairs that are taken, as `load_balance` counts


@wp.struct
class Motions:
    """Paths and end poses of objects."""

    paths: wp.array(dtype=Path)  # shape [object]
    ends: ObjectPool  # their poses at the end


@cache
def contact_starter(kind):
    """Return the kernel that prepares object pairs for motions of a type: `path.Motion` or `linear.LinearMotion`."""
    make, advance_nodes, _ = STEPS[kind]

    @wp.func
    def advance_roots(states: StatePool, pose: PairPose, motion: kind):
        """Advance two roots; return a time until which they stay apart, whether it is the end, and the tests made."""
        t = wp.float32(0.0)
        item = first_item(states, pose)
        tests = wp.int32(0)
        while tests < ROOT_STEPS:
            emitted = advance_nodes(states, pose, motion, t, wp.float64(1.0), item, -1)
            tests += 1
            if emitted.kinds[0] == DROPPED:
                return t, True, tests
            if emitted.items[0] != item:
                return t, False, tests
            t = emitted.bounds[0]
        return t, False, tests

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def start_contact_kernel(
        trees: Trees,
        motions: Motions,
        batch: PairBatch,
        hits_inout: Hits,
        contacts_inout: FirstContacts,
        motion_out: wp.array(dtype=kind),
    ):
        """Prepare an object pair a thread: settle pairs that intersect at first, or that the root boxes prove clear."""
        p = wp.tid()
        if p == 0:
            contacts_inout.counter[1] = 0
            contacts_inout.counter[3] = 0
        if p >= batch.count[0] or batch.launched[0] == STALE:
            return
        pair = wp.vec2i(wp.min(batch.pairs[p][0], batch.pairs[p][1]), wp.max(batch.pairs[p][0], batch.pairs[p][1]))
        contacts_inout.time[p] = wp.float64(0.0)
        if hits_inout.any_hit[p] != 0:
            contacts_inout.end[p] = TOUCHES
            return
        motion, has_way = make(motions.paths, motions.ends, trees, batch.poses[p], pair)
        if not has_way:
            contacts_inout.end[p] = HALF_TURN
            return
        if not (motion.slack < wp.float64(wp.inf)):
            # Beyond float64, or no numbers: nothing could be proved.
            contacts_inout.end[p] = UNDECIDED
            return
        t, clear, tests = advance_roots(trees.states, batch.poses[p], motion)
        hits_inout.node_tests[p] += wp.int64(tests)
        contacts_inout.time[p] = wp.where(clear, wp.float64(1.0), wp.float64(t))
        contacts_inout.end[p] = wp.where(clear, CLEAR, OPEN)
        motion_out[p] = motion

    return start_contact_kernel


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
    trees: Trees,
    ends: ObjectPool,
    record: LaunchRecord,
    boxes_out: PosedBounds,
):
    """Box the root box of each object on its way in the world; as `broad_phase.pose_box_kernel`."""
    i = wp.tid()
    state = trees.objects.state[i]
    root = load_node(trees.states, trees.states.node_start[state] + 1)
    lower, upper = wp.vec3d(root.lower), wp.vec3d(root.upper)
    middle = trees.models.centre[trees.states.model[state]] + wp.float64(0.5) * (lower + upper)
    half = wp.float64(0.5) * (upper - lower)
    path = make_path(screw, trees.objects, ends, i)
    r, p, q = trees.objects.rotation[i], trees.objects.position[i], ends.position[i]
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
    box_lower, box_upper = round_down_vec(low), round_up_vec(high)
    if is_stale(record):
        box_lower = wp.vec3(wp.float32(i), 0.0, 0.0)
        box_upper = box_lower
    write_bounds(i, box_lower, box_upper, boxes_out)
