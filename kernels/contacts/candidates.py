"""The candidates of a pair's contacts, listed and searched by the threads of a block, on the CPU by one."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.contacts.manifold import NO_DEPTH, Curves

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

CANDIDATES = wp.constant(2)  # of each contact, numbered on from contact to contact


@native.func_native()
def group_size() -> wp.int32: ...


@native.func_native()
def group_lane() -> wp.int32: ...


@native.func_native()
def group_sync(): ...


@native.func_native()
def must_measure(chosen: wp.int32) -> bool:
    """Return whether all candidates are measured against the points chosen: always on a GPU, without divergence."""


@native.func_native()
def greatest_of_group(x: wp.float64, item: wp.int32) -> wp.vec2d:
    """Return the greatest number of all threads, and the item of a thread that has it, the least of several."""


@native.func_native()
def next_place_of_group(end: wp.ref[wp.int32], flag: bool) -> wp.int32:
    """Return this thread's place in a list that ends there, of the threads whose flag is set, and move the end."""


@wp.func
def best_of_group(value: wp.float64, candidate: wp.int32):
    """Return the candidate of the greatest value of all threads, the first of several, and that value."""
    best = greatest_of_group(value, candidate)
    return wp.int32(best[1]), best[0]


@wp.func
def list_candidates(first: wp.int32, end: wp.int32, curves: Curves):
    """List the contacts of a pair that have candidates, in their order, where its contacts start; return its end.

    Of faces that are apart a fifth has some, which every choice looks at.
    """
    listed, next = wp.int32(first), wp.int32(first)
    while next < end:
        i = next + group_lane()
        has = i < end
        if has:
            has = curves.depth[i, 0] == curves.depth[i, 0] or curves.depth[i, 1] == curves.depth[i, 1]
        place = next_place_of_group(listed, has)
        if has:
            curves.listed[place] = i
        next += group_size()
    group_sync()
    return listed


@wp.func
def find_deepest(first: wp.int32, end: wp.int32, curves: Curves):
    """Return the deepest candidate of those listed and its depth, NO_DEPTH where there is none."""
    deepest = NO_DEPTH
    best = CANDIDATES * first
    at = first + group_lane()
    while at < end:
        i = curves.listed[at]
        for k in range(CANDIDATES):
            if curves.depth[i, k] > deepest:
                deepest = curves.depth[i, k]
                best = CANDIDATES * i + k
        at += group_size()
    return best_of_group(deepest, best)


@wp.func
def find_outermost(first: wp.int32, end: wp.int32, least: wp.float64, along: wp.vec3d, curves: Curves):
    """Return the candidate that reaches farthest along a direction, of those of a least depth, and how far."""
    origin = curves.point[first, 0]
    farthest = -wp.float64(wp.inf)
    best = CANDIDATES * first
    at = first + group_lane()
    while at < end:
        i = curves.listed[at]
        for k in range(CANDIDATES):
            reach = wp.dot(along, curves.point[i, k] - origin)
            if curves.depth[i, k] >= least and reach > farthest:
                farthest = reach
                best = CANDIDATES * i + k
        at += group_size()
    return best_of_group(farthest, best)
