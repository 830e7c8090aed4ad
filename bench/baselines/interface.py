"""What baselines that answer pose by pose on the host have in common."""


class PoseLoop:
    """Mesh A at the origin against mesh B at many poses.

    Args:
        a, b: Vertices float64 (v, 3) and faces int32 (f, 3); one object if both are one mesh.
        matrices: Poses of B, float64 (n, 4, 4).

    Raises:
        ImportError: The library is not installed.
    """

    name: str

    def any(self) -> list:
        """Return whether A and B intersect at each pose."""
        raise NotImplementedError

    def faces(self) -> list:
        """Return an answer a pose that lists all intersecting face pairs; see `face_pairs`."""
        raise NotImplementedError

    @staticmethod
    def face_pairs(answer):
        """Return the face numbers in one answer, (k, 2)."""
        return [(contact.b1, contact.b2) for contact in answer.contacts]
