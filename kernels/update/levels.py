"""Objects at the levels of LOD ladders: which tree state serves each, and how many stand at each level."""

import warp as wp

from warp_abtree.kernels.base.arrays import NO_OBJECT, ObjectPool
from warp_abtree.kernels.update.work_lists import note_fault

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


# Of an object: its level stayed, changed, or changed in the other direction than the time before.
LEVEL_STAYED, LEVEL_CHANGED, LEVEL_TURNED = wp.constant(0), wp.constant(1), wp.constant(2)


@wp.struct
class Levels:
    """Ladders of all models, one after another, and where objects stand on them.

    A model's levels have a tree state each, made beforehand, or each of its objects has one of its own, which is
    brought to the level.
    """

    object_model: wp.array(dtype=wp.int32)  # shape [object]
    wanted: wp.array(dtype=wp.int32)  # LOD wanted of each object; nearer ends serve those out of range, shape [object]
    faults: wp.array(dtype=wp.int32)  # `note_fault` of those out of range, by object
    start: wp.array(dtype=wp.int32)  # where the levels of each model begin, by rising LOD, shape [model + 1]
    lod: wp.array(dtype=wp.int32)  # shape [level]
    state: wp.array(dtype=wp.int32)  # tree state that serves a level, -1 where objects have their own, shape [level]
    level: wp.array(dtype=wp.int32)  # of each object, shape [object]
    direction: wp.array(dtype=wp.int32)  # of its last change: 1, -1, or 0 before the first, shape [object]
    count: wp.array(dtype=wp.int32)  # objects at each level, shape [level]
    state_lod: wp.array(dtype=wp.int32)  # LOD wanted of each tree state, shape [state]; [0] where none is brought to it
    change: wp.array(dtype=wp.int32)  # LEVEL_STAYED, LEVEL_CHANGED or LEVEL_TURNED in the last launch, shape [object]


@wp.func
def place_level(i: wp.int32, levels: Levels, objects: ObjectPool):
    """Bring an object to the coarsest level of its model that is not coarser than the wanted LOD."""
    wanted = wp.int32(levels.wanted[i])
    model = levels.object_model[i]
    # The last one where all are coarser.
    level = wp.lower_bound(levels.lod, levels.start[model], levels.start[model + 1], wanted)
    level = wp.min(level, levels.start[model + 1] - 1)
    if (wanted < 0 or wanted > levels.lod[level]) and objects.is_static[i] != NO_OBJECT:
        note_fault(levels.faults, i)
    old = levels.level[i]
    change = wp.int32(LEVEL_STAYED)
    if level != old:
        levels.level[i] = level
        wp.atomic_add(levels.count, old, -1)
        wp.atomic_add(levels.count, level, 1)
        direction = wp.where(level > old, 1, -1)
        change = wp.where(direction * levels.direction[i] < 0, LEVEL_TURNED, LEVEL_CHANGED)
        levels.direction[i] = direction
        if levels.state[level] >= 0:
            objects.state[i] = levels.state[level]
        else:
            levels.state_lod[objects.state[i]] = levels.lod[level]
    levels.change[i] = change
