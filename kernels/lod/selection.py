"""Selection of LODs: what the viewer sees of each object, the paper's model, a tolerance, and a predicted budget.

A rung is a step of a model's ladder of LODs, 0 the coarsest; arrays over rungs are indexed by
model * rung_count + rung. Every kernel is linear in the number of objects and reads nothing from the host.

Source: Liu et al. 2006, section 4.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

CLIMB = wp.constant(1)
FALL = wp.constant(2)
HOLD = wp.constant(3)
"""Cases of section 4.2: more than a threshold under the budget, over it, between the two."""

CHUNKS = wp.constant(256)
"""Threads that share the objects of one candidate: sums have one order on every device."""

DITHER = wp.constant(4)
"""Dial steps a level: objects of one level move to the next in so many parts."""

STEPS_PER_OCTAVE = wp.constant(16)
"""Dial steps that double a tolerance."""

GOLDEN = wp.constant(wp.uint32(2654435761))
"""2^32 over the golden ratio: its multiples spread evenly (Knuth, The Art of Computer Programming 3, 6.4)."""


@wp.struct
class LodPool:
    """Ladders and objects of a scene.

    Per object: object_model, importance (beta: 1, 2 or 3). Per rung: lod, error [model units], faces, entry (where the
    LOD starts in its model's split_face). Per model: face_count. level_rung, by model * level_count + level: the
    coarsest rung within the tolerance of a level; levels go from the coarsest to the finest.
    """

    object_model: wp.array(dtype=wp.int32)
    importance: wp.array(dtype=wp.int32)
    lod: wp.array(dtype=wp.int32)
    error: wp.array(dtype=wp.float64)
    faces: wp.array(dtype=wp.int32)
    entry: wp.array(dtype=wp.int32)
    face_count: wp.array(dtype=wp.int32)
    level_rung: wp.array(dtype=wp.int32)
    rung_count: wp.int32
    level_count: wp.int32


@wp.struct
class Prediction:
    """What a step of the dial would cost, one entry a candidate unless said otherwise.

    step: change of the dial. chunk_work, chunk_change: by candidate * CHUNKS + chunk. work, change, nodes: tests,
    objects that change rung, nodes refitted. held: by (candidate * models + model) * rung_count + rung, whether an
    object would stand there; the last candidate is the rungs in place. power_up, power_down: faces of each rung raised
    to the exponents with which tests grow and fall. rate: see the RATE constants.
    """

    step: wp.array(dtype=wp.int32)
    chunk_work: wp.array(dtype=wp.float64)
    chunk_change: wp.array(dtype=wp.int32)
    work: wp.array(dtype=wp.float64)
    change: wp.array(dtype=wp.int32)
    nodes: wp.array(dtype=wp.float64)
    held: wp.array(dtype=wp.int32)
    power_up: wp.array(dtype=wp.float64)
    power_down: wp.array(dtype=wp.float64)
    rate: wp.array(dtype=wp.float64)


RATE_FIXED = wp.constant(0)
RATE_WORK = wp.constant(1)
RATE_CHANGE = wp.constant(2)
RATE_NODE = wp.constant(3)
RATE_UP = wp.constant(4)
RATE_DOWN = wp.constant(5)
"""Entries of `Prediction.rate`: ms of a frame, a unit of work, a change of any LOD, a node refitted; two exponents."""


# What the viewer sees.


@wp.func
def project_point(view: wp.array(dtype=wp.float64), p: wp.vec3d):
    """Return the place on the screen [pixels], and 1 where it lies before the camera, else 0."""
    d = wp.vec3d(p[0] - view[0], p[1] - view[1], p[2] - view[2])
    x = (view[3] * d[0] + view[4] * d[1]) + view[5] * d[2]
    y = (view[6] * d[0] + view[7] * d[1]) + view[8] * d[2]
    depth = -((view[9] * d[0] + view[10] * d[1]) + view[11] * d[2])
    if not depth > view[14] * wp.float64(1.0e-6):
        return wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
    return wp.vec3d(view[12] * x / depth, view[12] * y / depth, wp.float64(1.0))


@wp.kernel
def measure_view_kernel(
    window: wp.int32,
    centre: wp.array(dtype=wp.vec3d),
    object_model: wp.array(dtype=wp.int32),
    view: wp.array(dtype=wp.float64),
    rotation: wp.array(dtype=wp.mat33d),
    position: wp.array(dtype=wp.vec3d),
    frame: wp.array(dtype=wp.int32),
    screen_inout: wp.array(dtype=wp.vec3d),
    path_inout: wp.array(dtype=wp.float64),
    distance_out: wp.array(dtype=wp.float64),
    motion_out: wp.array(dtype=wp.float64),
    focus_out: wp.array(dtype=wp.float64),
):
    """Measure alpha, gamma and f of every object.

    Args:
        view: eye [world units], rows right, up, back; focal length [pixels], W [pixels], D [world units].
        screen_inout: Place on the screen a frame ago, and whether there was one.
        path_inout: Ways on the screen of the last `window` frames, by slot * objects + object.
    """
    i = wp.tid()
    n = object_model.shape[0]
    p = rotation[i] * centre[object_model[i]] + position[i]
    distance = wp.length(wp.vec3d(p[0] - view[0], p[1] - view[1], p[2] - view[2]))
    place = project_point(view, p)
    before = screen_inout[i]
    way = wp.float64(0.0)
    if place[2] > wp.float64(0.0) and before[2] > wp.float64(0.0):
        way = wp.length(place - before)
    screen_inout[i] = place
    path_inout[(frame[0] % window) * n + i] = way
    motion = wp.float64(0.0)
    for slot in range(window):
        motion += path_inout[slot * n + i]
    distance_out[i] = distance
    motion_out[i] = motion
    far = view[14]
    wide = view[13]
    f = wp.min((far - distance) / far, (wide - motion) / wide)
    focus_out[i] = wp.clamp(f, wp.float64(0.0), wp.float64(1.0))


@wp.kernel
def advance_frame_kernel(frame_inout: wp.array(dtype=wp.int32)):
    """Count a frame."""
    frame_inout[0] = frame_inout[0] + 1


# The paper's model.


@wp.func
def case_of(cost: wp.float64, budget: wp.float64, threshold: wp.float64):
    """Return the case of section 4.2 of a frame time; a time that is no number holds."""
    if cost - budget <= -threshold:
        return CLIMB
    if cost - budget > wp.float64(0.0):
        return FALL
    return HOLD


@wp.func
def growth(now: wp.int32, run: wp.int32, climb: wp.int32, importance: wp.int32):
    """Return g: rungs to climb, or below 0 to fall.

    Args:
        now: The case. run: i - j, frames since the case began, this one included.
        climb: Frames of the last run of Case 1. A descent mirrors it: the paper's 2j - i - 1, counted from the start of
            that run, is climb - run - 1.
    Erratum: past the mirror the paper's g2 is 0 for ever; here the smallest step goes on.
    """
    if now == CLIMB and run >= importance:
        return wp.float64(1 << wp.min(run - importance, 30))
    if now == FALL:
        return -wp.float64(1 << wp.clamp(climb - run - 1, 0, 30))
    return wp.float64(0.0)


@wp.kernel
def advance_case_kernel(
    budget: wp.float64,
    threshold: wp.float64,
    cost: wp.array(dtype=wp.float64),
    cases_inout: wp.array(dtype=wp.int32),
):
    """Compare the last frame's time with the budget: case, its run and the last climb, in one thread.

    A cost that is no number (there was no frame yet) holds everything.
    """
    now = case_of(cost[0], budget, threshold)
    run = wp.int32(1)
    if now == cases_inout[0]:
        run = cases_inout[1] + 1
    cases_inout[0] = now
    cases_inout[1] = run
    if now == CLIMB:
        cases_inout[2] = run


@wp.kernel
def step_level_kernel(
    lods: LodPool,
    focus: wp.array(dtype=wp.float64),
    cases: wp.array(dtype=wp.int32),
    level_inout: wp.array(dtype=wp.float64),
    lod_out: wp.array(dtype=wp.int32),
):
    """Move every object by f g in Case 1 and by g in Case 2, and snap it to the nearest rung.

    The level [rungs] keeps parts of a rung, or a far object would never climb.
    """
    i = wp.tid()
    g = growth(cases[0], cases[1], cases[2], lods.importance[i])
    if g > wp.float64(0.0):
        g = g * focus[i]
    top = wp.float64(lods.rung_count - 1)
    level = wp.clamp(level_inout[i] + g, wp.float64(0.0), top)
    level_inout[i] = level
    lod_out[i] = lods.lod[lods.object_model[i] * lods.rung_count + wp.int32(level + wp.float64(0.5))]


# A tolerance.


@wp.func
def loosening(focus: wp.float64, importance: wp.int32, loosest: wp.float64):
    """Return the factor on an object's tolerance: beta / f, at most `loosest`."""
    return wp.min(wp.float64(importance) / wp.max(focus, wp.float64(1.0e-9)), loosest)


@wp.kernel
def select_tolerance_kernel(
    loosest: wp.float64,
    lods: LodPool,
    focus: wp.array(dtype=wp.float64),
    tolerance: wp.array(dtype=wp.float64),
    lod_out: wp.array(dtype=wp.int32),
):
    """Give every object the coarsest rung whose certified error is within its tolerance.

    Invariant: rung `high` is within it (the finest has error 0), every rung under `low` is not.
    """
    i = wp.tid()
    start = lods.object_model[i] * lods.rung_count
    allowed = tolerance[0] * loosening(focus[i], lods.importance[i], loosest)
    low = wp.int32(0)
    high = lods.rung_count - 1
    while low < high:
        middle = (low + high) / 2
        if lods.error[start + middle] <= allowed:
            high = middle
        else:
            low = middle + 1
    lod_out[i] = lods.lod[start + high]


# A predicted budget.


@wp.func
def rung_at(lods: LodPool, i: wp.int32, dial: wp.int32, offset: wp.int32):
    """Return the rung of an object at a dial; a hash of its number deals equal objects out to neighbouring steps."""
    part = wp.int32((wp.uint32(i) * GOLDEN) >> wp.uint32(30))
    level = wp.clamp(wp.max(dial - offset + part, 0) / DITHER, 0, lods.level_count - 1)
    return lods.level_rung[lods.object_model[i] * lods.level_count + level]


@wp.kernel
def loosen_object_kernel(
    loosest: wp.float64,
    lods: LodPool,
    focus: wp.array(dtype=wp.float64),
    offset_inout: wp.array(dtype=wp.int32),
):
    """Turn an object's looseness into steps of the dial, never more than it is.

    It follows only where it has moved by more than a level, so that an object between two does not flicker.
    """
    i = wp.tid()
    octaves = wp.log2(loosening(focus[i], lods.importance[i], loosest))
    offset = wp.int32(wp.floor(octaves * wp.float64(STEPS_PER_OCTAVE)))
    if offset < offset_inout[i] or offset > offset_inout[i] + DITHER:
        offset_inout[i] = offset


@wp.kernel
def raise_faces_kernel(lods: LodPool, prediction: Prediction):
    """Raise the faces of every rung to the two exponents."""
    k = wp.tid()
    faces = wp.float64(wp.max(lods.faces[k], 1))
    prediction.power_up[k] = wp.pow(faces, prediction.rate[RATE_UP])
    prediction.power_down[k] = wp.pow(faces, prediction.rate[RATE_DOWN])


@wp.kernel
def predict_work_kernel(
    model_count: wp.int32,
    lods: LodPool,
    dial: wp.array(dtype=wp.int32),
    offset: wp.array(dtype=wp.int32),
    rung: wp.array(dtype=wp.int32),
    work: wp.array(dtype=wp.float64),
    prediction: Prediction,
):
    """Predict the tests of every object at every candidate step; one thread a candidate and chunk of the objects.

    Args:
        rung: In place. work: Tests of the last frame, each pair's shared by its two objects.
    """
    k, chunk = wp.tid()
    n = lods.object_model.shape[0]
    last = prediction.step.shape[0] - 1
    total = wp.float64(0.0)
    changed = wp.int32(0)
    i = chunk
    while i < n:
        model = lods.object_model[i]
        now = rung[i]
        then = now
        if k < last:
            then = rung_at(lods, i, dial[0] + prediction.step[k], offset[i])
        prediction.held[(k * model_count + model) * lods.rung_count + then] = 1
        a = model * lods.rung_count + now
        b = model * lods.rung_count + then
        share = work[i]
        if then != now:
            changed += 1
            if lods.faces[b] > lods.faces[a]:
                share = share * prediction.power_up[b] / prediction.power_up[a]
            else:
                share = share * prediction.power_down[b] / prediction.power_down[a]
        total += share
        i += CHUNKS
    prediction.chunk_work[k * CHUNKS + chunk] = total
    prediction.chunk_change[k * CHUNKS + chunk] = changed


@wp.func
def nodes_between(entries: wp.int32, faces: wp.int32, full_share: wp.float64):
    """Return about how many nodes a change refits whose slice has a number of entries.

    Equation 1; a slice lists each face about twice.
    """
    whole = wp.float64(2 * faces - 1)
    if wp.float64(entries) > full_share * wp.float64(faces):
        return whole
    k = wp.max(wp.float64(entries) * wp.float64(0.5), wp.float64(1.0))
    return wp.min(k * (wp.log2(wp.float64(faces)) - wp.log2(k) + wp.float64(2.0)), whole)


@wp.kernel
def predict_refit_kernel(model_count: wp.int32, full_share: wp.float64, lods: LodPool, prediction: Prediction):
    """Predict the nodes of one model that a candidate refits.

    A rung that nobody stands at yet is reached from the nearest that somebody stands at.
    """
    k, model = wp.tid()
    last = prediction.step.shape[0] - 1
    first = model * lods.rung_count
    wanted = (k * model_count + model) * lods.rung_count
    present = (last * model_count + model) * lods.rung_count
    total = wp.float64(0.0)
    for r in range(lods.rung_count):
        if prediction.held[wanted + r] == 0 or prediction.held[present + r] != 0:
            continue
        nearest = wp.int32(2147483647)
        for s in range(lods.rung_count):
            if prediction.held[present + s] != 0:
                nearest = wp.min(nearest, wp.abs(lods.entry[first + r] - lods.entry[first + s]))
        total += nodes_between(nearest, lods.face_count[model], full_share)
    wp.atomic_add(prediction.nodes, k, wp.floor(total))


@wp.kernel
def sum_chunk_kernel(prediction: Prediction):
    """Sum the chunks of one candidate, in order."""
    k = wp.tid()
    work = wp.float64(0.0)
    change = wp.int32(0)
    for chunk in range(CHUNKS):
        work += prediction.chunk_work[k * CHUNKS + chunk]
        change += prediction.chunk_change[k * CHUNKS + chunk]
    prediction.work[k] = work
    prediction.change[k] = change


@wp.func
def lasting_cost(prediction: Prediction, k: wp.int32):
    """Return the time that a candidate takes in every frame [ms]."""
    return prediction.rate[RATE_FIXED] + prediction.rate[RATE_WORK] * prediction.work[k]


@wp.func
def moving_cost(prediction: Prediction, k: wp.int32):
    """Return the time that a candidate takes in its first frame alone [ms]."""
    cost = prediction.rate[RATE_NODE] * prediction.nodes[k]
    if prediction.change[k] > 0:
        cost += prediction.rate[RATE_CHANGE]
    return cost


@wp.func
def choose_fall(limit: wp.float64, stay: wp.int32, prediction: Prediction):
    """Return the finest candidate under `stay` that lasts within a limit [ms], else the coarsest."""
    k = stay + 1
    coarsest = prediction.step.shape[0] - 2
    while k < coarsest and not lasting_cost(prediction, k) <= limit:
        k += 1
    return k


@wp.func
def choose_climb(limit: wp.float64, budget: wp.float64, stay: wp.int32, prediction: Prediction):
    """Return the finest candidate that lasts within a limit and moves within the budget [ms], else `stay`."""
    k = wp.int32(0)
    while k < stay:
        cost = lasting_cost(prediction, k)
        if cost <= limit and cost + moving_cost(prediction, k) <= budget:
            return k
        k += 1
    return stay


@wp.kernel
def choose_dial_kernel(
    budget: wp.float64,
    aim: wp.float64,
    low: wp.float64,
    patience: wp.int32,
    dial_max: wp.int32,
    stay: wp.int32,
    prediction: Prediction,
    dial_inout: wp.array(dtype=wp.int32),
    choice_out: wp.array(dtype=wp.float64),
):
    """Choose a step of the dial, in one thread.

    Candidates are ordered from the finest to the coarsest, `stay` among them; the last leaves every rung in place,
    which moves nothing. If that is over the budget: fall to the finest that lasts within `aim` of it. If following the
    view at the same dial costs under `low` of it: climb to the finest that lasts within `aim` and moves within the
    budget. Between the two: follow the view, if its move fits into the budget. A move that does not fit, of a climb or
    of the view, waits `patience` frames and is made then, or a scene whose refits are dear would never refine.

    Args:
        dial_inout: Dial, and frames that a move has waited.
        choice_out: Candidate, its lasting and moving cost [ms], its work, the work in place.
    """
    held = prediction.step.shape[0] - 1
    chosen = stay
    waits = wp.int32(0)
    lasting = lasting_cost(prediction, stay)
    moving = moving_cost(prediction, stay)
    if lasting_cost(prediction, held) > budget:
        chosen = choose_fall(aim * budget, stay, prediction)
    elif lasting + moving > budget:
        chosen = held
        waits = 1
    elif lasting + moving < low * budget and dial_inout[0] < dial_max:
        chosen = choose_climb(aim * budget, budget, stay, prediction)
        if chosen == stay and lasting_cost(prediction, stay - 1) <= aim * budget:
            waits = 1
    if waits == 1 and dial_inout[1] >= patience:
        waits = 0
        if chosen == held:
            chosen = stay
        else:
            chosen = stay - 1
    dial_inout[1] = wp.where(waits == 1, dial_inout[1] + 1, 0)
    dial_inout[0] = wp.clamp(dial_inout[0] + prediction.step[chosen], 0, dial_max)
    choice_out[0] = wp.float64(chosen)
    choice_out[1] = lasting_cost(prediction, chosen)
    choice_out[2] = moving_cost(prediction, chosen)
    choice_out[3] = prediction.work[chosen]
    choice_out[4] = prediction.work[held]


@wp.kernel
def set_rung_kernel(
    held: wp.int32,
    lods: LodPool,
    dial: wp.array(dtype=wp.int32),
    offset: wp.array(dtype=wp.int32),
    choice: wp.array(dtype=wp.float64),
    rung_inout: wp.array(dtype=wp.int32),
    lod_out: wp.array(dtype=wp.int32),
):
    """Bring every object to its rung at the dial, unless the choice is to leave all where they are."""
    i = wp.tid()
    if wp.int32(choice[0]) != held:
        rung_inout[i] = rung_at(lods, i, dial[0], offset[i])
    lod_out[i] = lods.lod[lods.object_model[i] * lods.rung_count + rung_inout[i]]
