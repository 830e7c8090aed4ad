"""Generations of device arrays: a graph that replays on arrays that were replaced since its capture is found out."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

STALE = wp.constant(-2)


@wp.struct
class LaunchRecord:
    """Generations of arrays: those that a launch was given, those in force when it runs, and the launch's outcome."""

    states: wp.int32  # of the tree states given; a captured graph keeps those of its capture
    filter: wp.int32  # of the filter given
    buffers: wp.int32  # of the buffers given
    states_now: wp.array(dtype=wp.int32)  # in force, shape [1]
    filter_now: wp.array(dtype=wp.int32)  # in force, shape [1]
    buffers_now: wp.array(dtype=wp.int32)  # in force, shape [1]
    launched: wp.array(dtype=wp.int32)  # buffers of the last launch or STALE; 1 if any was stale, shape [2]


@wp.func
def is_stale(record: LaunchRecord):
    """Return whether anything that a launch was given has been replaced, or is in doubt."""
    current = record.states == record.states_now[0] and record.filter == record.filter_now[0]
    return not (current and record.buffers == record.buffers_now[0])


@wp.func
def record_launch(record: LaunchRecord):
    """Note which buffers a launch uses, or that it is stale; for one thread. Return whether it is stale."""
    stale = is_stale(record)
    if stale:
        record.launched[0] = STALE
        record.launched[1] = 1
    else:
        record.launched[0] = record.buffers
    return stale
