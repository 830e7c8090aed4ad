"""The search of the CPU: threads that take one object pair after the other, in vector instructions.

Node pairs go depth first, but those that are far for what has been found wait until something nearer may be: few are
looked at then that a search from the answer would not. Faces are measured in float32, 16 at a time, within an error
that is proven as in `triangle_pair` with u = 2^-24 and for the coordinates as in docs/exactness.md; float64 decides
between those that may be the nearest. It is the same answer that warps give on CUDA.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.arrays import ModelPool, StatePool
from warp_abtree.kernels.distance.frame import (
    NO_FACES,
    Found,
    Frame,
    Nearest,
    Tolerances,
    load_triangles,
    scaled_up,
    spare_of,
)
from warp_abtree.kernels.distance.slabs import Slabs, has_slabs
from warp_abtree.kernels.distance.triangle_pair import triangle_distance
from warp_abtree.kernels.generation import STALE
from warp_abtree.kernels.poses import PairPose
from warp_abtree.kernels.traversal.face_pairs import Hits
from warp_abtree.kernels.traversal.load_balance import take_unit
from warp_abtree.kernels.traversal.node_pair import first_item, item_first, item_second
from warp_abtree.kernels.traversal.simd import take_thread

MODULE_OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(MODULE_OPTIONS)

NEAREST_WORDS = native.constant("NEAREST_WORDS")


@wp.func_native(native.body("nearest/lists.h", "open_search"))
def open_search(
    upper: wp.float32,
    found: bool,
    first: wp.int64,
    way: wp.vec3,
    thread: wp.int32,
    memory: wp.array2d(dtype=wp.float32),
): ...


@wp.func_native(native.body("nearest/search.h", "search_nearest"))
def search_nearest(
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    frame: Frame,
    spare: wp.vec4,
    slabs: Slabs,
    with_slabs: bool,
    thread: wp.int32,
    memory: wp.array2d(dtype=wp.float32),
) -> wp.vec3i:
    """Search until the end, or until many pairs of faces wait for float64.

    Returns 1 at the end, and how many pairs of boxes were compared since the start, and pairs of faces.
    """


@wp.func_native(native.body("nearest/lists.h", "take_nearest"))
def take_nearest(upper: wp.float32, thread: wp.int32, memory: wp.array2d(dtype=wp.float32)) -> wp.int64:
    """Return the faces that wait and seem nearest, -1 if none may be the nearest.

    Args:
        upper: Scaled distance that the nearest faces are not beyond.
    """


@wp.func
def decide_open(
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    frame: Frame,
    thread: wp.int32,
    before: Nearest,
    memory: wp.array2d(dtype=wp.float32),
):
    """Measure in float64 what waits, the nearest first, as far as it matters; return the nearest."""
    nearest = before
    searching = bool(True)
    while searching:
        item = take_nearest(scaled_up(nearest.distance, frame), thread, memory)
        searching = item >= wp.int64(0)
        if searching:
            d = triangle_distance(load_triangles(models, states, pose, item_first(item), item_second(item)))
            if d < nearest.distance or (d == nearest.distance and item < nearest.faces):
                nearest.distance = d
                nearest.faces = item
    return nearest


@wp.kernel(module="unique", module_options=MODULE_OPTIONS)
def search_thread_kernel(
    tolerances: Tolerances,
    models: ModelPool,
    states: StatePool,
    pair_count: wp.array(dtype=wp.int32),
    pair_poses: wp.array(dtype=PairPose),
    counter: wp.array(dtype=wp.int32),
    slabs: Slabs,
    found_inout: Found,
    hits_inout: Hits,
    memory_out: wp.array2d(dtype=wp.float32),
):
    """Take one object pair after the other that does not intersect, and search it; CPU only, a thread a core."""
    if found_inout.launched[0] == STALE:
        return
    count = wp.min(pair_count[0], pair_poses.shape[0])
    thread = take_thread(counter)
    if thread >= memory_out.shape[0]:
        return
    p = take_unit(counter)
    while p < count:
        if hits_inout.any_hit[p] == 0:
            pose = pair_poses[p]
            frame = found_inout.frame[p]
            nearest = Nearest()
            nearest.distance = found_inout.distance[p]
            nearest.faces = found_inout.faces[p]
            with_slabs = has_slabs(slabs, p)
            spare = spare_of(tolerances, frame)
            upper, found = scaled_up(nearest.distance, frame), nearest.faces != NO_FACES
            open_search(upper, found, first_item(states, pose), frame.way, thread, memory_out)
            state = wp.vec3i()
            while state[0] == 0:
                state = search_nearest(models, states, pose, frame, spare, slabs, with_slabs, thread, memory_out)
                nearest = decide_open(models, states, pose, frame, thread, nearest, memory_out)
            hits_inout.node_tests[p] += wp.int64(state[1])
            hits_inout.triangle_tests[p] += wp.int64(state[2])
            found_inout.distance[p] = nearest.distance
            found_inout.faces[p] = nearest.faces
        p = take_unit(counter)
