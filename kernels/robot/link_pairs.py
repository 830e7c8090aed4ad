"""Broad phase of robots: pairs of parts, and of parts and surroundings, whose boxes are near.

A configuration is asked part by part, and no more once it is decided. Edges of a planner ask how far the points of a
part are from where they stand at the middle of a stretch of the edge. To get from there to any other configuration of
the stretch, let the joints turn one by one, the outermost first: the joints that a joint hangs on still stand as in the
middle, and so does its axis. A turn T takes a point p that outer joints have moved to q by

    |T q - p| <= |T q - T p| + |T p - p| = |q - p| + |T p - p|

and |T p - p| is at most the angle times the distance of p from the axis, both in the middle. So the reach of a part is
the sum over its joints of angle times distance of its farthest point, or of how far a joint slides (docs/exactness.md,
bound 22).

The joints that both parts of a pair hang on move them as one and do not count.

A padded part counts as thicker by its padding: parts meet where they are not proved farther apart than both paddings.
"""

import warp as wp

from warp_abtree.kernels.base.boxes import round_down, round_up
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.robot.forward import PRISMATIC, REVOLUTE, Chain, Frames

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

ASK_ANY, ASK_WITHIN, ASK_DISTANCE, ASK_PADDED = wp.constant(0), wp.constant(1), wp.constant(2), wp.constant(3)

# Of a reach, where fixed transforms are rigid within 1e-12; and of poses: a frame turns what hangs on it by some 50 u
# too much, u = 2^-53, and these add up along the way.
RIGID_ROUNDING = wp.constant(wp.float64(1.0 + 2.0**-30))
FRAME_ROUNDING = wp.constant(wp.float64(2.0**-45))
# Nothing of a size that models may have is farther away.
FARTHEST = wp.constant(wp.float64(2.0**120))
# Of a part's size: whose boxes are nearer than so large a reach are taken as near.
HOPELESS = wp.constant(wp.float64(0.4))
# Of the values of joints.
VALUE_ROUNDING = wp.constant(wp.float64(2.0**-48))


@wp.struct
class Parts:
    """Parts of a robot, and which of them are tested against one another or their surroundings."""

    frame: wp.array(dtype=wp.int32)  # that it moves with, shape [part]
    depth: wp.array(dtype=wp.int32)  # frames that it hangs on, shape [part]
    middle: wp.array(dtype=wp.vec3d)  # of a sphere around its vertices, in its frame [robot units], shape [part]
    radius: wp.array(dtype=wp.float64)  # of the sphere [robot units], shape [part]
    padding: wp.array(dtype=wp.float64)  # added to its shape [robot units], shape [part]; of ASK_WITHIN, ASK_PADDED
    first: wp.array(dtype=wp.int32)  # part, shape [entry]
    second: wp.array(dtype=wp.int32)  # other part, -1 for the surroundings, shape [entry]
    shared: wp.array(dtype=wp.int32)  # last frame that both parts hang on, -1 for none, shape [entry]
    meets: wp.array(dtype=wp.uint8)  # whether an object of the surroundings may meet the robot, shape [object]


@wp.struct
class Chunk:
    """Configurations that are checked at a time, and their states so far."""

    count: wp.array(dtype=wp.int32)  # of configurations, shape [1]
    half: wp.array2d(dtype=wp.float64)  # what joint values may differ by, shape [configuration, column]; of ASK_WITHIN
    size: wp.array2d(dtype=wp.float64)  # greatest magnitudes of joint values, as `half`; of ASK_WITHIN
    hit: wp.array(dtype=wp.uint8)  # whether it is decided that parts intersect, shape [configuration]
    near: wp.array(dtype=wp.uint8)  # whether some are not proved farther apart, shape [configuration]; of ASK_WITHIN
    best: wp.array(dtype=wp.float64)  # least distance so far [robot units], shape [configuration]; of ASK_DISTANCE


@wp.func
def part_reach(chain: Chain, frames: Frames, parts: Parts, chunk: Chunk, i: wp.int32, part: wp.int32, shared: wp.int32):
    """Bound the motion of a part within the tolerances of joint values, seen from a frame that it hangs on."""
    f = parts.frame[part]
    radius = parts.radius[part]
    point = frames.rotation[i, f] * parts.middle[part] + frames.position[i, f]
    reach = wp.float64(0.0)
    size = wp.length(point) + radius
    while f > shared:
        size = wp.max(size, wp.length(frames.position[i, f]))
        kind = chain.kind[f]
        column = chain.column[f]
        if column >= 0:
            scale = wp.abs(chain.scale[f])
            rounding = (scale * chunk.size[i, column] + wp.abs(chain.offset[f])) + wp.float64(1.0)
            value = scale * chunk.half[i, column] + VALUE_ROUNDING * rounding
            if kind == REVOLUTE:
                axis = frames.rotation[i, f] * chain.axis[f]
                far = wp.length(wp.cross(axis, point - frames.position[i, f])) + radius
                reach += value * far
            elif kind == PRISMATIC:
                reach += value
        f = chain.parent[f]
    depth = wp.float64(parts.depth[part])
    return reach * RIGID_ROUNDING + FRAME_ROUNDING * (depth * depth) * size


@wp.func
def pair_reach(mode: wp.int32, chain: Chain, frames: Frames, parts: Parts, chunk: Chunk, i: wp.int32, entry: wp.int32):
    """Return the distance within which the parts of an entry are tested at a configuration, paddings apart."""
    if mode == ASK_ANY or mode == ASK_PADDED:
        return wp.float64(0.0)
    if mode == ASK_DISTANCE:
        return chunk.best[i]
    shared, second = parts.shared[entry], parts.second[entry]
    reach = part_reach(chain, frames, parts, chunk, i, parts.first[entry], shared)
    if second >= 0:
        reach += part_reach(chain, frames, parts, chunk, i, second, shared)
    return reach


@wp.func
def pair_padding(mode: wp.int32, parts: Parts, entry: wp.int32):
    """Return by how much the parts of an entry are padded together [robot units]."""
    padding = wp.float64(0.0)
    if mode == ASK_WITHIN or mode == ASK_PADDED:
        padding = parts.padding[parts.first[entry]]
        if parts.second[entry] >= 0:
            padding += parts.padding[parts.second[entry]]
    return padding


@wp.struct
class LinkBoxes:
    """Boxes of the objects of the surroundings and of the parts of all configurations."""

    lower: wp.array(dtype=wp.vec3)  # shape [object]
    upper: wp.array(dtype=wp.vec3)  # shape [object]
    bvh: wp.uint64  # of the surroundings, 0 where there are none


@wp.func
def append_link_pair(
    first: wp.int32, second: wp.int32, distance: wp.float64, batch: PairBatch, distances: wp.array(dtype=wp.float64)
):
    """Append a pair of objects; the count goes on past the capacity."""
    slot = wp.atomic_add(batch.count, 0, 1)
    if slot >= 0 and slot < batch.pairs.shape[0]:
        batch.pairs[slot] = wp.vec2i(first, second)
        if slot < distances.shape[0]:
            distances[slot] = distance


@wp.kernel
def find_link_pair_kernel(
    mode: wp.int32,
    stage: wp.vec2i,
    around: wp.int32,
    chain: Chain,
    parts: Parts,
    frames: Frames,
    boxes: LinkBoxes,
    chunk_inout: Chunk,
    batch_inout: PairBatch,
    distances_out: wp.array(dtype=wp.float64),
):
    """Find the pairs of a stage whose boxes are near enough, a configuration a thread that is not decided yet.

    Args:
        stage: First entry of `Parts`, and the one behind the last.
        around: Objects of the surroundings, which come before those of parts.
        distances_out: Up to what distance each pair matters [robot units]; [0] where that is 0.
    """
    i = wp.tid()
    if i >= chunk_inout.count[0] or chunk_inout.hit[i] != wp.uint8(0):
        return
    base = around + i * parts.frame.shape[0]
    j = wp.int32(0)
    for entry in range(stage[0], stage[1]):
        first, second = base + parts.first[entry], parts.second[entry]
        reach = pair_reach(mode, chain, frames, parts, chunk_inout, i, entry)
        padding = pair_padding(mode, parts, entry)
        wide = reach + padding
        hopeless = mode == ASK_WITHIN and reach > HOPELESS * parts.radius[parts.first[entry]]
        within = wp.where(hopeless, padding, wide)
        least, most = boxes.lower[first], boxes.upper[first]
        if mode != ASK_ANY:
            for k in range(3):
                least[k] = round_down(wp.max(wp.float64(least[k]) - wide, -FARTHEST))
                most[k] = round_up(wp.min(wp.float64(most[k]) + wide, FARTHEST))
        if second < 0:
            query = wp.bvh_query_aabb(boxes.bvh, least, most)
            while wp.bvh_query_next(query, j):
                if parts.meets[j] != wp.uint8(0):
                    if hopeless:
                        chunk_inout.near[i] = wp.uint8(1)
                    append_link_pair(first, j, within, batch_inout, distances_out)
        else:
            j = base + second
            meet = bool(True)
            for k in range(3):
                meet = meet and least[k] <= boxes.upper[j][k] and boxes.lower[j][k] <= most[k]
            if meet:
                if hopeless:
                    chunk_inout.near[i] = wp.uint8(1)
                append_link_pair(first, j, within, batch_inout, distances_out)
