"""Start of a distance search: boxes at unit size, errors to allow for, and a first upper bound.

Boxes are scaled by a power of two that brings the larger model, or the distance between the models' centres, to about
unit size, so that float32 holds squares of distances. `margin` is that of `PairPose`, which widens boxes along an axis
by what their coordinates may err by.

D is the least distance of A's vertices to x' (docs/exactness.md) that is computed, d that of the surfaces in the world.
With u = 2^-53, reaches A and B of the vertices, T of the translation, S = A + B + T, and skews s_a and s_b of the
rotations, for world points p and q of the surfaces and w = a - Ra^T (Rb b + tb - ta):

1. p - q = Ra w + Ra (Ra^T Ra - 1) a - (Ra Ra^T - 1) (p - q). The brackets have norms of at most 3 s_a, and Ra and Rb
   lengthen by at most 1 + 1.5 s_a and 1 + 1.5 s_b, so |p - q| <= (1 + 5 s_a) |w| + 6 s_a A; and the other way, from
   w = Ra^T (p - q) - (Ra^T Ra - 1) a, |w| <= (1 + 1.5 s_a) |p - q| + 6 s_a A.
2. x' stands for Ra^T (Rb b + tb - ta) with an error of 24 u (B + T). A matrix made of a quaternion errs by 24 u, which
   moves p and q by 42 u (A + B), and the skew's own rounding counts 21 u A: 90 u S in all.
3. L of `triangle_pair` is at most 2 S. By its steps, a pair of faces errs by 40 u L and by what sqrt(D^2 + (128 u L)^2)
   exceeds D: together 96 u S where D > 2^-19 S, else at most 2 PAIR_ROUNDING S.

So d <= D (1 + 5 (s_a + s_b) + 2^-45) + 6 s_a A + 2^-45 S, and D is under the same of d, or S counts 2^-44 more where
D is small: `stretch` and `slack_of` (docs/exactness.md, bound 15).
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.boxes import ROUNDING_DOWN, ROUNDING_UP
from warp_abtree.kernels.base.generation import STALE
from warp_abtree.kernels.base.nodes import load_node
from warp_abtree.kernels.base.poses import (
    ROUNDING_32,
    ROUNDING_64,
    SCALE_MAX,
    UNIT_32,
    PairBatch,
    PairPose,
    measure_rotation,
    reach_box,
    sum_products,
)
from warp_abtree.kernels.search.item import item_first, item_second, pack_item
from warp_abtree.kernels.search.load_balance import NO_UNIT, Work
from warp_abtree.kernels.search.mean_slabs import Slabs, count_uses
from warp_abtree.kernels.triangle.corners import load_triangles
from warp_abtree.kernels.triangle.distance import (
    DISTANCE_MAX,
    POSE_ROUNDING,
    largest_coordinate,
    power_below,
)
from warp_abtree.kernels.triangle.triangle_pair import PAIR_ROUNDING, triangle_distance

wp.set_module_options(native.options())

# Sorts behind all face pairs.
NO_FACES = wp.constant(wp.int64(2**63 - 1))
# Of a bound of boxes, a sum of six squares in float32, and of its comparison.
BOUND_ROUNDING = wp.constant(wp.float64(2.0**-19))
# Distances over so many times a `pair_slack`, which is 2^-44 S, are not small.
SMALL_DISTANCE = wp.constant(wp.float64(2.0**25))
# Pairs, or depth of both trees, from which on slabs make a search shorter; else it takes as many steps, longer ones.
PAIRS_LEAST, DEPTH_LEAST = wp.constant(24), wp.constant(36)


@wp.struct
class SearchScale:
    """Scale and error bounds of an object pair's boxes and distances."""

    translation: wp.vec3  # between the models' centres, of B to A, scaled
    back: wp.vec3  # the same, of A to B
    scale: wp.float32  # power of two that boxes are scaled by
    margin: wp.float32  # that posed boxes are widened by, scaled
    grow: wp.float32  # a little over 1: bounds of boxes may be so much too large
    error: wp.float32  # that float32 errs by in the distance of two faces, beside a part of their size, scaled
    least: wp.float32  # that pairs of faces err by in float64, scaled
    scale64: wp.float64  # the same power of two, where float32 has none
    pair_slack: wp.float64  # that a pair of faces errs by at most [model units]
    stretch: wp.float64  # D <= d stretch + slack, and d <= D stretch + slack
    slack: wp.float64  # the other part, of distances that are not small; see `slack_of`


@wp.struct
class Tolerances:
    """Accepted widths of a distance's bracket."""

    tolerance: wp.float64  # width of the bracket [world units]
    relative: wp.float64  # width of the bracket, relative to its upper end


@wp.struct
class Nearest:
    """The nearest pair of faces found so far."""

    distance: wp.float64  # in A's frame, or what it is asked to be under
    faces: wp.int64  # (face of A, face of B) as an item of `node_pair`, NO_FACES for none


@wp.struct
class NearestFound:
    """Results of the search of each object pair."""

    distance: wp.array(dtype=wp.float64)  # in A's frame, shape [pair]
    faces: wp.array(dtype=wp.int64)  # see `Nearest`, shape [pair]; what lies there starts the next search
    scaling: wp.array(dtype=SearchScale)  # shape [pair]
    beyond: wp.array(dtype=wp.float64)  # distance to end at [world units], infinite for none, shape [pair]
    # What no nearest faces are beyond, scaled, and 0 where slabs do not pay, else 1; shape [pair], of warps alone.
    upper: wp.array(dtype=wp.vec2)


@wp.func
def make_scale(trees: Trees, pose: PairPose, a: wp.int32, b: wp.int32):
    """Return the `SearchScale` of objects a < b."""
    state_a, state_b = trees.objects.state[a], trees.objects.state[b]
    centre_a = trees.models.centre[trees.states.model[state_a]]
    centre_b = trees.models.centre[trees.states.model[state_b]]
    root_a = load_node(trees.states, trees.states.node_start[state_a] + 1)
    root_b = load_node(trees.states, trees.states.node_start[state_b] + 1)
    reach_a = reach_box(root_a.lower, root_a.upper)
    reach_b = reach_box(root_b.lower, root_b.upper)
    r, t = pose.rotation, pose.translation
    shift, back = wp.vec3d(), wp.vec3d()
    for i in range(3):
        shift[i] = (sum_products(r[i, 0], centre_b[0], r[i, 1], centre_b[1], r[i, 2], centre_b[2]) + t[i]) - centre_a[i]
    for i in range(3):
        back[i] = -sum_products(r[0, i], shift[0], r[1, i], shift[1], r[2, i], shift[2])
    skew, _ = measure_rotation(r)
    two = wp.float64(2.0)
    size = largest_coordinate(t) + largest_coordinate(centre_a)
    far = largest_coordinate(shift)
    margin64 = ROUNDING_64 * (size + two * (largest_coordinate(centre_b) + reach_b) + reach_a)
    margin64 = margin64 + wp.float64(4.0) * skew * (reach_b + far)
    margin = margin64 + ROUNDING_32 * (reach_a + reach_b + far)
    most = wp.max(wp.max(reach_a, reach_b), far)
    scale = wp.min(wp.float64(1.0) / power_below(most), SCALE_MAX)
    one = wp.float64(1.0)
    skew_a, _ = measure_rotation(trees.objects.rotation[a])
    skew_b, _ = measure_rotation(trees.objects.rotation[b])
    sizes = (reach_a + largest_coordinate(centre_a)) + (reach_b + largest_coordinate(centre_b))
    sizes = sizes + largest_coordinate(trees.objects.position[b] - trees.objects.position[a])
    scaling = SearchScale()
    scaling.translation = wp.vec3(shift * scale)
    scaling.back = wp.vec3(back * scale)
    scaling.scale = wp.float32(scale)
    scaling.margin = wp.float32(margin * scale)
    scaling.scale64 = scale
    scaling.pair_slack = two * PAIR_ROUNDING * sizes
    scaling.grow = wp.float32(one + two * BOUND_ROUNDING + wp.float64(4.0) * skew)
    scaling.least = wp.float32(two * scaling.pair_slack * scale)
    off = UNIT_32 * (reach_a + wp.float64(7.2) * reach_b + wp.float64(4.0) * far) + margin64
    scaling.error = wp.float32((wp.float64(1.75) * off + two * scaling.pair_slack) * scale)
    scaling.stretch = one + wp.float64(5.0) * (skew_a + skew_b) + POSE_ROUNDING
    scaling.slack = wp.float64(6.0) * skew_a * (reach_a + largest_coordinate(centre_a)) + POSE_ROUNDING * sizes
    return scaling


@wp.func
def slack_of(scaling: SearchScale, distance: wp.float64):
    """Return the absolute error of a distance; `stretch` is the relative part."""
    return wp.where(distance > SMALL_DISTANCE * scaling.pair_slack, scaling.slack, scaling.slack + scaling.pair_slack)


@wp.func
def width_of(scaling: SearchScale, distance: wp.float64):
    """Return the least width of a bracket at a distance, see `cut_of`."""
    return wp.float64(4.0) * ((scaling.slack + scaling.pair_slack) + (scaling.stretch - wp.float64(1.0)) * distance)


@wp.func
def cut_of(scaling: SearchScale, tolerances: Tolerances, distance: wp.float64):
    """Return the pruning distance in A's frame: faces beyond it cannot narrow the bracket at a distance.

    The bracket is as narrow as is asked then; where rounding alone makes it wider, faces that are any nearer matter.
    """
    asked = wp.max(tolerances.tolerance, tolerances.relative * distance)
    spare = asked - width_of(scaling, distance)
    return wp.where(spare > wp.float64(0.0), distance - spare, distance)


@wp.func
def scaled_up(distance: wp.float64, scaling: SearchScale):
    """Return a distance in the scale of the boxes, not less than any pair of faces at it has in float64."""
    return wp.float32(distance * scaling.scale64) * ROUNDING_UP + scaling.least


@wp.func
def tolerance_terms(tolerances: Tolerances, scaling: SearchScale):
    """Return tolerances for float32: scaled, relative, and widths of a bracket to subtract, scaled and relative."""
    width = width_of(scaling, wp.float64(0.0))
    part = wp.float64(4.0) * (scaling.stretch - wp.float64(1.0))
    return wp.vec4(
        wp.float32((tolerances.tolerance - width) * scaling.scale64) * ROUNDING_DOWN,
        wp.float32(tolerances.relative) * ROUNDING_DOWN,
        wp.float32(width * scaling.scale64) * ROUNDING_UP,
        wp.float32(part) * ROUNDING_UP,
    )


@wp.func
def is_active(trees: Trees, state: wp.int32, face: wp.int32):
    if face < 0 or face >= trees.models.face_count[trees.states.model[state]]:
        return False
    return trees.states.face_corner[trees.states.face_start[state] + face][0] >= 0


@wp.func
def start_pair(p: wp.int32, trees: Trees, batch: PairBatch, found: NearestFound):
    """Prepare an object pair, with the last launch's faces as the first bound where both are active."""
    a, b = wp.min(batch.pairs[p][0], batch.pairs[p][1]), wp.max(batch.pairs[p][0], batch.pairs[p][1])
    pose = batch.poses[p]
    scaling = make_scale(trees, pose, a, b)
    bound = found.beyond[p]
    if bound < DISTANCE_MAX:
        bound = bound * scaling.stretch + (scaling.slack + scaling.pair_slack)
    else:
        bound = wp.float64(wp.inf)
    faces = found.faces[p]
    kept = NO_FACES
    face_a, face_b = item_first(faces), item_second(faces)
    if is_active(trees, trees.objects.state[a], face_a) and is_active(trees, trees.objects.state[b], face_b):
        triangles = load_triangles(trees, pose, face_a, face_b)
        d = triangle_distance(triangles)
        if d <= bound:
            bound = d
            kept = pack_item(face_a, face_b)
    found.scaling[p] = scaling
    found.distance[p] = bound
    found.faces[p] = kept
    if p < found.upper.shape[0]:
        found.upper[p] = wp.vec2(scaled_up(bound, scaling), 1.0)


@wp.func
def should_use_slabs(count: wp.int32, trees: Trees, a: wp.int32, b: wp.int32):
    """Return whether slabs shorten a search by warps: not where many warps share few pairs.

    Args:
        a, b: Tree states of the object pair.
    """
    return (
        count >= PAIRS_LEAST
        or trees.models.depth[trees.states.model[a]] + trees.models.depth[trees.states.model[b]] >= DEPTH_LEAST
    )


@wp.kernel
def start_distance_kernel(
    trees: Trees, batch: PairBatch, slabs_inout: Slabs, found_inout: NearestFound, work_out: Work
):
    """Prepare an object pair a thread, see `start_pair`.

    A unit of work is an object pair; a stale launch is left none.
    """
    p = wp.tid()
    if p < work_out.flag.shape[0]:
        work_out.flag[p] = 0
    if p == 0:
        stale = batch.launched[0] == STALE
        work_out.counter[0] = 0
        work_out.counter[1] = 0
        work_out.counter[2] = wp.where(stale, 0, wp.min(batch.count[0], batch.pairs.shape[0]))
        work_out.counter[3] = wp.where(stale, NO_UNIT, 0)
    if p >= wp.min(batch.count[0], batch.pairs.shape[0]) or batch.launched[0] == STALE:
        return
    a, b = trees.objects.state[batch.pairs[p][0]], trees.objects.state[batch.pairs[p][1]]
    if should_use_slabs(batch.count[0], trees, a, b):
        count_uses(p, trees, batch.pairs, slabs_inout)
    else:
        slabs_inout.states[p] = wp.vec2i(-1, -1)
    start_pair(p, trees, batch, found_inout)
