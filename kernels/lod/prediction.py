"""Selection by a predicted budget: the finest position on the tolerance scale whose predicted cost fits.

The tolerance scale has a tolerance for every DITHER positions, 0 the coarsest. A candidate is a change of the position;
candidates are ordered from the finest to the coarsest, `stay` (no change) among them, and the last, `held`, leaves
every object at its level whatever the view. Sums are of whole numbers, so that they have no order.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.counters import add_lanes, ends_launch
from warp_abtree.kernels.lod.ladder import LodPool
from warp_abtree.kernels.lod.tolerance import loosening
from warp_abtree.kernels.lod.view import ViewArrays, measure_view

wp.set_module_options(native.options("base/counters.cuh"))

WORK_MOST = wp.constant(wp.float64(2.0**40))
"""Tests of one object, at most: sums of up to 2^22 objects are exact, so that they have no order."""

DITHER = wp.constant(4)
"""Positions a tolerance: objects of one level move to the next in so many groups."""

POSITIONS_PER_OCTAVE = wp.constant(16)
"""Positions that double a tolerance."""

GOLDEN = wp.constant(wp.uint32(2654435761))
"""2^32 over the golden ratio: its multiples spread evenly (Knuth, The Art of Computer Programming 3, 6.4)."""

RATE_FIXED = wp.constant(0)
RATE_WORK = wp.constant(1)
RATE_NODE = wp.constant(2)
RATE_UP = wp.constant(3)
RATE_DOWN = wp.constant(4)
"""Entries of `Prediction.rate`: ms of a frame, a unit of work, a node refitted; two exponents."""


@wp.struct
class Prediction:
    """Predicted costs of each candidate."""

    change: wp.array(dtype=wp.int32)  # [candidate] change of the position
    rate: wp.array(dtype=wp.float64)  # [5] see the RATE constants
    power_up: wp.array(dtype=wp.float64)  # [level] faces to the exponent with which tests grow
    power_down: wp.array(dtype=wp.float64)  # [level] faces to the exponent with which tests fall
    work: wp.array(dtype=wp.int64)  # [candidate] tests of all objects, each pair's counted for both of its objects
    nodes: wp.array(dtype=wp.int64)  # [candidate] nodes refitted
    ended: wp.array(dtype=wp.int32)  # [1] warps that have added to them


@wp.struct
class Limits:
    """What a position is chosen by."""

    budget: wp.float64  # T [ms]
    aim: wp.float64  # fraction of it that a change goes for
    low: wp.float64  # fraction of it under which it climbs
    hold_frames: wp.int32  # that a transition is held
    position_max: wp.int32  # the finest position
    stay: wp.int32  # candidate


@wp.struct
class LevelChoice:
    """Choice of a position, and what levels of objects follow from it; of arrays [0] where there is none."""

    held: wp.int32  # candidate that leaves every object at its level
    lods: LodPool  # ladders, and objects
    scale: wp.array(dtype=wp.int32)  # [2] position, and frames that a transition has been held
    choice: wp.array(dtype=wp.float64)  # [6] see `choose_position`
    offset: wp.array(dtype=wp.int32)  # [object] positions by which it is loosened
    level: wp.array(dtype=wp.int32)  # [object] its level


@wp.func
def level_at(lods: LodPool, i: wp.int32, position: wp.int32, offset: wp.int32):
    """Return the level of an object at a position; a hash of its number spreads objects over neighbouring positions."""
    part = wp.int32((wp.uint32(i) * GOLDEN) >> wp.uint32(30))
    tolerance = wp.clamp(wp.max(position - offset + part, 0) / DITHER, 0, lods.tolerance_count - 1)
    return lods.tolerance_level[lods.object_model[i] * lods.tolerance_count + tolerance]


@wp.kernel
def begin_prediction_kernel(
    loosest: wp.float64,
    lods: LodPool,
    sees: bool,
    rotation: wp.array(dtype=wp.mat33d),
    position: wp.array(dtype=wp.vec3d),
    view_inout: ViewArrays,
    prediction_inout: Prediction,
    offset_inout: wp.array(dtype=wp.int32),
):
    """Measure each object's view, if there is a camera, and convert its loosening to positions, rounded down; raise the
    faces of each level to both exponents.

    Hysteresis: the offset follows only beyond a tolerance, so that an object between two levels does not flicker.
    """
    i = wp.tid()
    if i < prediction_inout.work.shape[0]:
        prediction_inout.work[i] = wp.int64(0)
        prediction_inout.nodes[i] = wp.int64(0)
    if i < prediction_inout.power_up.shape[0]:
        faces = wp.float64(wp.max(lods.faces[i], 1))
        prediction_inout.power_up[i] = wp.pow(faces, prediction_inout.rate[RATE_UP])
        prediction_inout.power_down[i] = wp.pow(faces, prediction_inout.rate[RATE_DOWN])
    if i < offset_inout.shape[0]:
        if sees:
            measure_view(i, rotation[i], position[i], view_inout)
        octaves = wp.log2(loosening(view_inout.focus[i], lods.importance[i], loosest))
        offset = wp.int32(wp.floor(octaves * wp.float64(POSITIONS_PER_OCTAVE)))
        if offset < offset_inout[i] or offset > offset_inout[i] + DITHER:
            offset_inout[i] = offset


@wp.func
def predict_nodes(entries: wp.int32, faces: wp.int32, full_share: wp.float64):
    """Estimate the number of nodes that an LOD change refits, by equation 1, from the entries of its slice.

    A slice lists each face about twice.
    """
    whole = wp.float64(2 * faces - 1)
    if wp.float64(entries) > full_share * wp.float64(faces):
        return whole
    k = wp.max(wp.float64(entries) * wp.float64(0.5), wp.float64(1.0))
    return wp.min(k * (wp.log2(wp.float64(faces)) - wp.log2(k) + wp.float64(2.0)), whole)


@wp.func
def work_of(prediction: Prediction, k: wp.int32):
    """Return the tests of a candidate, each pair's once."""
    return wp.float64(prediction.work[k]) * wp.float64(0.5)


@wp.func
def steady_cost(prediction: Prediction, k: wp.int32):
    """Return the time that a candidate takes in every frame [ms]."""
    return prediction.rate[RATE_FIXED] + prediction.rate[RATE_WORK] * work_of(prediction, k)


@wp.func
def transition_cost(prediction: Prediction, k: wp.int32):
    """Return the time that a candidate takes in its first frame alone [ms]."""
    return prediction.rate[RATE_NODE] * wp.float64(prediction.nodes[k])


@wp.func
def choose_fall(limit: wp.float64, stay: wp.int32, prediction: Prediction):
    """Return the finest candidate below `stay` whose steady cost is within a limit [ms], else the coarsest."""
    k = stay + 1
    coarsest = prediction.change.shape[0] - 2
    while k < coarsest and not steady_cost(prediction, k) <= limit:
        k += 1
    return k


@wp.func
def choose_climb(limit: wp.float64, budget: wp.float64, stay: wp.int32, prediction: Prediction):
    """Return the finest candidate whose steady cost is within a limit and its first frame within the budget [ms]."""
    k = wp.int32(0)
    while k < stay:
        cost = steady_cost(prediction, k)
        if cost <= limit and cost + transition_cost(prediction, k) <= budget:
            return k
        k += 1
    return stay


@wp.func
def choose_position(
    limits: Limits,
    prediction: Prediction,
    scale: wp.array(dtype=wp.int32),
    choice: wp.array(dtype=wp.float64),
    told: wp.array(dtype=wp.float64),
):
    """Choose a position on the tolerance scale.

    If `held` is over the budget: fall to the finest candidate within `aim` of it. If following the view at the same
    position costs under `low` of it: climb to the finest within `aim` whose transition fits into the budget. Between
    the two: follow the view, if its transition fits. A transition that does not fit, of a climb or of the view, is held
    for `hold_frames` and made then, otherwise a scene with expensive refits would never refine.

    Args:
        scale: Position, and frames that a transition has been held.
        choice: Candidate, its steady and transition cost [ms], its work, the work of `held`, the position.
        told: The same for the host.
    """
    stay = wp.int32(limits.stay)
    budget = wp.float64(limits.budget)
    aim = limits.aim * budget
    held = prediction.change.shape[0] - 1
    chosen = stay
    waits = wp.int32(0)
    steady = steady_cost(prediction, stay)
    transition = transition_cost(prediction, stay)
    if steady_cost(prediction, held) > budget:
        chosen = choose_fall(aim, stay, prediction)
    elif steady + transition > budget:
        chosen = held
        waits = 1
    elif steady + transition < limits.low * budget and scale[0] < limits.position_max:
        chosen = choose_climb(aim, budget, stay, prediction)
        if chosen == stay and steady_cost(prediction, stay - 1) <= aim:
            waits = 1
    if waits == 1 and scale[1] >= limits.hold_frames:
        waits = 0
        if chosen == held:
            chosen = stay
        else:
            chosen = stay - 1
    scale[1] = wp.where(waits == 1, scale[1] + 1, 0)
    scale[0] = wp.clamp(scale[0] + prediction.change[chosen], 0, limits.position_max)
    choice[0] = wp.float64(chosen)
    choice[1] = steady_cost(prediction, chosen)
    choice[2] = transition_cost(prediction, chosen)
    choice[3] = work_of(prediction, chosen)
    choice[4] = work_of(prediction, held)
    choice[5] = wp.float64(scale[0])
    for i in range(6):
        told[i] = choice[i]


@wp.kernel
def predict_kernel(
    chunks: wp.int32,
    full_share: wp.float64,
    tests: wp.array(dtype=wp.int64),
    limits: Limits,
    prediction: Prediction,
    chosen_inout: LevelChoice,
    told_out: wp.array(dtype=wp.float64),
):
    """Predict the tests and refits of every object for every candidate, one thread a candidate and chunk of objects;
    then choose a position by these.

    Args:
        chunks: Chunks that share the objects, a multiple of WARP.
        tests: Of each object in the last frame.
        chosen_inout: With the position and levels as they are.
        told_out: As for `choose_position`.
    """
    k, chunk = wp.tid()
    lods = chosen_inout.lods
    n = lods.object_model.shape[0]
    held = prediction.change.shape[0] - 1
    position = chosen_inout.scale[0] + prediction.change[k]
    total = wp.int64(0)
    nodes = wp.int64(0)
    i = chunk
    while i < n:
        model = lods.object_model[i]
        a = model * lods.level_count + chosen_inout.level[i]
        b = a
        if k < held:
            b = model * lods.level_count + level_at(lods, i, position, chosen_inout.offset[i])
        found = tests[i]
        if a != b and found > wp.int64(0):
            share = wp.float64(found)
            if lods.faces[b] > lods.faces[a]:
                share = share * prediction.power_up[b] / prediction.power_up[a]
            else:
                share = share * prediction.power_down[b] / prediction.power_down[a]
            found = wp.int64(wp.min(share, WORK_MOST) + wp.float64(0.5))
        total += found
        if a != b and lods.refits[model] != 0 and lods.entry[a] != lods.entry[b]:
            entries = wp.abs(lods.entry[b] - lods.entry[a])
            nodes += wp.int64(predict_nodes(entries, lods.face_count[model], full_share))
        i += chunks
    add_lanes(prediction.work, k, total)
    add_lanes(prediction.nodes, k, nodes)
    if ends_launch(prediction.ended, prediction.change.shape[0] * chunks):
        choose_position(limits, prediction, chosen_inout.scale, chosen_inout.choice, told_out)


@wp.func
def set_level(i: wp.int32, chosen: LevelChoice, lods: wp.array(dtype=wp.int32)):
    """Give an object its level at the position, unless the choice is `held`, and the LOD there."""
    if wp.int32(chosen.choice[0]) != chosen.held:
        chosen.level[i] = level_at(chosen.lods, i, chosen.scale[0], chosen.offset[i])
    lods[i] = chosen.lods.lod[chosen.lods.object_model[i] * chosen.lods.level_count + chosen.level[i]]


@wp.kernel
def set_level_kernel(chosen_inout: LevelChoice, lod_out: wp.array(dtype=wp.int32)):
    """Give every object its level."""
    set_level(wp.tid(), chosen_inout, lod_out)
