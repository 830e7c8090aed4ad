"""Candidates of a pair's contact points as wrenches, listed by the threads of a block, on the CPU by one.

A wrench is two entries of 16 bytes, in the frame of A, for which motions are small:

    127        96 95         64 63         32 31          0
    [ separation |  normal z   |  normal y   |  normal x   ]
    [   number   |  moment z   |  moment y   |  moment x   ]

The moment is that of the normal about the middle of all candidates of the pair, over their `size`, so that rotations
count as what they move. Separations count from the deepest candidate, if that is inside: as if both objects had first
come apart as far as that. The number is the candidate's place among those of all contacts.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.nodes import store_entry
from warp_abtree.kernels.contacts.column import COLUMN_CORNERS, NO_DEPTH
from warp_abtree.kernels.contacts.manifold import Witnesses

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@native.func_native()
def group_size() -> wp.int32: ...


@native.func_native()
def group_lane() -> wp.int32: ...


@native.func_native()
def group_sync(): ...


@native.func_native()
def greatest_of_group(x: wp.float64) -> wp.float64:
    """Return the greatest number of all threads."""


@native.func_native()
def next_place_of_group(end: wp.ref[wp.int32], flag: bool) -> wp.int32:
    """Return this thread's place in a list that ends there, of the threads whose flag is set, and move the end."""


@wp.struct
class ObjectPose:
    """Pose of A, and the sense in which its pair names the objects."""

    rotation: wp.mat33d  # to the world
    position: wp.vec3d  # [world units]
    sense: wp.float64  # 1, or -1 where B is named first


@wp.struct
class Candidates:
    """Candidates of a pair."""

    first: wp.int32  # where its wrenches begin
    end: wp.int32  # where they end
    deepest: wp.float64  # depth of the deepest, NO_DEPTH where none has one [world units]
    middle: wp.vec3d  # of their box, A's frame [world units]
    size: wp.float64  # half of its diagonal [world units]


@wp.func
def has_candidate(number: wp.int32, lowest: wp.float64, witnesses: Witnesses):
    """Return whether there is a candidate of a number that is deep enough."""
    return witnesses.depth[number / COLUMN_CORNERS, number % COLUMN_CORNERS] >= lowest


@wp.func
def deepest_of(first: wp.int32, end: wp.int32, witnesses: Witnesses):
    """Return the depth of the deepest candidate of some numbers, NO_DEPTH where there is none."""
    deepest = NO_DEPTH
    number = first + group_lane()
    while number < end:
        if has_candidate(number, NO_DEPTH, witnesses):
            deepest = wp.max(deepest, witnesses.depth[number / COLUMN_CORNERS, number % COLUMN_CORNERS])
        number += group_size()
    return greatest_of_group(deepest)


@wp.func
def list_wrenches(span: wp.vec2i, lowest: wp.float64, pose: ObjectPose, found: Candidates, witnesses: Witnesses):
    """List the wrenches of a pair's candidates in the order of their numbers, and return where they end."""
    back, zero, one = wp.transpose(pose.rotation), wp.float64(0.0), wp.float64(1.0)
    deepest = wp.max(found.deepest, zero)
    scale = wp.where(found.size > zero, one / found.size, zero)
    end, base = wp.int32(found.first), COLUMN_CORNERS * span[0]
    while base < COLUMN_CORNERS * span[1]:
        number = base + group_lane()
        lists = number < COLUMN_CORNERS * span[1]
        if lists:
            lists = has_candidate(number, lowest, witnesses)
        place = next_place_of_group(end, lists)
        if lists:
            i, k = number / COLUMN_CORNERS, number % COLUMN_CORNERS
            n = pose.sense * (back * witnesses.normal[i])
            arm = (back * (witnesses.point[i, k] - pose.position) - found.middle) * scale
            m = wp.cross(arm, n)
            depth = wp.where(witnesses.depth[i, k] == NO_DEPTH, zero, witnesses.depth[i, k])
            entry = wp.vec4(wp.float32(n[0]), wp.float32(n[1]), wp.float32(n[2]), wp.float32(deepest - depth))
            store_entry(witnesses.wrench, wp.int64(2) * wp.int64(place), entry)
            entry = wp.vec4(wp.float32(m[0]), wp.float32(m[1]), wp.float32(m[2]), wp.cast(number, wp.float32))
            store_entry(witnesses.wrench, wp.int64(2) * wp.int64(place) + wp.int64(1), entry)
        base += group_size()
    group_sync()
    return end


@wp.func
def list_candidates(span: wp.vec2i, shell: wp.float64, pose: ObjectPose, witnesses: Witnesses):
    """List the candidates of a pair, deeper than minus its gap; middles of contacts where no face has a depth.

    Args:
        span: Where the pair's witnesses begin and end.
        shell: The gap.
    """
    found = Candidates()
    first, end = COLUMN_CORNERS * span[0], COLUMN_CORNERS * span[1]
    found.first = first
    found.deepest = deepest_of(first, end, witnesses)
    lowest = wp.where(found.deepest == NO_DEPTH, NO_DEPTH, -shell)
    low = wp.vec3d(-wp.float64(wp.inf))
    high = wp.vec3d(-wp.float64(wp.inf))
    back = wp.transpose(pose.rotation)
    number = first + group_lane()
    while number < end:
        if has_candidate(number, lowest, witnesses):
            x = back * (witnesses.point[number / COLUMN_CORNERS, number % COLUMN_CORNERS] - pose.position)
            low = wp.max(low, -x)
            high = wp.max(high, x)
        number += group_size()
    for k in range(3):
        low[k] = greatest_of_group(low[k])
        high[k] = greatest_of_group(high[k])
    found.middle = wp.float64(0.5) * (high - low)
    found.size = wp.float64(0.5) * wp.length(high + low)
    found.end = list_wrenches(span, lowest, pose, found, witnesses)
    return found
