"""Input and output of a frame that stays on the device: poses in, demands out."""

import warp as wp

from warp_abtree.kernels.base.arrays import NO_OBJECT, ObjectPool
from warp_abtree.kernels.base.generation import LaunchRecord, record_launch
from warp_abtree.kernels.base.poses import PairBatch, rotate_quaternion
from warp_abtree.kernels.intersect.face_pairs import Hits, read_total
from warp_abtree.kernels.io.place_poses import is_quaternion_pose, read_position, read_quaternion
from warp_abtree.kernels.lod.prediction import LevelChoice, set_level
from warp_abtree.kernels.update.levels import Levels, place_level
from warp_abtree.kernels.update.work_lists import note_fault

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def read_pose_kernel(objects: ObjectPool, poses_out: wp.array2d(dtype=wp.float64)):
    """Write each object's pose as x y z qx qy qz qw [world units, unit quaternion]."""
    i = wp.tid()
    q = wp.normalize(wp.quat_from_matrix(objects.rotation[i]))
    for k in range(3):
        poses_out[i, k] = objects.position[i][k]
    for k in range(4):
        poses_out[i, 3 + k] = q[k]


@wp.func
def set_pose(i: wp.int32, poses: wp.array2d(dtype=wp.float64), objects: ObjectPool):
    """Set rotation and position of an object from a row x y z qx qy qz qw."""
    objects.position[i] = read_position(poses, i)
    objects.rotation[i] = rotate_quaternion(read_quaternion(poses, i))


@wp.func
def place_object(
    i: wp.int32,
    tolerance: wp.float64,
    poses: wp.array2d(dtype=wp.float64),
    objects: ObjectPool,
    faults: wp.array(dtype=wp.int32),
):
    """Do what `set_pose` does; a bad row moves nothing and is a fault, but of a place without an object."""
    if is_quaternion_pose(tolerance, poses, i):
        set_pose(i, poses, objects)
    elif objects.is_static[i] != NO_OBJECT:
        note_fault(faults, i)


@wp.kernel
def place_object_kernel(
    tolerance: wp.float64,
    poses: wp.array2d(dtype=wp.float64),
    objects_inout: ObjectPool,
    faults_inout: wp.array(dtype=wp.int32),
    record_inout: LaunchRecord,
):
    """Set the pose of each object."""
    i = wp.tid()
    if i == 0:
        record_launch(record_inout)
    place_object(i, tolerance, poses, objects_inout, faults_inout)


@wp.func
def tally_demand(batch: PairBatch, hits: Hits, demand: wp.array(dtype=wp.int64)):
    """Keep the greatest demand of any frame, that of the last among them unless it is forgotten.

    Entries: object pairs, face pairs that meet, uncertain face pairs; 1 once a frame was stale
    (`LaunchRecord.launched`); 1 where the demand of a frame is not forgotten. Counts past 2^31 are kept, since one
    thread a pair or hit takes an int32 past its sign bit, not around.
    """
    if demand[4] == wp.int64(0):
        return
    demand[0] = wp.max(demand[0], wp.int64(wp.uint32(batch.count[0])))
    demand[1] = wp.max(demand[1], wp.int64(wp.uint32(hits.total[0])))
    demand[2] = wp.max(demand[2], wp.int64(wp.uint32(hits.uncertain_total[0])))
    if hits.apart.shape[0] > 0:
        demand[2] = wp.max(demand[2], read_total(hits.apart_total))
    demand[3] = wp.max(demand[3], wp.int64(batch.launched[1]))


@wp.kernel
def tally_demand_kernel(batch: PairBatch, hits: Hits, demand_inout: wp.array(dtype=wp.int64)):
    """Keep the demand of the last frame; one thread."""
    tally_demand(batch, hits, demand_inout)


@wp.kernel
def begin_pipeline_kernel(
    tolerance: wp.float64,
    poses: wp.array2d(dtype=wp.float64),
    batch: PairBatch,
    hits: Hits,
    demand_inout: wp.array(dtype=wp.int64),
    levels_inout: Levels,
    objects_inout: ObjectPool,
    faults_inout: wp.array(dtype=wp.int32),
    record_inout: LaunchRecord,
):
    """Keep the demand of the frame before; set the pose of each object, and its level where there are any."""
    i = wp.tid()
    if i == 0:
        tally_demand(batch, hits, demand_inout)
        demand_inout[4] = wp.int64(1)
        record_launch(record_inout)
    place_object(i, tolerance, poses, objects_inout, faults_inout)
    if levels_inout.level.shape[0] > 0:
        place_level(i, levels_inout, objects_inout)


@wp.kernel
def arrange_object_kernel(
    poses: wp.array2d(dtype=wp.float64),
    chosen: LevelChoice,
    levels_inout: Levels,
    objects_inout: ObjectPool,
    tests_out: wp.array(dtype=wp.int64),
):
    """Bring each object to the level and the pose that a frame has for it, and set its tests to 0.

    Args:
        poses: Sound poses, shape [object, 7]; [0, 7] where nothing moves.
        chosen: What LODs wanted follow from, in the place of those that stand there; or of empty arrays.
        levels_inout: Of empty arrays where objects stay at their levels.
        tests_out: Shape [object], or [0].
    """
    i = wp.tid()
    if levels_inout.level.shape[0] > 0:
        if chosen.level.shape[0] > 0:
            set_level(i, chosen, levels_inout.wanted)
        place_level(i, levels_inout, objects_inout)
    if poses.shape[0] > 0:
        set_pose(i, poses, objects_inout)
    if tests_out.shape[0] > 0:
        tests_out[i] = wp.int64(0)
