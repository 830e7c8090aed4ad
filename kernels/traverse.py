"""ACTIVE-INTERSECT: dual-tree traversal of many object pairs, every intersecting face pair reported.

Two regimes, one answer: a thread a pair, depth first (CPU), and a block a pair around a shared stack (CUDA).
Both visit the same pairs of nodes and differ in their order only.
Source: Liu et al. 2006, section 3.2.2, ACTIVE-INTERSECT.
"""

import functools

import warp as wp

from warp_abtree.kernels.boxes import boxes_overlap
from warp_abtree.kernels.distance import triangles_near
from warp_abtree.kernels.pools import ModelPool, ObjectPool, StatePool
from warp_abtree.kernels.pose import PairPose, pose_point
from warp_abtree.kernels.predicates import EXACT, FILTER, FLOAT32, UNSURE
from warp_abtree.kernels.screen import SCREEN_UNIT, screen_triangles
from warp_abtree.kernels.triangle import intersect_triangles

MODULE_OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(MODULE_OPTIONS)

OUTPUT_ANY = wp.constant(0)
OUTPUT_COUNT = wp.constant(1)
OUTPUT_FACES = wp.constant(2)

# In place of a precision: faces count as met unless proved farther apart than a distance.
WITHIN = wp.constant(-1)

# A visit replaces one entry by two a level deeper, so depth first holds at most one entry a level of either tree,
# plus one.
STACK_LENGTH = wp.constant(64)
stack_type = wp.types.vector(length=128, dtype=wp.int32)

# Hits, then the work done: node, triangle, float64 and exact tests.
counts_type = wp.types.vector(length=5, dtype=wp.int64)

SHARED_LENGTH = wp.constant(2048)
CANDIDATE_LENGTH = wp.constant(512)  # two blocks of the largest size


@wp.struct
class PairTrees:
    """Where the two trees of a pair lie in the pools."""

    node_a: wp.int32
    node_b: wp.int32
    face_node_a: wp.int32
    face_node_b: wp.int32
    corner_a: wp.int32
    corner_b: wp.int32


@wp.struct
class Hits:
    """Results of a batch of pairs.

    any_hit, count: shape [pair]. face: (pair, face a, face b), a of the pair's first object, shape [capacity]; total
    numbers them and may wrap, the demand is the sum of count. node_tests to exact_tests: work done,
    shape [pair]; float64_tests are the triangle tests that float32 left open, exact_tests those that took expansions.
    unsure: (pair, face of the lower object, face of the higher) that wait for the next stage, shape [capacity].
    """

    any_hit: wp.array(dtype=wp.int32)
    count: wp.array(dtype=wp.int64)
    face: wp.array(dtype=wp.vec3i)
    total: wp.array(dtype=wp.int32)
    node_tests: wp.array(dtype=wp.int64)
    triangle_tests: wp.array(dtype=wp.int64)
    float64_tests: wp.array(dtype=wp.int64)
    exact_tests: wp.array(dtype=wp.int64)
    unsure: wp.array(dtype=wp.vec3i)
    unsure_total: wp.array(dtype=wp.int32)


@wp.func
def locate_pair(models: ModelPool, states: StatePool, objects: ObjectPool, pair: wp.vec2i):
    """Return whether a pair names its higher object first, and its trees, the lower object's as A."""
    state_a = objects.state[wp.min(pair[0], pair[1])]
    state_b = objects.state[wp.max(pair[0], pair[1])]
    trees = PairTrees()
    trees.node_a = states.node_start[state_a]
    trees.node_b = states.node_start[state_b]
    trees.face_node_a = models.node_start[states.model[state_a]]
    trees.face_node_b = models.node_start[states.model[state_b]]
    trees.corner_a = states.face_start[state_a]
    trees.corner_b = states.face_start[state_b]
    return wp.where(pair[0] > pair[1], 1, 0), trees


@wp.func
def screen_faces(
    mode: wp.int32,
    models: ModelPool,
    states: StatePool,
    trees: PairTrees,
    pose: PairPose,
    face_a: wp.int32,
    face_b: wp.int32,
):
    """Test one active face of A against one of B in float32; return 1, 0 or UNSURE."""
    a = states.face_corner[trees.corner_a + face_a]
    b = states.face_corner[trees.corner_b + face_b]
    error = pose.error
    unit = SCREEN_UNIT
    if mode == FLOAT32:
        error = 0.0
        unit = 0.0
    s = wp.float32(pose.scale)
    return screen_triangles(
        error,
        unit,
        models.vertex_near[a[0]] * s,
        models.vertex_near[a[1]] * s,
        models.vertex_near[a[2]] * s,
        (pose.rotation32 * models.vertex_near[b[0]] + pose.translation32) * s,
        (pose.rotation32 * models.vertex_near[b[1]] + pose.translation32) * s,
        (pose.rotation32 * models.vertex_near[b[2]] + pose.translation32) * s,
    )


@wp.func
def test_faces(
    mode: wp.int32,
    models: ModelPool,
    states: StatePool,
    trees: PairTrees,
    pose: PairPose,
    face_a: wp.int32,
    face_b: wp.int32,
):
    """Test one active face of A against one of B in float64, in A's frame; return 1, 0 or UNSURE."""
    a = states.face_corner[trees.corner_a + face_a]
    b = states.face_corner[trees.corner_b + face_b]
    a0 = models.vertex_pos[a[0]]
    a1 = models.vertex_pos[a[1]]
    a2 = models.vertex_pos[a[2]]
    b0 = pose_point(pose.rotation, pose.translation, models.vertex_pos[b[0]])
    b1 = pose_point(pose.rotation, pose.translation, models.vertex_pos[b[1]])
    b2 = pose_point(pose.rotation, pose.translation, models.vertex_pos[b[2]])
    if mode == WITHIN:
        return triangles_near(pose.within, a0, a1, a2, b0, b1, b2)
    if mode == FLOAT32:
        # A power of two brings the model to unit size, so that no product leaves float32's range.
        s = pose.scale
        return intersect_triangles(mode, a0 * s, a1 * s, a2 * s, b0 * s, b1 * s, b2 * s)
    return intersect_triangles(mode, a0, a1, a2, b0, b1, b2)


@wp.func
def settle_faces(
    mode: wp.int32,
    models: ModelPool,
    states: StatePool,
    trees: PairTrees,
    pose: PairPose,
    face_a: wp.int32,
    face_b: wp.int32,
):
    """Decide a pair of faces that float32 left open; return whether they meet, and whether it took expansions."""
    if mode != EXACT:
        return test_faces(mode, models, states, trees, pose, face_a, face_b), 0
    meet = test_faces(FILTER, models, states, trees, pose, face_a, face_b)
    if meet != UNSURE:
        return meet, 0
    return test_faces(mode, models, states, trees, pose, face_a, face_b), 1


@wp.func
def decide_faces(
    mode: wp.int32,
    deferring: bool,
    models: ModelPool,
    states: StatePool,
    trees: PairTrees,
    pose: PairPose,
    face_a: wp.int32,
    face_b: wp.int32,
):
    """Return whether a pair of faces meets, and the stage that said so: 0 float32, 1 float64, 2 expansions.

    Where the later stages are left to another kernel, pairs that need them are UNSURE at stage 1.
    """
    if mode == WITHIN:
        return test_faces(mode, models, states, trees, pose, face_a, face_b), 0
    meet = screen_faces(mode, models, states, trees, pose, face_a, face_b)
    if meet != UNSURE:
        return meet, 0
    if deferring:
        return meet, 1
    meet, hard = settle_faces(mode, models, states, trees, pose, face_a, face_b)
    return meet, 1 + hard


@wp.func
def defer_faces(pair: wp.int32, face_a: wp.int32, face_b: wp.int32, hits: Hits):
    """Put a pair of faces on the list that `settle_faces_kernel` works off; its count goes on past the capacity."""
    slot = wp.atomic_add(hits.unsure_total, 0, 1)
    if slot >= 0 and slot < hits.unsure.shape[0]:
        hits.unsure[slot] = wp.vec3i(pair, face_a, face_b)


@wp.func
def count_test(stage: wp.int32):
    """Return what one triangle test decided at a stage adds to the counts."""
    counts = counts_type()
    counts[2] = wp.int64(1)
    counts[3] = wp.int64(wp.min(stage, 1))
    counts[4] = wp.int64(wp.max(stage - 1, 0))
    return counts


@wp.func
def report_hit(output: wp.int32, pair: wp.int32, swapped: wp.int32, face_a: wp.int32, face_b: wp.int32, hits: Hits):
    hits.any_hit[pair] = 1
    if output == OUTPUT_FACES:
        slot = wp.atomic_add(hits.total, 0, 1)
        if slot >= 0 and slot < hits.face.shape[0]:
            if swapped != 0:
                hits.face[slot] = wp.vec3i(pair, face_b, face_a)
            else:
                hits.face[slot] = wp.vec3i(pair, face_a, face_b)


@wp.func
def visit_nodes(
    models: ModelPool, states: StatePool, trees: PairTrees, pose: PairPose, node_a: wp.int32, node_b: wp.int32
):
    """Test one pair of nodes and say what follows.

    Returns (kind, x, y): kind 0 nothing, 1 the leaves' faces x and y are candidates, 2 descend A into x and y,
    3 descend B. x and y are skip nodes, a leaf or two active children each, so that a coarse LOD costs no more node
    tests than a tree built for it.
    """
    lower_a = states.node_lower[trees.node_a + node_a]
    upper_a = states.node_upper[trees.node_a + node_a]
    lower_b = states.node_lower[trees.node_b + node_b]
    upper_b = states.node_upper[trees.node_b + node_b]
    if not boxes_overlap(lower_a, upper_a, lower_b, upper_b, pose.rotation32, pose.translation32, pose.margin):
        return 0, 0, 0
    face_a = models.node_face[trees.face_node_a + node_a]
    face_b = models.node_face[trees.face_node_b + node_b]
    if face_a >= 0 and face_b >= 0:
        return 1, face_a, face_b
    size_a = upper_a - lower_a
    size_b = upper_b - lower_b
    larger_a = size_a[0] + size_a[1] + size_a[2] >= size_b[0] + size_b[1] + size_b[2]
    if face_b >= 0 or (face_a < 0 and larger_a):
        at = trees.node_a + 2 * node_a
        return 2, states.node_skip[at], states.node_skip[at + 1]
    at = trees.node_b + 2 * node_b
    return 3, states.node_skip[at], states.node_skip[at + 1]


@wp.func
def traverse_depth_first(
    output: wp.int32,
    mode: wp.int32,
    deferring: bool,
    pair: wp.int32,
    swapped: wp.int32,
    start_a: wp.int32,
    start_b: wp.int32,
    models: ModelPool,
    states: StatePool,
    trees: PairTrees,
    pose: PairPose,
    hits: Hits,
):
    """Traverse from one pair of nodes in this thread; return the counts."""
    stack = stack_type()
    stack[0] = start_a
    stack[1] = start_b
    top = wp.int32(1)
    counts = counts_type()
    one = wp.int64(1)
    while top > 0:
        top -= 1
        node_a = stack[2 * top]
        node_b = stack[2 * top + 1]
        kind, x, y = visit_nodes(models, states, trees, pose, node_a, node_b)
        counts[1] += one
        if kind == 1:
            meet, stage = decide_faces(mode, deferring, models, states, trees, pose, x, y)
            counts += count_test(stage)
            if meet == UNSURE:
                defer_faces(pair, x, y, hits)
            elif meet == 1:
                counts[0] += one
                report_hit(output, pair, swapped, x, y, hits)
                if output == OUTPUT_ANY:
                    top = 0
        elif kind == 2:
            stack[2 * top] = x
            stack[2 * top + 1] = node_b
            stack[2 * top + 2] = y
            stack[2 * top + 3] = node_b
            top += 2
        elif kind == 3:
            stack[2 * top] = node_a
            stack[2 * top + 1] = x
            stack[2 * top + 2] = node_a
            stack[2 * top + 3] = y
            top += 2
    return counts


@functools.cache
def thread_traversal(mode: int):
    """Return the kernel that gives a thread each object pair, at a precision or WITHIN."""

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def traverse_thread_kernel(
        output: wp.int32,
        models: ModelPool,
        states: StatePool,
        objects: ObjectPool,
        pair_count: wp.array(dtype=wp.int32),
        pairs: wp.array(dtype=wp.vec2i),
        pair_poses: wp.array(dtype=PairPose),
        hits_out: Hits,
    ):
        """Traverse one object pair a thread, depth first."""
        p = wp.tid()
        if p >= wp.min(pair_count[0], pairs.shape[0]):
            return
        swapped, trees = locate_pair(models, states, objects, pairs[p])
        skip_a = states.node_skip[trees.node_a + 1]
        skip_b = states.node_skip[trees.node_b + 1]
        counts = traverse_depth_first(
            output, wp.static(mode), False, p, swapped, skip_a, skip_b, models, states, trees, pair_poses[p], hits_out
        )
        hits_out.count[p] = counts[0]
        hits_out.node_tests[p] = counts[1]
        hits_out.triangle_tests[p] = counts[2]
        hits_out.float64_tests[p] = counts[3]
        hits_out.exact_tests[p] = counts[4]

    return traverse_thread_kernel


@wp.func
def finish_refused(
    output: wp.int32,
    mode: wp.int32,
    pair: wp.int32,
    swapped: wp.int32,
    refused: bool,
    node: wp.vec2i,
    models: ModelPool,
    states: StatePool,
    trees: PairTrees,
    pose: PairPose,
    hits: Hits,
):
    """Traverse depth first from a pair of nodes that the shared stack had no room for; return the counts."""
    if refused:
        return traverse_depth_first(
            output, mode, True, pair, swapped, node[0], node[1], models, states, trees, pose, hits
        )
    return counts_type()


@functools.cache
def block_traversal(mode: int):
    """Return the kernel that gives a block of threads each object pair, FLOAT32, WITHIN, or for both other precisions.

    What float32 leaves open waits for `settle_traversal`.
    """

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, cuda_max_registers=168)
    def traverse_block_kernel(
        output: wp.int32,
        models: ModelPool,
        states: StatePool,
        objects: ObjectPool,
        pair_count: wp.array(dtype=wp.int32),
        pairs: wp.array(dtype=wp.vec2i),
        pair_poses: wp.array(dtype=PairPose),
        hits_out: Hits,
    ):
        """Traverse one object pair a block: its threads pop node pairs from a shared stack and push what overlaps.

        Candidate faces wait on a second stack until every thread has one. Threads finish what the full stack refuses.
        """
        p, lane = wp.tid()
        if p >= wp.min(pair_count[0], pairs.shape[0]):
            return
        swapped, trees = locate_pair(models, states, objects, pairs[p])
        pose = pair_poses[p]
        counts = counts_type()
        one = wp.int64(1)
        stack = wp.tile_stack(capacity=SHARED_LENGTH, dtype=wp.vec2i)
        # Visits stop at block_dim candidates and add at most as many, so this stack never fills.
        candidates = wp.tile_stack(capacity=CANDIDATE_LENGTH, dtype=wp.vec2i)
        start = wp.vec2i(states.node_skip[trees.node_a + 1], states.node_skip[trees.node_b + 1])
        wp.tile_stack_push(stack, start, lane == 0)
        ready = wp.where(output == OUTPUT_ANY, 1, wp.block_dim())
        while wp.tile_stack_count(stack) + wp.tile_stack_count(candidates) > 0:
            # For `any` a hit empties the stacks: items are popped and dropped, so all threads leave the loop together.
            if wp.tile_stack_count(candidates) >= ready or wp.tile_stack_count(stack) == 0:
                faces, face_slot = wp.tile_stack_pop(candidates)
                if face_slot >= 0 and (output != OUTPUT_ANY or hits_out.any_hit[p] == 0):
                    meet, stage = decide_faces(wp.static(mode), True, models, states, trees, pose, faces[0], faces[1])
                    counts += count_test(stage)
                    if meet == UNSURE:
                        defer_faces(p, faces[0], faces[1], hits_out)
                    elif meet == 1:
                        counts[0] += one
                        report_hit(output, p, swapped, faces[0], faces[1], hits_out)
            else:
                item, slot = wp.tile_stack_pop(stack)
                kind, x, y = wp.int32(0), wp.int32(0), wp.int32(0)
                if slot >= 0 and (output != OUTPUT_ANY or hits_out.any_hit[p] == 0):
                    kind, x, y = visit_nodes(models, states, trees, pose, item[0], item[1])
                    counts[1] += one
                wp.tile_stack_push(candidates, wp.vec2i(x, y), kind == 1)
                for child in range(2):
                    z = wp.where(child == 0, x, y)
                    node = wp.where(kind == 2, wp.vec2i(z, item[1]), wp.vec2i(item[0], z))
                    kept = wp.tile_stack_push(stack, node, kind >= 2)
                    refused = kind >= 2 and kept < 0
                    counts += finish_refused(
                        output, wp.static(mode), p, swapped, refused, node, models, states, trees, pose, hits_out
                    )
        wp.atomic_add(hits_out.count, p, counts[0])
        wp.atomic_add(hits_out.node_tests, p, counts[1])
        wp.atomic_add(hits_out.triangle_tests, p, counts[2])
        wp.atomic_add(hits_out.float64_tests, p, counts[3])
        wp.atomic_add(hits_out.exact_tests, p, counts[4])

    return traverse_block_kernel
