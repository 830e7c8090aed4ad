"""CollisionManager: the calls of trimesh.collision.CollisionManager, answered exactly and in batches."""

import math
from contextlib import contextmanager

import numpy as np

from warp_abtree.checks.arguments import to_numpy
from warp_abtree.interop.convex_solid import Shape, shape_of
from warp_abtree.interop.nearest import find_nearest
from warp_abtree.scene.poses import check_poses
from warp_abtree.scene.scene import Scene

EXTERNAL = "__external"  # the name that trimesh gives to what is not in the manager
# Places of objects that went are kept for others of the same mesh, so many or as many as there are objects.
SPARE_LEAST = 16
# Pairs asked first where one that collides is enough.
FIRST_PAIRS = 64
# Pairs whose corners are compared at a time.
CHUNK = 2**16


class ContactData:
    """One contact, as trimesh.collision.ContactData.

    Attributes:
        names: The two objects, a set.
        point: On the faces of both [world units], float64 (3,): the middle of the segment that they share.
        normal: Unit, from the pair's first object to its second, float64 (3,).
        depth: Estimate of the depth of the whole pair (see `warp_abtree.query.contacts`) [world units].
        segment: Ends of the segment that the faces share, float64 (2, 3).
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
        """Return the face of the named object, as its mesh numbers them."""
        return self._faces[name]


class DistanceData:
    """The nearest points of two objects, as trimesh.collision.DistanceData.

    Attributes:
        names: The two objects, a set.
        distance: Between them [world units]; 0 where they meet.
    """

    __slots__ = ("_faces", "_points", "distance", "names")

    def __init__(self, names, faces, points, distance):
        self.names = set(names)
        self._faces = dict(zip(names, faces))
        self._points = dict(zip(names, points))
        self.distance = distance

    def index(self, name) -> int:
        """Return the nearest face of the named object, as its mesh numbers them."""
        return self._faces[name]

    def point(self, name) -> np.ndarray:
        """Return the nearest point of the named object [world units], float64 (3,)."""
        return self._points[name]


class CollisionManager:
    """Named, posed meshes, asked for collisions one call at a time; the calls of trimesh.collision.CollisionManager.

    What is the same: names, signatures, shapes of what is returned, and that convex meshes are solids while others are
    surfaces. What differs:

    * Answers are exact for the poses given (FCL rounds those of `add_object` to float32, and finds convex meshes by an
      iteration). Touching counts. That a surface lies wholly inside a convex mesh is decided in float64.
    * A contact is a pair of faces that meet, with indices, also of convex meshes. Its depth is an estimate for the pair
      of objects. Where a part lies inside a convex mesh there is one contact: the deepest of the part's outermost
      corners, with its distance to the nearest face's plane and that face.
    * Distances are never negative: 0 where objects meet, infinite where there are none. They are least distances to the
      rounding of coordinates, of convex meshes too.
    * Transforms have to be rigid within 1e-6; an object of the same name is replaced; `add_object` returns nothing.

    Costs: a mesh is prepared once for all managers, by its content. The first question after an `add_object` of a mesh
    for which there is no place left prepares all models on the device again; so does the first `in_collision_single`
    of a new mesh, and `in_collision_other` of new meshes. Later ones, moves, and removals only send poses. An object
    that went leaves a place for one of the same mesh; when places left outnumber objects, and 16, they are given up.

    Args:
        device: Warp device, such as "cpu" or "cuda:0"; None for Warp's default.
        convex_solids: False takes convex meshes as surfaces too: what lies inside does not collide.

    Raises:
        ValueError: No such device on this machine.
    """

    def __init__(self, device=None, convex_solids=True):
        self._convex_solids = bool(convex_solids)
        self._slots: dict = {}
        self._start(Scene(device))

    def _start(self, scene):
        self._scene = scene
        self._shapes: list[Shape] = []
        self._spare: dict[Shape, list[int]] = {}
        self._poses = np.tile(np.eye(4), (8, 1, 1))
        self._moved = False

    @property
    def device(self):
        """Warp device that answers."""
        return self._scene.device

    # Places.

    def _take_slot(self, shape, matrix) -> int:
        spare = self._spare.get(shape)
        if spare:
            slot = spare.pop()
        else:
            slot = self._scene.object_count
            if slot == len(self._poses):
                self._poses = np.concatenate([self._poses, np.tile(np.eye(4), (slot, 1, 1))])
            # First, so that an interruption leaves no object without a shape.
            self._shapes[slot:] = [shape]
            self._scene.add(shape.model, matrix)
        self._poses[slot] = matrix
        self._moved = True
        return slot

    def _leave_slot(self, slot):
        self._spare.setdefault(self._shapes[slot], []).append(slot)

    def _give_up_spare(self):
        """Make the scene anew where more places are left than taken."""
        spare = sum(map(len, self._spare.values()))
        if spare <= max(SPARE_LEAST, len(self._slots)):
            return
        kept = [(name, self._shapes[slot], self._poses[slot]) for name, slot in self._slots.items()]
        self._start(Scene(self.device))
        self._slots = {name: self._take_slot(shape, matrix) for name, shape, matrix in kept}

    @contextmanager
    def _guests(self, placed):
        """Give places to (shape, matrix) for the time of a question."""
        slots = []
        try:
            for shape, matrix in placed:
                slots.append(self._take_slot(shape, matrix))
            yield np.array(slots, np.int32)
        finally:
            for slot in slots:
                self._leave_slot(slot)
            self._give_up_spare()

    def _slot(self, name) -> int:
        if name not in self._slots:
            raise ValueError(f"{name} not in collision manager!")
        return self._slots[name]

    @staticmethod
    def _matrix(transform, name):
        matrix = np.eye(4) if transform is None else to_numpy(transform, f"transform of {name!r}")
        if matrix.shape != (4, 4):
            raise ValueError(f"transform of {name!r}: shape {matrix.shape}, not (4, 4)")
        return check_poses(matrix[None], f"transform of {name!r}")[0]

    # Objects.

    def add_object(self, name, mesh, transform=None):
        """Add an object, in the place of the one of that name if there is one.

        Args:
            name: Anything that can be a key; sortable where pairs of names are asked.
            mesh: trimesh.Trimesh, or a `Model`, taken at its finest LOD.
            transform: Rigid, (4, 4) [world units]; None is the identity.

        Raises:
            MeshError: The mesh cannot be used.
            ValueError: The transform is not rigid within 1e-6; nothing is changed.
        """
        matrix, shape = self._matrix(transform, name), shape_of(mesh)
        if name in self._slots:
            self.remove_object(name)
        self._slots[name] = self._take_slot(shape, matrix)

    def remove_object(self, name):
        """Remove an object.

        Raises:
            ValueError: No object has this name.
        """
        self._leave_slot(self._slot(name))
        del self._slots[name]
        self._give_up_spare()

    def set_transform(self, name, transform):
        """Place an object anew: transform (4, 4) [world units], rigid.

        Raises:
            ValueError: No object has this name, or the transform is not rigid within 1e-6; nothing is changed.
        """
        slot = self._slot(name)
        self._poses[slot] = self._matrix(transform, name)
        self._moved = True

    # Collisions.

    def in_collision_single(self, mesh, transform=None, return_names=False, return_data=False):
        """Ask which objects a mesh collides with that is not among them. Waits for the device.

        Args:
            mesh, transform: As for `add_object`.
            return_names: Return the names of the objects hit too, a set.
            return_data: Return the contacts too, a list of `ContactData`; the mesh's name there is "__external".

        Returns:
            Whether it collides, alone or first of a tuple.
        """
        with self._guests([(shape_of(mesh), self._matrix(transform, EXTERNAL))]) as guests:
            names, live = self._live()
            pairs = np.stack([live, np.full(len(live), guests[0])], 1)
            pairs, kept = self._overlapping(pairs)
            asked = return_names or return_data
            found = self._collide(pairs, [(names[k], EXTERNAL) for k in kept], return_data, not asked)
        return self._answer(found, {first for first, _ in found[1]}, return_names, return_data)

    def in_collision_internal(self, return_names=False, return_data=False):
        """Ask which objects collide with one another. Waits for the device.

        Args:
            return_names: Return the pairs of names too, a set of tuples, each in alphabetical order.
            return_data: Return the contacts too, a list of `ContactData`.

        Returns:
            Whether any collide, alone or first of a tuple.
        """
        name_of = {slot: name for name, slot in self._slots.items()}
        self._place()
        pairs = self._scene.broad_phase() if len(name_of) > 1 else np.empty((0, 2), np.int32)
        live = np.zeros(self._scene.object_count, bool)
        live[list(name_of)] = True
        pairs = pairs[live[pairs].all(1)]
        named = [(name_of[i], name_of[j]) for i, j in pairs.tolist()]
        found = self._collide(pairs, named, return_data, not (return_names or return_data))
        return self._answer(found, {tuple(sorted(names)) for names in found[1]}, return_names, return_data)

    def in_collision_other(self, other_manager, return_names=False, return_data=False):
        """Ask which objects collide with those of another manager. Waits for the device.

        Args:
            other_manager: `CollisionManager`, of any device.
            return_names: Return the pairs of names too, a set of tuples (name here, name there).
            return_data: Return the contacts too, a list of `ContactData`.

        Returns:
            Whether any collide, alone or first of a tuple.

        Raises:
            TypeError: Not a `CollisionManager` of this library.
        """
        with self._others(other_manager) as (pairs, names):
            pairs, kept = self._overlapping(pairs)
            named = [names(k) for k in kept]
            found = self._collide(pairs, named, return_data, not (return_names or return_data))
        return self._answer(found, set(found[1]), return_names, return_data)

    # Distances.

    def min_distance_single(self, mesh, transform=None, return_name=False, return_data=False):
        """Ask how far a mesh is from the nearest object. Waits for the device.

        Args:
            mesh, transform: As for `add_object`.
            return_name: Return the nearest object's name too; None where there is none.
            return_data: Return a `DistanceData` too; None where there is none.

        Returns:
            Distance [world units], 0 where they collide, infinite without objects; alone or first of a tuple.
        """
        with self._guests([(shape_of(mesh), self._matrix(transform, EXTERNAL))]) as guests:
            names, live = self._live()
            pairs = np.stack([live, np.full(len(live), guests[0])], 1)
            distance, pair, data = self._nearest(pairs, lambda k: (names[k], EXTERNAL))
        name = None if pair is None else pair[0]
        return self._join(distance, (return_name, name), (return_data, data))

    def min_distance_internal(self, name=None, return_names=False, return_data=False):
        """Ask how far the nearest two objects are, or one from the others. Waits for the device.

        Args:
            name: The one; None for any.
            return_names: Return the two names too, a tuple in alphabetical order; None where there are no two.
            return_data: Return a `DistanceData` too; None where there are no two.

        Returns:
            Distance [world units], 0 where they collide, infinite without two objects; alone or first of a tuple.

        Raises:
            ValueError: No object has this name.
        """
        names, live = self._live()
        i, j = np.triu_indices(len(live), 1)
        if name is not None:
            slot = self._slot(name)
            own = (live[i] == slot) | (live[j] == slot)
            i, j = i[own], j[own]
        distance, pair, data = self._nearest(np.stack([live[i], live[j]], 1), lambda k: (names[i[k]], names[j[k]]))
        pair = None if pair is None else tuple(sorted(pair))
        return self._join(distance, (return_names, pair), (return_data, data))

    def min_distance_other(self, other_manager, return_names=False, return_data=False):
        """Ask how far the nearest object of another manager is from one here. Waits for the device.

        Args:
            other_manager: `CollisionManager`, of any device.
            return_names: Return the names too, a tuple (name here, name there); None where there are no two.
            return_data: Return a `DistanceData` too; None where there are no two.

        Returns:
            Distance [world units], 0 where they collide, infinite without two objects; alone or first of a tuple.

        Raises:
            TypeError: Not a `CollisionManager` of this library.
        """
        with self._others(other_manager) as (pairs, names):
            distance, pair, data = self._nearest(pairs, names)
        return self._join(distance, (return_names, pair), (return_data, data))

    # How they are found.

    @contextmanager
    def _others(self, other):
        """Give places to another manager's objects; yield pairs (here, there) and a function of a pair's names."""
        if not isinstance(other, CollisionManager):
            raise TypeError(f"other_manager is a {type(other).__name__}, not a warp_abtree.CollisionManager")
        there, theirs = other._live()
        with self._guests([(other._shapes[slot], other._poses[slot].copy()) for slot in theirs]) as guests:
            here, ours = self._live()
            pairs = np.stack([np.repeat(ours, len(guests)), np.tile(guests, len(ours))], 1)
            yield pairs, lambda k: (here[k // len(there)], there[k % len(there)])

    def _live(self):
        return list(self._slots), np.array(list(self._slots.values()), np.int32)

    def _place(self):
        """Bring poses to the device that changed since the last question."""
        if self._moved:
            self._scene.set_poses(self._poses[: self._scene.object_count])
            self._moved = False

    def _boxes(self):
        """Return middle and half extents of every object's box in the world, (n, 3) each, rounded outwards."""
        poses = self._poses[: len(self._shapes)]
        middle = np.array([shape.middle for shape in self._shapes]).reshape(-1, 3)
        half = np.array([shape.half for shape in self._shapes]).reshape(-1, 3)
        rotation, position = poses[:, :3, :3], poses[:, :3, 3]
        size = np.linalg.norm(middle, axis=1) + np.linalg.norm(half, axis=1)
        skew = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max((1, 2), initial=0)
        # Rounding of terms that may cancel, and of a frame that is off orthonormal, as in the broad phase.
        pad = 3 * skew * size + 1e-12 * (size + np.abs(position).max(1, initial=0))
        middle = np.einsum("nij,nj->ni", rotation, middle) + position
        half = np.einsum("nij,nj->ni", np.abs(rotation), half)
        return middle, half * (1 + 1e-9) + pad[:, None]

    def _gaps(self, pairs):
        """Return a distance that the boxes of each pair keep, (p,)."""
        middle, half = self._boxes()
        i, j = pairs.T
        return np.linalg.norm(np.maximum(np.abs(middle[i] - middle[j]) - half[i] - half[j], 0), axis=1)

    def _overlapping(self, pairs):
        kept = np.flatnonzero(self._gaps(pairs) == 0)
        return pairs[kept], kept

    def _collide(self, pairs, names, return_data, first_only=False):
        """Return whether any pair collides, names of those that do, and their contacts if asked.

        Args:
            first_only: Whether one that collides is enough.
        """
        if first_only and len(pairs) > FIRST_PAIRS:
            first = self._collide(pairs[:FIRST_PAIRS], names[:FIRST_PAIRS], return_data)
            return first if first[0] else self._collide(pairs[FIRST_PAIRS:], names[FIRST_PAIRS:], return_data)
        if not len(pairs):
            return False, [], []
        self._place()
        result = self._scene.intersect(pairs, output="contacts" if return_data else "any")
        inside = {}
        if self._convex_solids:
            apart = np.flatnonzero(~result.any)
            nested = apart[self._nested(pairs[apart])].tolist()
            inside = {k: self._inside(pairs[k, 0], pairs[k, 1], names[k]) for k in nested}
        hit = [k for k in range(len(pairs)) if result.any[k] or inside.get(k) is not None]
        contacts = []
        if return_data:
            rows = result.contacts
            segments = np.stack([rows["p0"], rows["p1"]], 1)
            depths = result.pair_contacts["depth"][rows["pair"]].tolist()
            for k, *of in zip(rows["pair"].tolist(), rows["faces"].tolist(), segments, rows["normal"], depths):
                contacts.append(ContactData(names[k], *of))
            contacts += [inside[k] for k in hit if not result.any[k]]
        return bool(hit), [names[k] for k in hit], contacts

    def _nested(self, pairs):
        """Return which pairs may hold a part of one inside the other: where its box holds a corner."""
        nested = np.zeros(len(pairs), bool)
        solid = np.array([shape.planes is not None for shape in self._shapes])
        middle = np.array([shape.middle for shape in self._shapes])
        half = np.array([shape.half for shape in self._shapes])
        several = np.array([len(shape.probes) > 6 for shape in self._shapes])
        # Of one part all corners are inside, so that the first one is; the parts of several are asked one by one.
        corner = np.array([shape.probes[0] for shape in self._shapes])
        for outer, inner in (pairs.T, pairs.T[::-1]):
            pose, posed = self._poses[outer], self._poses[inner]
            world = np.einsum("nij,nj->ni", posed[:, :3, :3], corner[inner]) + posed[:, :3, 3] - pose[:, :3, 3]
            local = np.einsum("nij,ni->nj", pose[:, :3, :3], world)
            held = (np.abs(local - middle[outer]) <= half[outer] * (1 + 1e-9)).all(1)
            nested |= solid[outer] & (held | several[inner])
        return nested

    def _inside(self, i, j, names):
        """Return the contact of two objects whose surfaces do not meet, where a part of one lies in the other."""
        for outer, inner in ((i, j), (j, i)):
            shape, other = self._shapes[outer], self._shapes[inner]
            found = shape.find_inside(self._poses[outer], other, self._poses[inner])
            if found is not None:
                point, normal, depth, face_outer, face_inner = found
                faces = (face_outer, face_inner) if outer == i else (face_inner, face_outer)
                normal = normal if outer == i else -normal
                return ContactData(names, faces, np.stack([point, point]), normal, depth)
        return None

    def _nearest(self, pairs, names):
        """Return the least distance of pairs, names of the pair that has it, and a `DistanceData`."""
        if not len(pairs):
            return math.inf, None, None
        self._place()
        gaps = self._gaps(pairs)
        meeting = np.flatnonzero(gaps == 0)
        _, _, contacts = self._collide(pairs[meeting], [(k, -1 - k) for k in meeting.tolist()], True)
        if contacts:
            contact = contacts[0]
            k = max(contact.names)
            faces = contact.index(k), contact.index(-1 - k)
            return 0.0, names(k), DistanceData(names(k), faces, (contact.point, contact.point), 0.0)
        upper, likely = self._upper_distance(pairs, gaps)
        kept = np.flatnonzero(gaps <= upper)
        distance, k, face_a, face_b, point_a, point_b = find_nearest(
            self._shapes, self._poses, pairs[kept], upper, int(np.searchsorted(kept, likely))
        )
        pair = names(int(kept[k]))
        return distance, pair, DistanceData(pair, (face_a, face_b), (point_a, point_b), distance)

    def _upper_distance(self, pairs, gaps):
        """Return a distance that one of the pairs does not exceed, that of two corners, and that pair's index."""
        corners = np.array([s.probes[:6] @ p[:3, :3].T + p[:3, 3] for s, p in zip(self._shapes, self._poses)])
        upper, likely = np.inf, 0
        for start in range(0, len(pairs), CHUNK):
            part = start + np.flatnonzero(gaps[start : start + CHUNK] <= upper)
            if len(part):
                i, j = pairs[part].T
                apart = np.linalg.norm(corners[i, :, None] - corners[j, None], axis=-1).min((1, 2))
                if apart.min() < upper:
                    upper, likely = float(apart.min()), int(part[apart.argmin()])
        return upper, likely

    # What is returned.

    def _answer(self, found, names, return_names, return_data):
        return self._join(found[0], (return_names, names), (return_data, found[2]))

    @staticmethod
    def _join(first, *rest):
        more = [value for asked, value in rest if asked]
        return (first, *more) if more else first
