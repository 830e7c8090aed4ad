"""CollisionManager: a drop-in replacement for trimesh.collision.CollisionManager, with exact answers in batches."""

import math
from collections.abc import Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from warp_abtree.checks.arguments import to_numpy
from warp_abtree.checks.device_memory import DeviceMemory
from warp_abtree.interop.placed_shapes import PlacedShapes, shape_of
from warp_abtree.state.poses import check_poses

EXTERNAL = "__external"  # trimesh's name for a mesh that is not in the manager
DEPTH_TOLERANCE = 2.0**-40  # of `Scene.penetration`
FIRST_PAIRS = 64  # tested first if one collision is enough


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


def _join(first, *rest):
    """Return a value alone, or with those of the others that were requested."""
    more = [value for requested, value in rest if requested]
    return (first, *more) if more else first


class CollisionManager(DeviceMemory):
    """Named, posed meshes and their collisions: a drop-in replacement for trimesh.collision.CollisionManager.

    Names, signatures and the shapes of results are trimesh's: what is asked for beside an answer makes a tuple of it.
    Collisions have a set of names or of pairs of them, and a list of `ContactData`; distances the names of the nearest
    pair, and a `DistanceData`, both None where there is no pair. All of them wait for the device. Closed meshes are
    solids, all others surfaces. Differences:

    * Answers are exact for the given poses, also of convex meshes. Touching is a collision, and so is what lies inside
      any closed mesh.
    * A contact is a pair of intersecting faces, see `ContactData`. Its depth is the penetration depth of the two
      objects, whatever their shapes: the same in all contacts of a pair. An object wholly inside a solid gives one
      contact, whose segment joins its deepest point and the surface.
    * Distances [world units] are negative where solids are deep in one another, by how far the deepest point of one in
      the other is from the surface (`query.stages.distance`), a lower bound of the penetration depth; 0 where surfaces
      merely intersect, infinite if there are no objects.
    * Transforms must be rigid within 1e-6; an object of the same name is replaced; `add_object` returns nothing.

    Cost: meshes are prepared once for all managers, by content. The first call after a new mesh, of `add_object`,
    `in_collision_single` or `in_collision_other`, uploads all models again, others poses only. A removed object leaves
    a slot for another of the same mesh; free slots are released when they outnumber objects, and 16.

    Args:
        device: Warp device, such as "cpu" or "cuda:0"; None for Warp's default.
        solids: False makes closed meshes surfaces too: nothing collides inside them, and no distance is negative.

    Raises:
        ValueError: No such device on this machine.
    """

    def __init__(self, device=None, solids=True):
        self._solids = bool(solids)
        self._slots: dict = {}
        self._placed = PlacedShapes(device, self._solids)

    @property
    def device(self):
        """Warp device of the computations."""
        return self._placed.scene.device

    def placed_objects(self) -> list:
        """Return name, `Shape` and pose (4, 4) [world units] of every object."""
        placed = self._placed
        return [(name, placed.shapes[slot], placed.poses[slot].copy()) for name, slot in self._slots.items()]

    def _release_slots(self):
        """Make the scene again without free slots if there are too many of these."""
        if self._placed.has_too_many_free(len(self._slots)):
            kept = self.placed_objects()
            self._placed = PlacedShapes(self.device, self._solids)
            self._slots = {name: self._placed.add(shape, matrix) for name, shape, matrix in kept}

    @contextmanager
    def _pairs_with(self, guests):
        """Add guests for the duration of one call: name, `Shape` and matrix of each.

        Yields pairs of slots (own, guest), and a function of an index that returns the pair's names.
        """
        slots = []
        try:
            for _, shape, matrix in guests:
                slots.append(self._placed.add(shape, matrix))
            names, own = list(self._slots), np.array(list(self._slots.values()), np.int32)
            pairs = np.stack([np.repeat(own, len(slots)), np.tile(np.array(slots, np.int32), len(own))], 1)
            yield pairs, lambda k: (names[k // len(slots)], guests[k % len(slots)][0])
        finally:
            for slot in slots:
                self._placed.remove(slot)
            self._release_slots()

    def _slot(self, name) -> int:
        if name not in self._slots:
            raise ValueError(f"{name} not in collision manager!")
        return self._slots[name]

    def _pairs_within(self):
        """Return all pairs of slots of objects, and a function of an index that returns the pair's names."""
        names, own = list(self._slots), np.array(list(self._slots.values()), np.int32)
        i, j = np.triu_indices(len(own), 1)
        return np.stack([own[i], own[j]], 1), lambda k: (names[i[k]], names[j[k]])

    @staticmethod
    def _objects_of(other_manager) -> list:
        if not isinstance(other_manager, CollisionManager):
            raise TypeError(f"other_manager is a {type(other_manager).__name__}, not a warp_abtree.CollisionManager")
        return other_manager.placed_objects()

    def _external(self, mesh, transform):
        return [(EXTERNAL, shape_of(mesh, EXTERNAL), self._matrix(transform, EXTERNAL))]

    @staticmethod
    def _matrix(transform, name):
        matrix = np.eye(4) if transform is None else to_numpy(transform, f"transform of {name!r}")
        if matrix.shape != (4, 4):
            raise ValueError(f"transform of {name!r}: shape {matrix.shape}, not (4, 4)")
        return check_poses(matrix[None], f"transform of {name!r}")[0]

    # Objects.

    def add_object(self, name, mesh, transform=None):
        """Add an object; it replaces the one of that name.

        Args:
            name: Hashable; sortable if pairs of names are requested.
            mesh: trimesh.Trimesh, or a `Model`, taken at its finest LOD.
            transform: Rigid, (4, 4) [world units]; None is the identity.

        Raises:
            MeshError: The mesh cannot be used.
            ValueError: The transform is not rigid within 1e-6; nothing is changed.
        """
        matrix, shape = self._matrix(transform, name), shape_of(mesh, name)
        if name in self._slots:
            self.remove_object(name)
        self._slots[name] = self._placed.add(shape, matrix)

    def remove_object(self, name):
        """Remove an object; raise ValueError if none has this name."""
        self._placed.remove(self._slot(name))
        del self._slots[name]
        self._release_slots()

    def set_transform(self, name, transform):
        """Set the transform of an object, rigid (4, 4) [world units].

        Raises ValueError for no such object, or a transform that is not rigid within 1e-6, and changes nothing.
        """
        self._placed.move(self._slot(name), self._matrix(transform, name))

    # Collisions.

    def in_collision_single(self, mesh, transform=None, return_names=False, return_data=False):
        """Return whether another mesh, given as for `add_object`, collides with any object, and the names of these.

        In contacts the mesh is named "__external".
        """
        any_hit, hits, contacts = self._collide_with(self._external(mesh, transform), return_names, return_data)
        return _join(any_hit, (return_names, {name for name, _ in hits}), (return_data, contacts))

    def in_collision_internal(self, return_names=False, return_data=False):
        """Return whether any two objects collide, and the pairs of names, each in alphabetical order."""
        name_of = {slot: name for name, slot in self._slots.items()}
        self._placed.upload()
        scene = self._placed.scene
        pairs = scene.broad_phase() if len(name_of) > 1 else np.empty((0, 2), np.int32)
        used = np.zeros(scene.object_count, bool)
        used[list(name_of)] = True
        pairs = pairs[used[pairs].all(1)]
        named = [(name_of[i], name_of[j]) for i, j in pairs.tolist()]
        any_hit, hits, contacts = self._collide(pairs, named, return_data, not (return_names or return_data))
        return _join(any_hit, (return_names, {tuple(sorted(names)) for names in hits}), (return_data, contacts))

    def in_collision_other(self, other_manager, return_names=False, return_data=False):
        """Return whether any object collides with one of another manager, of any device.

        Pairs are (name here, name there). Raises TypeError for what is no `CollisionManager` of this library.
        """
        any_hit, hits, contacts = self._collide_with(self._objects_of(other_manager), return_names, return_data)
        return _join(any_hit, (return_names, set(hits)), (return_data, contacts))

    # Distances.

    def min_distance_single(self, mesh, transform=None, return_name=False, return_data=False):
        """Return the distance of another mesh, given as for `add_object`, from the nearest object, and its name."""
        with self._pairs_with(self._external(mesh, transform)) as (pairs, names):
            distance, pair, data = self._nearest(pairs, names)
        return _join(distance, (return_name, pair and pair[0]), (return_data, data))

    def min_distance_internal(self, name=None, return_names=False, return_data=False):
        """Return the least distance of two objects, or of a named one from the others, and their sorted names.

        Raises ValueError if no object has this name.
        """
        pairs, names = self._pairs_within()
        asked = np.arange(len(pairs)) if name is None else np.flatnonzero((pairs == self._slot(name)).any(1))
        distance, pair, data = self._nearest(pairs[asked], lambda k: names(asked[k]))
        return _join(distance, (return_names, pair and tuple(sorted(pair))), (return_data, data))

    def min_distance_other(self, other_manager, return_names=False, return_data=False):
        """Return the least distance of an object from one of another manager, and (name here, name there).

        Raises TypeError for what is no `CollisionManager` of this library.
        """
        with self._pairs_with(self._objects_of(other_manager)) as (pairs, names):
            distance, pair, data = self._nearest(pairs, names)
        return _join(distance, (return_names, pair), (return_data, data))

    def first_contact_internal(self, transforms, tolerance=1e-6, return_names=False):
        """Return when two objects first collide as some move, from 0 to 1 and never late; 1 if none do. Waits.

        What FCL's continuousCollide is for two objects. Objects move as in `Scene.first_contact`, and stay in place.

        Args:
            transforms: Where objects end in unit time, by name: rigid (4, 4) [world units]; others rest.
            tolerance: What the time may be early by.
            return_names: Return the two names too, a tuple in alphabetical order; None if none collide.

        Raises:
            TypeError: transforms is no dictionary.
            ValueError: No object has a name, a transform is not rigid within 1e-6, or turns by half a revolution.
        """
        if not isinstance(transforms, Mapping):
            raise TypeError(f"transforms is a {type(transforms).__name__}, not a dictionary of transforms by name")
        ends = np.array(self._placed.poses[: self._placed.scene.object_count]).reshape(-1, 4, 4)
        for name, transform in transforms.items():
            ends[self._slot(name)] = self._matrix(transform, name)
        _, at_first = self.in_collision_internal(return_names=True)
        time, pair = (0.0, min(at_first)) if at_first else (1.0, None)
        pairs, names = self._pairs_within()
        if not at_first and len(pairs):
            found = self._placed.scene.first_contact(pairs, ends, tolerance)
            k = int(found.time.argmin())
            if not found.clear[k]:
                time, pair = float(found.time[k]), tuple(sorted(names(k)))
        return _join(time, (return_names, pair))

    # Computation.

    def _collide_with(self, guests, return_names, return_data):
        """Return what `_collide` does for all pairs of an object and a guest whose boxes overlap."""
        with self._pairs_with(guests) as (pairs, names):
            kept = np.flatnonzero(self._placed.gaps(pairs) == 0)
            named = [names(k) for k in kept.tolist()]
            return self._collide(pairs[kept], named, return_data, not (return_names or return_data))

    def _collide(self, pairs, names, return_data, first_only=False):
        """Return whether any pair collides, or the first do, names of those that do, and contacts if requested."""
        if first_only and len(pairs) > FIRST_PAIRS:
            first = self._collide(pairs[:FIRST_PAIRS], names[:FIRST_PAIRS], return_data)
            return first if first[0] else self._collide(pairs[FIRST_PAIRS:], names[FIRST_PAIRS:], return_data)
        if not len(pairs):
            return False, [], []
        self._placed.upload()
        scene = self._placed.scene
        if not return_data:
            hit = np.flatnonzero(scene.intersect(pairs, output="any").any)
            return bool(len(hit)), [names[k] for k in hit.tolist()], []
        result = scene.intersect(pairs, output="contacts")
        hit = np.flatnonzero(result.any)
        found = scene.penetration(pairs[hit], tolerance=DEPTH_TOLERANCE)
        ways = {k: found.depth[row] * found.direction[row] for row, k in enumerate(hit.tolist())}
        depths = dict(zip(hit.tolist(), found.depth.tolist()))
        rows = result.contacts
        segments = np.stack([rows["p0"], rows["p1"]], 1)
        listed = zip(rows["pair"].tolist(), rows["faces"].tolist(), segments, rows["normal"])
        contacts = [ContactData(names[k], f, segment, n, depths[k], ways[k]) for k, f, segment, n in listed]
        nested = hit[result.count[hit] == 0]
        deep: Any = scene.intersect(pairs[nested], "distance", signed=True) if len(nested) else None
        for row, k in enumerate(nested.tolist()):
            points, deepest = deep.points[row], -deep.distance[row]
            # Whichever of the two is inside, it points as the second object leaves.
            normal, faces = (points[0] - points[1]) / deepest, deep.point_faces[row].tolist()
            contacts.append(ContactData(names[k], faces, points, normal, depths[k], ways[k]))
        return bool(len(hit)), [names[k] for k in hit.tolist()], contacts

    def _nearest(self, pairs, names):
        """Return the least distance of pairs, the names of the nearest pair, and a `DistanceData`."""
        if not len(pairs):
            return math.inf, None, None
        placed = self._placed
        placed.upload()
        gaps = placed.gaps(pairs)
        k = likely = placed.find_likely(pairs, gaps)
        result = placed.scene.intersect(pairs[[likely]], "distance")
        distance, row = float(result.distance[0]), 0
        # Of the others, what is proved farther than that is not searched to its end.
        others = np.flatnonzero(gaps <= distance)
        others = others[others != likely]
        if distance > 0 and len(others):
            beyond = distance if distance < math.inf else None
            rest = placed.scene.intersect(pairs[others], "distance", beyond=beyond)
            if rest.distance.min() < distance:
                result, row = rest, int(rest.distance.argmin())
                k, distance = int(others[row]), float(rest.distance[row])
        overlapping = np.flatnonzero(gaps == 0)
        if distance == 0 and placed.scene.batch().has_solid(pairs[overlapping]):
            result = placed.scene.intersect(pairs[overlapping], "distance", signed=True)
            row = int(result.distance.argmin())
            k, distance = int(overlapping[row]), float(result.distance[row])
        faces, points = result.point_faces[row].tolist(), result.points[row]
        return distance, names(k), DistanceData(names(k), faces, points, distance)
