"""Answers of a robot's configurations, reduced from those of their pairs of objects."""

import warp as wp

from warp_abtree.kernels.base.arrays import pair_key
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.distance.report import Distances, two_points
from warp_abtree.kernels.intersect.face_pairs import Hits
from warp_abtree.kernels.robot.link_pairs import Chunk

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

NO_PAIR = wp.constant(wp.int64(2**63 - 1))


@wp.struct
class NearestParts:
    """Nearest pair of each configuration."""

    winner: wp.array(dtype=wp.int64)  # of a stage: the least pair at the least distance, NO_PAIR; shape [configuration]
    distance: wp.array(dtype=wp.float64)  # [robot units], infinite where none is near enough, shape [configuration]
    points: wp.array(dtype=two_points)  # of the part and of the other, in the world, shape [configuration]
    faces: wp.array(dtype=wp.vec2i)  # that they lie on, shape [configuration]
    pair: wp.array(dtype=wp.vec2i)  # objects, shape [configuration]


@wp.func
def configuration_of(pair: wp.vec2i, around: wp.int32, part_count: wp.int32):
    """Return the configuration of a pair, which names a part first."""
    return (pair[0] - around) / part_count


@wp.func
def note_demand(pair_count: wp.array(dtype=wp.int32), hits: Hits, demand: wp.array(dtype=wp.int32)):
    """Raise the demands of a chunk to those of a stage: pairs found, and face pairs that waited."""
    demand[0] = wp.where(pair_count[0] < 0, 2147483647, wp.max(demand[0], pair_count[0]))
    waited = hits.uncertain_total[0]
    demand[1] = wp.where(waited < 0, 2147483647, wp.max(demand[1], waited))


@wp.kernel
def note_hit_kernel(
    around: wp.int32,
    part_count: wp.int32,
    batch: PairBatch,
    hits: Hits,
    near: wp.array(dtype=wp.int32),
    chunk_inout: Chunk,
    demand_inout: wp.array(dtype=wp.int32),
):
    """Note which configurations have a pair that intersects, or one that is not proved apart."""
    p = wp.tid()
    if p == 0:
        note_demand(batch.count, hits, demand_inout)
    if p >= wp.min(batch.count[0], batch.pairs.shape[0]):
        return
    i = configuration_of(batch.pairs[p], around, part_count)
    if hits.any_hit[p] != 0:
        chunk_inout.hit[i] = wp.uint8(1)
    if near.shape[0] > 0:
        if near[p] != 0:
            chunk_inout.near[i] = wp.uint8(1)


@wp.kernel
def note_distance_kernel(
    around: wp.int32,
    part_count: wp.int32,
    batch: PairBatch,
    hits: Hits,
    distances: Distances,
    chunk_inout: Chunk,
    demand_inout: wp.array(dtype=wp.int32),
):
    """Note the least distance of each configuration."""
    p = wp.tid()
    if p == 0:
        note_demand(batch.count, hits, demand_inout)
    if p >= wp.min(batch.count[0], batch.pairs.shape[0]):
        return
    i = configuration_of(batch.pairs[p], around, part_count)
    wp.atomic_min(chunk_inout.best, i, distances.distance[p])


@wp.kernel
def find_winner_kernel(
    around: wp.int32,
    part_count: wp.int32,
    batch: PairBatch,
    distances: Distances,
    chunk: Chunk,
    nearest_inout: NearestParts,
):
    """Find the first of the pairs at the least distance of each configuration, if that has become less."""
    p = wp.tid()
    if p >= wp.min(batch.count[0], batch.pairs.shape[0]):
        return
    i = configuration_of(batch.pairs[p], around, part_count)
    distance = distances.distance[p]
    if distance == chunk.best[i] and distance < nearest_inout.distance[i]:
        wp.atomic_min(nearest_inout.winner, i, pair_key(batch.pairs[p]))


@wp.kernel
def write_nearest_kernel(
    around: wp.int32,
    part_count: wp.int32,
    batch: PairBatch,
    distances: Distances,
    nearest_inout: NearestParts,
    chunk_inout: Chunk,
):
    """Write the answers of the pairs of `find_winner_kernel`; pairs that intersect are settled."""
    p = wp.tid()
    if p >= wp.min(batch.count[0], batch.pairs.shape[0]):
        return
    i = configuration_of(batch.pairs[p], around, part_count)
    if nearest_inout.winner[i] == pair_key(batch.pairs[p]):
        nearest_inout.distance[i] = distances.distance[p]
        nearest_inout.points[i] = distances.points[p]
        nearest_inout.faces[i] = distances.faces[p]
        nearest_inout.pair[i] = batch.pairs[p]
        if distances.distance[p] == wp.float64(0.0):
            chunk_inout.hit[i] = wp.uint8(1)
