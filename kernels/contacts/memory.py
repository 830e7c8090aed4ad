"""Contact points kept between launches: object pairs that have hardly moved since their search keep its points.

A pair rests while no point of its smaller object's box has moved farther, as the other one sees it, than a distance,
its gap has grown by no more than what is left of that, and neither object has changed its LOD. It is not traversed.
Each of its points is one of either object, which were the same when the pair was searched: it lies in their middle now,
and is as much less deep as they have come apart along its normal, which turns with the lower object. So what the pair
lacks is a point that came nearer by that distance at most, where objects overlap but little: the way out of deep
overlaps can turn within it. The motion counts from the search, not from the last launch,
so that slow motions add up.

A point of a pair that was searched again is one of those before if it is the nearest to it and the other way round, no
farther than `MATCH_SHARE` of the smaller object's size, with normals within 60 degrees.

What a launch finds then depends on those before it, in the same way on every device. There are two tables, by turns:
one is read, and the other written, in the order of the launch's pairs. Source of contacts as a point of either body:
the persistent manifolds of physics engines, such as Bullet's and PhysX's.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees, pair_key
from warp_abtree.kernels.base.lanes import next_place, warp_lane, warp_size
from warp_abtree.kernels.base.nodes import load_node
from warp_abtree.kernels.base.poses import PairBatch, pose_point, relative_pose
from warp_abtree.kernels.contacts.manifold import Manifolds
from warp_abtree.kernels.contacts.slots import smaller_size, tree_size
from warp_abtree.kernels.intersect.face_pairs import Hits, is_whole

wp.set_module_options(native.options("base/lanes.cuh"))

# Unless told otherwise a pair rests within this part of its gap, and of its smaller object's size: half of its box's
# diagonal, so that wide gaps do not hide what comes.
GAP_SHARE, SIZE_SHARE = wp.constant(wp.float64(2.0**-3)), wp.constant(wp.float64(2.0**-11))
# Part of the smaller object's size that a point may have moved to be the same.
MATCH_SHARE, MATCH_COSINE = wp.constant(wp.float64(2.0**-5)), wp.constant(wp.float64(0.5))
# Part of the smaller object's size that points which touch may be apart.
TOUCH_SHARE = wp.constant(wp.float64(2.0**-40))


@wp.struct
class SearchedPair:
    """An object pair when it was searched. In this order nothing is padded."""

    rotation: wp.mat33d  # of B in A's frame, A the lower object
    translation: wp.vec3d  # the same
    gap: wp.float64  # within which points were [world units]
    lods: wp.vec2i  # of both objects
    any_hit: wp.int32  # as of `Hits`
    count: wp.int32  # points


@wp.struct
class KeptPoint:
    """A contact point when its pair was searched."""

    on_a: wp.vec3d  # [units of A's model], A's frame
    on_b: wp.vec3d  # [units of B's model], B's frame
    normal: wp.vec3d  # from the pair's first object to its second, A's frame
    depth: wp.float64  # [world units]


@wp.struct
class PointMemory:
    """Points of the last search of object pairs, in two tables."""

    turn: wp.array(dtype=wp.int32)  # the table that is read, shape [1]
    known: wp.array(dtype=wp.int32)  # pairs in it, shape [1]
    launches: wp.array(dtype=wp.int32)  # that have written a table, shape [1]
    pairs: wp.array2d(dtype=wp.vec2i)  # in the order of the launch, shape [2, pair]
    searched: wp.array2d(dtype=SearchedPair)  # shape [2, pair]
    points: wp.array3d(dtype=KeptPoint)  # shape [2, pair, points]
    shown: wp.array3d(dtype=wp.int32)  # place among those of the last launch, -1 for none, shape [2, pair, points]


@wp.struct
class Rest:
    """How far the objects of a pair may have moved while it rests."""

    distance: wp.float64  # [world units], negative for `GAP_SHARE` and `SIZE_SHARE`
    sorted: wp.bool  # whether pairs are in the order of their objects; else they keep their places


@wp.func
def find_remembered(p: wp.int32, pair: wp.vec2i, rest: Rest, memory: PointMemory):
    """Return the place of an object pair in the table that is read, -1 where it is not there."""
    turn, low, high = memory.turn[0], wp.int32(0), wp.int32(memory.known[0])
    if not rest.sorted:
        low = wp.min(p, high)
    while rest.sorted and low < high:
        middle = (low + high) / 2
        if pair_key(memory.pairs[turn, middle]) < pair_key(pair):
            low = middle + 1
        else:
            high = middle
    if low < memory.known[0] and memory.pairs[turn, low] == pair:
        return low
    return wp.int32(-1)


@wp.func
def lods_of(trees: Trees, pair: wp.vec2i):
    return wp.vec2i(
        trees.states.lod[trees.objects.state[pair[0]]],
        trees.states.lod[trees.objects.state[pair[1]]],
    )


@wp.func
def see_point(of_b: bool, rotation: wp.mat33d, translation: wp.vec3d, x: wp.vec3d):
    """Return a point of B in A's frame, or one of A in B's."""
    if of_b:
        return pose_point(rotation, translation, x)
    return wp.transpose(rotation) * (x - translation)


@wp.func
def farthest_motion(trees: Trees, a: wp.int32, b: wp.int32, rotation: wp.mat33d, translation: wp.vec3d):
    """Return how far the corners of the smaller object's box have moved at most since B had a pose in A's frame."""
    rotation_now, translation_now = relative_pose(trees.objects, a, b)
    of_a, of_b = trees.objects.state[a], trees.objects.state[b]
    moves_b = tree_size(trees, of_b) < tree_size(trees, of_a)
    own = wp.where(moves_b, of_b, of_a)
    root = load_node(trees.states, trees.states.node_start[own] + 1)
    centre, farthest = trees.models.centre[trees.states.model[own]], wp.float64(0.0)
    for k in range(8):
        x = wp.vec3d(
            wp.float64(wp.where((k & 1) == 0, root.lower[0], root.upper[0])),
            wp.float64(wp.where((k & 2) == 0, root.lower[1], root.upper[1])),
            wp.float64(wp.where((k & 4) == 0, root.lower[2], root.upper[2])),
        )
        now = see_point(moves_b, rotation_now, translation_now, centre + x)
        farthest = wp.max(farthest, wp.length(now - see_point(moves_b, rotation, translation, centre + x)))
    return farthest


@wp.kernel
def find_resting_kernel(
    rest: Rest,
    trees: Trees,
    batch: PairBatch,
    gap: wp.array(dtype=wp.float64),
    memory: PointMemory,
    row_out: wp.array(dtype=wp.int32),
    place_out: wp.array(dtype=wp.int32),
    asked_out: wp.array(dtype=wp.float64),
):
    """Find out whether one object pair a thread rests.

    Args:
        gap: Of each pair [world units], shape [pair].
        row_out: Its place in the table that is read, -1 where it is not there, shape [pair].
        place_out: The same, but -1 for a pair that is to be searched, shape [pair].
        asked_out: What the traversal takes as gap: -inf for a pair that rests, shape [pair].
    """
    p = wp.tid()
    if p >= wp.min(batch.count[0], batch.pairs.shape[0]):
        return
    place_out[p] = -1
    asked_out[p] = gap[p]
    pair, turn = batch.pairs[p], memory.turn[0]
    m = find_remembered(p, pair, rest, memory)
    row_out[p] = m
    if m < 0:
        return
    before = memory.searched[turn, m]
    if not (before.lods == lods_of(trees, pair)):
        return
    a, b = wp.min(pair[0], pair[1]), wp.max(pair[0], pair[1])
    limit = wp.float64(rest.distance)
    if limit < wp.float64(0.0):
        limit = wp.min(GAP_SHARE * gap[p], SIZE_SHARE * smaller_size(trees, a, b))
    moved = farthest_motion(trees, a, b, before.rotation, before.translation)
    if moved + wp.max(gap[p] - before.gap, wp.float64(0.0)) <= limit:
        place_out[p] = m
        asked_out[p] = -wp.float64(wp.inf)


@wp.kernel
def resume_resting_kernel(batch: PairBatch, place: wp.array(dtype=wp.int32), memory: PointMemory, hits_inout: Hits):
    """Say of one object pair a thread, if it rests, what was known of whether it intersects.

    Args:
        place: As for `find_resting_kernel`.
    """
    p = wp.tid()
    if p < wp.min(batch.count[0], batch.pairs.shape[0]) and place[p] >= 0:
        hits_inout.any_hit[p] = memory.searched[memory.turn[0], place[p]].any_hit


@wp.func
def recall_point(trees: Trees, batch: PairBatch, p: wp.int32, m: wp.int32, k: wp.int32, memory: PointMemory):
    """Return where point k of row m is now, of pair p, with its normal and its depth."""
    pair, kept = batch.pairs[p], memory.points[memory.turn[0], m, k]
    a, b = wp.min(pair[0], pair[1]), wp.max(pair[0], pair[1])
    rotation = trees.objects.rotation[a]
    of_a = pose_point(rotation, trees.objects.position[a], kept.on_a)
    of_b = pose_point(trees.objects.rotation[b], trees.objects.position[b], kept.on_b)
    n = rotation * kept.normal
    sense = wp.where(pair[0] == a, wp.float64(1.0), wp.float64(-1.0))
    return wp.float64(0.5) * (of_a + of_b), n, kept.depth + sense * wp.dot(of_a - of_b, n)


@wp.func
def recall_points(
    p: wp.int32,
    m: wp.int32,
    gap: wp.float64,
    trees: Trees,
    batch: PairBatch,
    memory: PointMemory,
    manifolds: Manifolds,
):
    """Write the points of a pair that rests, row m of the table that is read, but those a gap apart, by a warp.

    What is known of the pair is copied to the other table.
    """
    turn, found, k = memory.turn[0], wp.int32(0), warp_lane()
    other, count = 1 - turn, memory.searched[turn, m].count
    while k - warp_lane() < count:
        j = wp.min(k, count - 1)
        point, n, depth = recall_point(trees, batch, p, m, j, memory)
        shows = k < count and depth > -gap
        place = next_place(found, shows)
        if shows:
            manifolds.point[p, place] = point
            manifolds.normal[p, place] = n
            manifolds.depth[p, place] = depth
            manifolds.before[p, place] = memory.shown[turn, m, j]
        if k < count:
            memory.points[other, p, j] = memory.points[turn, m, j]
            memory.shown[other, p, j] = wp.where(shows, place, -1)
        k += warp_size()
    if warp_lane() == 0:
        manifolds.count[p] = found
        memory.searched[other, p] = memory.searched[turn, m]


@wp.func
def match_point(
    p: wp.int32,
    m: wp.int32,
    k: wp.int32,
    trees: Trees,
    batch: PairBatch,
    memory: PointMemory,
    manifolds: Manifolds,
):
    """Return the place in the launch before of point k of a pair that was searched, -1 for a new one.

    Args:
        m: Row of the pair in the table that is read, or -1.
    """
    if m < 0:
        return wp.int32(-1)
    turn, nearest, x = memory.turn[0], wp.int32(-1), manifolds.point[p, k]
    reach = MATCH_SHARE * smaller_size(trees, batch.pairs[p][0], batch.pairs[p][1])
    least = reach * reach
    for j in range(memory.searched[turn, m].count):
        point, n, _depth = recall_point(trees, batch, p, m, j, memory)
        far = wp.dot(point - x, point - x)
        if memory.shown[turn, m, j] >= 0 and far < least and wp.dot(n, manifolds.normal[p, k]) > MATCH_COSINE:
            least = far
            nearest = j
    if nearest < 0:
        return wp.int32(-1)
    point, _normal, _depth = recall_point(trees, batch, p, m, nearest, memory)
    for other in range(manifolds.count[p]):
        v = manifolds.point[p, other] - point
        if wp.dot(v, v) < least or (wp.dot(v, v) == least and other < k):
            nearest = wp.int32(-1)
    if nearest >= 0:
        nearest = memory.shown[turn, m, nearest]
    return nearest


@wp.func
def note_points(
    p: wp.int32,
    m: wp.int32,
    gap: wp.float64,
    any_hit: wp.int32,
    trees: Trees,
    batch: PairBatch,
    manifolds: Manifolds,
    memory: PointMemory,
):
    """Write what was found of a pair that was searched to the table that is not read, by a warp.

    Args:
        m: As for `match_point`.
    """
    other, k = 1 - memory.turn[0], warp_lane()
    a, b = wp.min(batch.pairs[p][0], batch.pairs[p][1]), wp.max(batch.pairs[p][0], batch.pairs[p][1])
    back_a, back_b = wp.transpose(trees.objects.rotation[a]), wp.transpose(trees.objects.rotation[b])
    while k < manifolds.count[p]:
        manifolds.before[p, k] = match_point(p, m, k, trees, batch, memory, manifolds)
        kept = KeptPoint()
        kept.on_a = back_a * (manifolds.point[p, k] - trees.objects.position[a])
        kept.on_b = back_b * (manifolds.point[p, k] - trees.objects.position[b])
        kept.normal = back_a * manifolds.normal[p, k]
        kept.depth = manifolds.depth[p, k]
        memory.points[other, p, k] = kept
        memory.shown[other, p, k] = k
        k += warp_size()
    if warp_lane() == 0:
        searched = SearchedPair()
        rotation, translation = relative_pose(trees.objects, a, b)
        searched.rotation = rotation
        searched.translation = translation
        searched.gap = gap
        searched.lods = lods_of(trees, batch.pairs[p])
        searched.any_hit = any_hit
        searched.count = manifolds.count[p]
        memory.searched[other, p] = searched


@wp.kernel
def keep_points_kernel(
    trees: Trees,
    batch: PairBatch,
    gap: wp.array(dtype=wp.float64),
    row: wp.array(dtype=wp.int32),
    place: wp.array(dtype=wp.int32),
    hits: Hits,
    manifolds_inout: Manifolds,
    memory_inout: PointMemory,
):
    """Take the points of one object pair a warp from the memory, if it rests; write what is known to the other table.

    Args:
        gap, row, place: As for `find_resting_kernel`.
    """
    p = wp.tid() / warp_size()
    if p >= wp.min(batch.count[0], batch.pairs.shape[0]):
        return
    if warp_lane() == 0:
        memory_inout.pairs[1 - memory_inout.turn[0], p] = batch.pairs[p]
    if place[p] >= 0:
        # What touches still does, where rounding has moved it apart.
        touch = TOUCH_SHARE * smaller_size(trees, batch.pairs[p][0], batch.pairs[p][1])
        recall_points(p, place[p], wp.max(gap[p], touch), trees, batch, memory_inout, manifolds_inout)
    else:
        note_points(p, row[p], gap[p], hits.any_hit[p], trees, batch, manifolds_inout, memory_inout)


@wp.kernel
def turn_memory_kernel(batch: PairBatch, hits: Hits, memory_inout: PointMemory):
    """Read the other table from now on, of which nothing is known where the launch lost something; one thread."""
    memory_inout.turn[0] = 1 - memory_inout.turn[0]
    memory_inout.launches[0] += 1
    memory_inout.known[0] = wp.where(is_whole(batch, hits), batch.count[0], 0)
