"""Objects at their finest LODs, for questions about their original meshes."""

from warp_abtree.query.broad_phase import BroadPhase
from warp_abtree.state.batch import Batch


class Originals:
    """The objects of a batch at their finest LODs, as they are posed, with tree states that are made once.

    Attributes:
        batch: `Batch` of its own.
        broad_phase: Of these; originals may lie out of the boxes of their LODs.
    """

    def __init__(self, batch: Batch):
        self._of, self.batch = batch, batch.with_own_states(follows_poses=True)
        self.batch.add_finest(range(len(batch.models.lod_max)))
        self.broad_phase = BroadPhase(self.batch)

    def follow_filter(self):
        """Leave out the pairs that the batch leaves out now."""
        if self.batch.excluded is not self._of.excluded:
            self.batch.exclude(self._of.excluded)
            self.broad_phase = BroadPhase(self.batch)
