"""Objects at their finest LODs, for questions about their original meshes."""

from typing import Any

from warp_abtree.kernels.base.lanes import WARP_SIZE
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.inside import originals
from warp_abtree.query.broad_phase import BroadPhase
from warp_abtree.query.operator import Operator
from warp_abtree.query.stage import Array, Rooms, Stage
from warp_abtree.state.batch import Batch


def make_finest(batch: Batch) -> Batch:
    """Return a batch of the same objects at their finest LODs, as they are posed; their tree states are made once."""
    finest = batch.with_own_states(follows_poses=True)
    finest.replace_states(list(enumerate(batch.models.lod_max.tolist())), batch.object_model)
    return finest


class Originals:
    """`make_finest` of a batch, and their broad phase: originals may lie out of the boxes of their LODs."""

    def __init__(self, batch: Batch):
        self._of, self.batch = batch, make_finest(batch)
        self.broad_phase = BroadPhase(self.batch)

    def follow_filter(self):
        """Leave out the pairs that the batch leaves out now."""
        if self.batch.excluded is not self._of.excluded:
            self.batch.exclude(self._of.excluded)
            self.broad_phase = BroadPhase(self.batch)


class OriginalStage(Stage):
    """Move contact points found at LODs to the original surfaces, of which `finest` is a batch; None makes one."""

    poses: Any  # of the originals of each pair, device `PairPose` (pair,)

    def __init__(self, finest: Batch | None = None):
        self.finest: Any = finest

    def attach(self, operator: Operator):
        """Take the operator, and make the tree states."""
        super().attach(operator)
        self.finest = self.finest or make_finest(operator.batch)

    def arrays(self, rooms: Rooms) -> list[Array]:
        """Return the poses."""
        return [Array(self, "poses", PairPose, rooms.pairs)]

    def project(self, gap: Any, faces: Any, rows: Any, manifolds: Any):
        """Move the points, of which `manifolds` has the witnesses. Launches only."""
        operator, trees = self.operator, self.finest.trees
        asked, room, launch = operator.pair_batch, operator.rooms.pairs, operator.launch_kernel
        launch(originals.pose_original_kernel, room, [trees, asked, self.poses])
        inputs = [operator.batch.trees, trees, asked, self.poses, faces, rows, manifolds]
        launch(originals.project_point_kernel, (room, manifolds.point.shape[1]), inputs, WARP_SIZE)
        launch(originals.drop_apart_kernel, room, [asked, gap, manifolds])
