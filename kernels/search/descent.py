"""Dual-tree descent of a CPU thread: by boxes of nodes, then by slabs of subtrees where they pay.

Slabs are made where few of many tests of boxes have led to hits. Of an object that is the first of several pairs in a
row they serve all of these, and so pay where hits are more frequent too. What decides is the list of pairs alone, so
that node pair tests are the same in every launch.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import StatePool, Trees
from warp_abtree.kernels.base.poses import PairPose

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

ITEMS_AT_ONCE = native.constant("ITEMS_AT_ONCE")
CPU_STACK_LENGTH = native.constant("CPU_STACK_LENGTH")
DEPTH_FIRST_LENGTH = native.constant("DEPTH_FIRST_LENGTH")
SUBTREES_KEPT = 512
SUBTREE_DEPTH, SUBTREE_RECORDS = native.constant("SUBTREE_DEPTH"), native.constant("SUBTREE_RECORDS")
# Zeros in front of a thread's memory say that it holds nothing.
SLAB_ZEROS = 32
SLAB_HEADER = native.constant("SLAB_HEADER")
NO_FLOOR = native.constant("NO_FLOOR")
# Slabs are made where so many pairs of nodes were compared for a hit, or more; the second is enough where all hits are
# wanted and the tests have taken longer than slabs do.
NODE_TESTS_A_HIT, NODE_TESTS_A_DENSE_HIT = wp.constant(wp.int64(256)), wp.constant(wp.int64(24))
NEVER = wp.constant(wp.int64(2**62))

# A thread tests so many face pairs at a time, so that its processor finds its way through either loop. For `any`, which
# an early hit ends, few at first, and twice as many after each search without one, so that what an end wastes is at
# most a part of what was needed.
FACES_READY, FACES_FOR_ANY = wp.constant(128), wp.constant(4)
ITEMS_FOR_ANY = wp.constant(8)
# So many items leave room to go on depth first from any of them.
STACK_TO_SHUFFLE = wp.constant(CPU_STACK_LENGTH // 2)
WAITING_LENGTH = int(FACES_READY) + 4 * ITEMS_AT_ONCE + 16  # 16 are written at a time


@wp.struct
class Descent:
    """State of a thread's descent into an object pair."""

    thread: wp.int32  # row of the memory for slabs
    at_once: wp.int32  # items taken from the stack
    ready: wp.int32  # leaf pairs that are tested together
    top: wp.int32  # items on the stack
    deep: wp.int32  # items below the floors
    floors: wp.vec2i  # levels of the subtrees that have slabs, NO_FLOOR for none
    tests: wp.int64  # pairs of nodes compared
    plain_tests: wp.int64  # node pair tests after which a pair of few hits has slabs
    looks: wp.int64  # node pair tests after which to look whether slabs are to be made
    repeats: wp.int32  # object pairs just before this one that have its A, at most 2: slabs of A serve them all
    cost: wp.int64  # `slab_cost`, -1 while it is not known


@native.func_native(cpu=True)
def descend(
    states: StatePool,
    pose: PairPose,
    most: wp.int64,
    descent: wp.ref[Descent],
    stack: wp.array(dtype=wp.int64),
    faces: wp.array(dtype=wp.int64),
) -> wp.int32:
    """Test items from the top of a stack until there are none, or so many leaf pairs wait as are asked for.

    The same as `compare_node_pair`, four pairs of boxes at a time. Ends also once so many pairs of boxes were compared.

    Returns the leaf pairs that wait.
    """


@native.func_native(cpu=True)
def move_below(descent: wp.ref[Descent], stack: wp.array(dtype=wp.int64), below: wp.array(dtype=wp.int64)):
    """Move items near the top of a stack to an empty list if both nodes lie in subtrees whose roots are on floors.

    It has at most ITEMS_AT_ONCE then.
    """


@native.func_native(cpu=True)
def slab_cost(trees: Trees, pose: PairPose, repeats: wp.int32) -> wp.int64:
    """Estimate the cost of an object pair's slabs in node pair tests, for an A of one pair before it or two."""


@native.func_native(cpu=True)
def open_subtrees(trees: Trees, pose: PairPose, descent: wp.ref[Descent], memory: wp.array2d(dtype=wp.float32)):
    """Choose the slab directions of an object pair, and its floors, see `move_below`.

    Directions and slabs of A stay for the next pair with it, in this launch or a later one.
    """


@native.func_native(cpu=True)
def descend_subtrees(
    trees: Trees,
    pose: PairPose,
    descent: wp.ref[Descent],
    below: wp.array(dtype=wp.int64),
    memory: wp.array2d(dtype=wp.float32),
    faces: wp.array(dtype=wp.int64),
) -> wp.int32:
    """Test items below the floors until there are none, or so many leaf pairs wait as are asked for.

    Returns the leaf pairs that wait.
    """


def slab_memory_words(depth: int) -> int:
    """Return the length of a thread's memory for slabs, for trees of a depth at most."""
    slots = max(16, min(SUBTREES_KEPT, 2 ** max(0, depth - SUBTREE_DEPTH)))
    return 16 + SLAB_HEADER + slots * (2 + 32 * SUBTREE_RECORDS)


@wp.func
def count_repeats(p: wp.int32, pair_poses: wp.array(dtype=PairPose)):
    """Return how many object pairs just before one have the same A, at most 2."""
    node_a = pair_poses[p].node_a
    repeats = wp.int32(0)
    while repeats < wp.min(p, 2) and pair_poses[p - 1 - repeats].node_a == node_a:
        repeats += 1
    return repeats


@wp.func
def start_descent(for_any: bool, plain_tests: wp.int64, repeats: wp.int32, descent: wp.ref[Descent]):
    """Begin a descent from the item on the stack."""
    descent.at_once = wp.where(for_any, ITEMS_FOR_ANY, ITEMS_AT_ONCE)
    descent.ready = wp.where(for_any, FACES_FOR_ANY, FACES_READY)
    descent.top = 1
    descent.deep = 0
    descent.floors = wp.vec2i(NO_FLOOR, NO_FLOOR)
    descent.tests = wp.int64(0)
    descent.plain_tests = plain_tests
    descent.repeats = repeats
    # An early hit ends `any`.
    descent.cost = wp.where(for_any or repeats == 0, NEVER, wp.int64(-1))
    descent.looks = wp.where(descent.cost == NEVER, plain_tests, plain_tests / wp.int64(3))


@wp.func
def should_build_slabs(trees: Trees, pose: PairPose, hit_count: wp.int64, descent: wp.ref[Descent]):
    """Return whether to build slabs now; else note the number of tests after which to ask again."""
    tested = descent.tests
    if tested >= descent.plain_tests and hit_count * NODE_TESTS_A_HIT <= tested:
        return True
    if descent.cost < wp.int64(0):
        descent.cost = slab_cost(trees, pose, descent.repeats)
    if tested >= descent.cost and hit_count * NODE_TESTS_A_DENSE_HIT <= tested:
        return True
    descent.looks = tested * wp.int64(2)
    if tested < descent.plain_tests:
        descent.looks = wp.min(descent.looks, descent.plain_tests)
    if tested < descent.cost:
        descent.looks = wp.min(descent.looks, descent.cost)
    return False


@wp.func
def advance(
    trees: Trees,
    pose: PairPose,
    hit_count: wp.int64,
    descent: wp.ref[Descent],
    stack: wp.array(dtype=wp.int64),
    below: wp.array(dtype=wp.int64),
    memory: wp.array2d(dtype=wp.float32),
    faces: wp.array(dtype=wp.int64),
):
    """Descend until leaf pairs wait; return how many. Boxes decide until slabs are made; then these, below floors."""
    if descent.top > 0 and descent.tests >= descent.looks:
        if should_build_slabs(trees, pose, hit_count, descent):
            open_subtrees(trees, pose, descent, memory)
            descent.looks = NEVER
    plain = descent.floors[0] == NO_FLOOR
    if not plain and descent.deep == 0:
        move_below(descent, stack, below)
    if descent.deep > 0:
        return descend_subtrees(trees, pose, descent, below, memory, faces)
    most = wp.where(plain, descent.looks - descent.tests, wp.int64(1))
    return descend(trees.states, pose, most, descent, stack, faces)


@wp.func
def shuffle_stack(met: wp.int32, descent: wp.ref[Descent], stack: wp.array(dtype=wp.int64)):
    """End a search that found a hit; else swap a pseudo-random item to the top, and take more at a time."""
    if met > 0:
        descent.top = 0
        descent.deep = 0
    descent.at_once = wp.min(2 * descent.at_once, ITEMS_AT_ONCE)
    descent.ready = wp.min(2 * descent.ready, FACES_READY)
    last = descent.top - 1
    if last > 0 and last < STACK_TO_SHUFFLE:
        at = wp.int32((descent.tests * wp.int64(40503) >> wp.int64(8)) % wp.int64(descent.top))
        item = stack[at]
        stack[at] = stack[last]
        stack[last] = item
