"""Input and output of a frame that stays on the device: poses in, demands out."""

import warp as wp

from warp_abtree.kernels.base.arrays import ObjectPool
from warp_abtree.kernels.base.generation import LaunchRecord, record_launch
from warp_abtree.kernels.base.poses import PairBatch, rotate_quaternion
from warp_abtree.kernels.intersect.face_pairs import Hits, read_total
from warp_abtree.kernels.io.place_poses import is_quaternion_pose, read_position, read_quaternion
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


@wp.kernel
def place_object_kernel(
    tolerance: wp.float64,
    poses: wp.array2d(dtype=wp.float64),
    objects_inout: ObjectPool,
    faults_inout: wp.array(dtype=wp.int32),
    record_inout: LaunchRecord,
):
    """Set rotation and position from x y z qx qy qz qw, one row an object; a bad row moves nothing and is a fault."""
    i = wp.tid()
    if i == 0:
        record_launch(record_inout)
    if is_quaternion_pose(tolerance, poses, i):
        objects_inout.position[i] = read_position(poses, i)
        objects_inout.rotation[i] = rotate_quaternion(read_quaternion(poses, i))
    else:
        note_fault(faults_inout, i)


@wp.kernel
def tally_demand_kernel(batch: PairBatch, hits: Hits, demand_inout: wp.array(dtype=wp.int64)):
    """Keep the greatest demand of any frame: object pairs, face pairs that meet, uncertain face pairs.

    The last entry becomes 1 once a frame was stale (`LaunchRecord.launched`).
    Counts past 2^31 are kept, since one thread a pair or hit takes an int32 past its sign bit, not around.
    """
    demand_inout[0] = wp.max(demand_inout[0], wp.int64(wp.uint32(batch.count[0])))
    demand_inout[1] = wp.max(demand_inout[1], wp.int64(wp.uint32(hits.total[0])))
    demand_inout[2] = wp.max(demand_inout[2], wp.int64(wp.uint32(hits.uncertain_total[0])))
    if hits.apart.shape[0] > 0:
        demand_inout[2] = wp.max(demand_inout[2], read_total(hits.apart_total))
    demand_inout[3] = wp.max(demand_inout[3], wp.int64(batch.launched[1]))
