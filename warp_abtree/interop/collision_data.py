"""What a `CollisionManager` returns for a pair of objects: contacts, and nearest points."""

import numpy as np


class ContactData:
    """One contact, as trimesh.collision.ContactData.

    Attributes:
        names: Names of the two objects, a set.
        point: Midpoint of the segment in which the two faces intersect [world units], float64 (3,).
        normal: Unit normal from the first object of the pair to the second, float64 (3,).
        depth: Estimated penetration depth of the pair (see `warp_abtree.query.contacts`) [world units].
        segment: End points of that segment, float64 (2, 3).
    """

    __slots__ = ("_faces", "depth", "names", "normal", "point", "segment")

    def __init__(self, names, faces, segment, normal, depth):
        self.names = set(names)
        self._faces = dict(zip(names, faces))
        self.segment = segment
        self.point = 0.5 * (segment[0] + segment[1])
        self.normal = normal
        self.depth = depth

    def index(self, name) -> int:
        """Return the index of the named object's face in its mesh."""
        return self._faces[name]


class DistanceData:
    """The nearest points of two objects, as trimesh.collision.DistanceData.

    Attributes:
        names: Names of the two objects, a set.
        distance: Distance between them [world units]; 0 if they intersect.
    """

    __slots__ = ("_faces", "_points", "distance", "names")

    def __init__(self, names, faces, points, distance):
        self.names = set(names)
        self._faces = dict(zip(names, faces))
        self._points = dict(zip(names, points))
        self.distance = distance

    def index(self, name) -> int:
        """Return the index of the named object's nearest face in its mesh."""
        return self._faces[name]

    def point(self, name) -> np.ndarray:
        """Return the nearest point of the named object [world units], float64 (3,)."""
        return self._points[name]
