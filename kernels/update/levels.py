"""Objects at the levels of LOD ladders: which tree state serves each, and how many stand at each level."""

import warp as wp

from warp_abtree.kernels.base.arrays import ObjectPool
from warp_abtree.kernels.update.work_lists import note_fault

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class Levels:
    """Ladders of all models, one after another, and where objects stand on them.

    A model's levels have a tree state each, made beforehand, or each of its objects has one of its own, which is
    brought to the level.
    """

    object_model: wp.array(dtype=wp.int32)  # shape [object]
    start: wp.array(dtype=wp.int32)  # where the levels of each model begin, by rising LOD, shape [model + 1]
    lod: wp.array(dtype=wp.int32)  # shape [level]
    state: wp.array(dtype=wp.int32)  # tree state that serves a level, -1 where objects have their own, shape [level]
    level: wp.array(dtype=wp.int32)  # of each object, shape [object]
    direction: wp.array(dtype=wp.int32)  # of its last change: 1, -1, or 0 before the first, shape [object]
    count: wp.array(dtype=wp.int32)  # objects at each level, shape [level]
    state_lod: wp.array(dtype=wp.int32)  # LOD wanted of each tree state, shape [state]; [0] where none is brought to it
    changed: wp.array(dtype=wp.int32)  # objects that changed level, and those that turned back, shape [2]


@wp.kernel
def place_level_kernel(
    wanted: wp.array(dtype=wp.int32),
    levels_inout: Levels,
    objects_inout: ObjectPool,
    faults_inout: wp.array(dtype=wp.int32),
):
    """Bring each object to the coarsest level of its model that is not coarser than the wanted LOD.

    Args:
        wanted: LOD of each object; one out of range is a fault and served by the nearer end.
        faults_inout: As `note_fault`, by object.
    """
    i = wp.tid()
    model = levels_inout.object_model[i]
    # The last one where all are coarser.
    level = wp.lower_bound(levels_inout.lod, levels_inout.start[model], levels_inout.start[model + 1], wanted[i])
    level = wp.min(level, levels_inout.start[model + 1] - 1)
    if wanted[i] < 0 or wanted[i] > levels_inout.lod[level]:
        note_fault(faults_inout, i)
    old = levels_inout.level[i]
    if level == old:
        return
    levels_inout.level[i] = level
    wp.atomic_add(levels_inout.count, old, -1)
    wp.atomic_add(levels_inout.count, level, 1)
    wp.atomic_add(levels_inout.changed, 0, 1)
    direction = wp.where(level > old, 1, -1)
    if direction * levels_inout.direction[i] < 0:
        wp.atomic_add(levels_inout.changed, 1, 1)
    levels_inout.direction[i] = direction
    if levels_inout.state[level] >= 0:
        objects_inout.state[i] = levels_inout.state[level]
    else:
        levels_inout.state_lod[objects_inout.state[i]] = levels_inout.lod[level]
