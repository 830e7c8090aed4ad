"""What baselines have in common.

A `PoseLoop` answers pose by pose on the host; an `Operator` allocates once and launches all pairs on a device.
"""

from abc import ABC, abstractmethod


class PoseLoop(ABC):
    """Mesh A at the origin against mesh B at many poses.

    Args:
        a, b: Vertices float64 (v, 3) and faces int32 (f, 3); one object if both are one mesh.
        matrices: Poses of B, float64 (n, 4, 4).

    Raises:
        ImportError: The library is not installed.
    """

    name: str

    @abstractmethod
    def __init__(self, a, b, matrices): ...

    @abstractmethod
    def any(self) -> list:
        """Return whether A and B intersect at each pose."""

    @abstractmethod
    def faces(self) -> list:
        """Return an answer a pose that lists all intersecting face pairs; see `face_pairs`."""

    @staticmethod
    def face_pairs(answer):
        """Return the face numbers in one answer, (k, 2)."""
        return [(contact.b1, contact.b2) for contact in answer.contacts]


class Operator(ABC):
    """Posed pairs of one mesh on a device: objects 2p and 2p + 1 form pair p."""

    @abstractmethod
    def launch(self):
        """Launch the query; can be captured on CUDA."""

    @abstractmethod
    def result(self):
        """Return what the last launch found. Waits for the device."""
