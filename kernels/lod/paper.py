"""The selection model of section 4.2 of the paper: levels rise and fall by powers of two about a time budget."""

import warp as wp

from warp_abtree.kernels.lod.ladder import LodPool

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

CLIMB = wp.constant(1)
FALL = wp.constant(2)
HOLD = wp.constant(3)
"""Cases of section 4.2: more than a threshold under the budget, over it, between the two."""


@wp.func
def paper_case(cost: wp.float64, budget: wp.float64, threshold: wp.float64):
    """Return the case of section 4.2 for a frame time; NaN gives HOLD."""
    if cost - budget <= -threshold:
        return CLIMB
    if cost - budget > wp.float64(0.0):
        return FALL
    return HOLD


@wp.func
def paper_g(now: wp.int32, run: wp.int32, climb: wp.int32, importance: wp.int32):
    """Return g of section 4.2: levels to climb, below 0 to fall.

    Args:
        now: The case.
        run: i - j, frames since the case began, this one included.
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
    """Update the case, the length of its run and that of the last climb from the last frame's time; one thread."""
    now = paper_case(cost[0], budget, threshold)
    run = wp.int32(1)
    if now == cases_inout[0]:
        run = cases_inout[1] + 1
    cases_inout[0] = now
    cases_inout[1] = run
    if now == CLIMB:
        cases_inout[2] = run


@wp.kernel
def advance_level_kernel(
    lods: LodPool,
    focus: wp.array(dtype=wp.float64),
    cases: wp.array(dtype=wp.int32),
    level_inout: wp.array(dtype=wp.float64),
    lod_out: wp.array(dtype=wp.int32),
):
    """Move every object by f g in Case 1 and by g in Case 2, and round to the nearest level.

    `level_inout` keeps fractions of a level, otherwise a far object would never climb.
    """
    i = wp.tid()
    g = paper_g(cases[0], cases[1], cases[2], lods.importance[i])
    if g > wp.float64(0.0):
        g = g * focus[i]
    top = wp.float64(lods.level_count - 1)
    level = wp.clamp(level_inout[i] + g, wp.float64(0.0), top)
    level_inout[i] = level
    lod_out[i] = lods.lod[lods.object_model[i] * lods.level_count + wp.int32(level + wp.float64(0.5))]
