"""Posed shapes in one scene whose slots are reused, and bounds on their distances by their boxes."""

import numpy as np

from warp_abtree.interop.collision_data import ContactData
from warp_abtree.interop.convex_solid import Shape
from warp_abtree.scene.scene import Scene

FREE_SLOTS = 16  # without an object, kept for others of the same mesh; or as many as there are objects
CHUNK = 2**16  # pairs whose corners are compared at a time


class PlacedShapes:
    """Posed shapes; the slot of a removed one is reused for the next of the same mesh: models stay on the device.

    Attributes:
        scene: `Scene` with one object per slot.
        shapes: `Shape` of each slot.
        poses: Matrices of the slots [world units], float64 (at least as many as slots, 4, 4).
    """

    def __init__(self, device):
        self.scene = Scene(device)
        self.shapes: list[Shape] = []
        self.poses = np.tile(np.eye(4), (8, 1, 1))
        self._free: dict[Shape, list[int]] = {}
        self._moved = False

    def add(self, shape, matrix) -> int:
        """Place a shape and return its slot."""
        if self._free.get(shape):
            slot = self._free[shape].pop()
        else:
            slot = self.scene.object_count
            if slot == len(self.poses):
                self.poses = np.concatenate([self.poses, np.tile(np.eye(4), (slot, 1, 1))])
            # First, so that an interruption leaves no object without a shape.
            self.shapes[slot:] = [shape]
            self.scene.add(shape.model, matrix)
        self.move(slot, matrix)
        return slot

    def move(self, slot, matrix):
        """Set the pose of a slot."""
        self.poses[slot] = matrix
        self._moved = True

    def remove(self, slot):
        """Free a slot."""
        self._free.setdefault(self.shapes[slot], []).append(slot)

    def has_too_many_free(self, used) -> bool:
        """Return whether more slots are free than are to be kept, with so many in use."""
        return sum(map(len, self._free.values())) > max(FREE_SLOTS, used)

    def upload(self):
        """Copy poses that have changed to the device."""
        if self._moved:
            self.scene.set_poses(self.poses[: self.scene.object_count])
            self._moved = False

    def _model_boxes(self):
        boxes = np.array([(shape.middle, shape.half) for shape in self.shapes]).reshape(-1, 2, 3)
        return boxes[:, 0], boxes[:, 1]

    def boxes(self):
        """Return centres and half extents of all boxes in the world, (n, 3) each, rounded outwards."""
        poses = self.poses[: len(self.shapes)]
        middle, half = self._model_boxes()
        rotation, position = poses[:, :3, :3], poses[:, :3, 3]
        size = np.linalg.norm(middle, axis=1) + np.linalg.norm(half, axis=1)
        skew = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max((1, 2), initial=0)
        # Rounding of terms that may cancel, and of a frame that is off orthonormal, as in the broad phase.
        pad = 3 * skew * size + 1e-12 * (size + np.abs(position).max(1, initial=0))
        middle = np.einsum("nij,nj->ni", rotation, middle) + position
        half = np.einsum("nij,nj->ni", np.abs(rotation), half)
        return middle, half * (1 + 1e-9) + pad[:, None]

    def gaps(self, pairs):
        """Return a lower bound on the distance of each pair, that of their boxes, (p,)."""
        middle, half = self.boxes()
        i, j = pairs.T
        return np.linalg.norm(np.maximum(np.abs(middle[i] - middle[j]) - half[i] - half[j], 0), axis=1)

    def upper_distance(self, pairs, gaps):
        """Return an upper bound on the least distance of all pairs, that of two corners, and the index of its pair."""
        corners = np.array([s.probes[:6] @ p[:3, :3].T + p[:3, 3] for s, p in zip(self.shapes, self.poses)])
        upper, likely = np.inf, 0
        for start in range(0, len(pairs), CHUNK):
            part = start + np.flatnonzero(gaps[start : start + CHUNK] <= upper)
            if len(part):
                i, j = pairs[part].T
                apart = np.linalg.norm(corners[i, :, None] - corners[j, None], axis=-1).min((1, 2))
                if apart.min() < upper:
                    upper, likely = float(apart.min()), int(part[apart.argmin()])
        return upper, likely

    def may_contain(self, pairs):
        """Return which pairs may have a component of one inside the other: a solid's box contains a corner of it."""
        nested = np.zeros(len(pairs), bool)
        if not len(pairs):
            return nested
        solid = np.array([shape.planes is not None for shape in self.shapes])
        if not solid.any():
            return nested
        middle, half = self._model_boxes()
        several = np.array([len(shape.probes) > 6 for shape in self.shapes])
        # A connected shape that is inside has its first corner inside; the components of others are tested later.
        corner = np.array([shape.probes[0] for shape in self.shapes])
        for outer, inner in (pairs.T, pairs.T[::-1]):
            pose, posed = self.poses[outer], self.poses[inner]
            world = np.einsum("nij,nj->ni", posed[:, :3, :3], corner[inner]) + posed[:, :3, 3] - pose[:, :3, 3]
            local = np.einsum("nij,ni->nj", pose[:, :3, :3], world)
            held = (np.abs(local - middle[outer]) <= half[outer] * (1 + 1e-9)).all(1)
            nested |= solid[outer] & (held | several[inner])
        return nested

    def find_contained(self, pair, names):
        """Return a `ContactData` if a component of one object is inside the other; surfaces must not intersect."""
        for outer, inner in (pair, pair[::-1]):
            found = self.shapes[outer].find_inside(self.poses[outer], self.shapes[inner], self.poses[inner])
            if found is not None:
                point, normal, depth, *faces = found
                if outer != pair[0]:
                    faces, normal = faces[::-1], -normal
                return ContactData(names, faces, np.stack([point, point]), normal, depth)
        return None
