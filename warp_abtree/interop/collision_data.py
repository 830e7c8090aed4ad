"""Records that a `CollisionManager` returns for a pair of objects: contacts, and nearest points."""

import numpy as np


class PairData:
    """Two named objects and a face of each."""

    __slots__ = ("_faces", "names")

    def __init__(self, names, faces):
        self.names = set(names)
        self._faces = dict(zip(names, faces))

    def index(self, name) -> int:
        """Return the index of the named object's face in its mesh."""
        return self._faces[name]


class ContactData(PairData):
    """One contact, as trimesh.collision.ContactData.

    Attributes:
        names: Names of the two objects, a set.
        point: Midpoint of the segment [world units], float64 (3,).
        normal: Unit normal from the first object of the pair to the second, float64 (3,).
        depth: Penetration depth of the two objects, that of `Scene.penetration` [world units]: as far as `way_out`.
        segment: End points of the segment in which the two faces intersect; where one object is wholly inside the
            other, its deepest point and the surface's nearest one [world units], float64 (2, 3).
    """

    __slots__ = ("_ways", "depth", "normal", "point", "segment")

    def __init__(self, names, faces, segment, normal, depth, way):
        super().__init__(names, faces)
        self.segment, self.normal, self.depth = segment, normal, depth
        self.point = 0.5 * (segment[0] + segment[1])
        self._ways = dict(zip(names, (-way, way)))

    def way_out(self, name) -> np.ndarray:
        """Return the translation that frees the named object from the other one [world units], float64 (3,)."""
        return self._ways[name]


class DistanceData(PairData):
    """The nearest points of two objects, as trimesh.collision.DistanceData.

    Attributes:
        names: Names of the two objects, a set.
        distance: Distance between them [world units]; 0 if they intersect.
    """

    __slots__ = ("_points", "distance")

    def __init__(self, names, faces, points, distance):
        super().__init__(names, faces)
        self._points = dict(zip(names, points))
        self.distance = distance

    def point(self, name) -> np.ndarray:
        """Return the nearest point of the named object [world units], float64 (3,)."""
        return self._points[name]
