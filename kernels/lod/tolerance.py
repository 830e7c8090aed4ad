"""Selection by a tolerance in the world, loosened object by object (section 4.1 of the paper)."""

import warp as wp

from warp_abtree.kernels.lod.ladder import LodPool

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


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
    """Give every object the coarsest level whose certified error is within its tolerance.

    Invariant: level `high` is within it (the finest has error 0), every level below `low` is not.
    """
    i = wp.tid()
    start = lods.object_model[i] * lods.level_count
    allowed = tolerance[0] * loosening(focus[i], lods.importance[i], loosest)
    low = wp.int32(0)
    high = lods.level_count - 1
    while low < high:
        middle = (low + high) / 2
        if lods.error[start + middle] <= allowed:
            high = middle
        else:
            low = middle + 1
    lod_out[i] = lods.lod[start + high]
