"""Shapes of meshes, posed in one scene whose slots are reused, and bounds on their distances by their boxes."""

import weakref

import numpy as np

from warp_abtree.model.mesh import load_mesh
from warp_abtree.model.model import Model
from warp_abtree.scene.scene import Scene

FREE_SLOTS_KEPT = 16  # without an object, kept for others of the same mesh; or as many as there are objects
PAIRS_AT_ONCE = 2**16  # pairs whose corners are compared at a time


class Shape:
    """A model, and in its frame the centre and half extents of its box, (3,), and its extreme corners, (6, 3)."""

    def __init__(self, model):
        self.model = model
        self.is_closed = model.winding.is_closed
        vertices = model.winding.vertices[np.unique(model.winding.faces)]
        lower, upper = vertices.min(0), vertices.max(0)
        self.middle, self.half = lower / 2 + upper / 2, upper / 2 - lower / 2
        self.corners = vertices[np.concatenate([vertices.argmin(0), vertices.argmax(0)])]


# Shapes of equal meshes are shared by all managers while any of them uses one.
_SHAPES: weakref.WeakValueDictionary = weakref.WeakValueDictionary()


def shape_of(mesh, name) -> Shape:
    """Return the shape of a mesh, by content, or of a model; warnings call a mesh by the first name that it had."""
    import trimesh

    key: tuple = ("model", id(mesh))
    if isinstance(mesh, trimesh.Trimesh):
        key = (hash(mesh), len(mesh.vertices), len(mesh.faces))
    shape = _SHAPES.get(key)
    if shape is None:
        model = mesh
        if not isinstance(mesh, Model):
            source = load_mesh(mesh, str(name) if isinstance(mesh, trimesh.Trimesh) else None)
            # Only the finest LOD is used, so there is nothing to collapse.
            model = Model.load(source, base_faces=len(source.faces))
        shape = Shape(model)
        if isinstance(mesh, trimesh.Trimesh | Model):
            _SHAPES[key] = shape
    return shape


class PlacedShapes:
    """Posed shapes; the slot of a removed one is reused for the next of the same mesh: models stay on the device.

    Attributes:
        scene: `Scene` with one object per slot; closed shapes are solids where asked.
        shapes: `Shape` of each slot.
        poses: Matrix of each slot [world units], float64 (4, 4).
    """

    def __init__(self, device, solids: bool):
        self.scene, self._solids = Scene(device), solids
        self.shapes: list[Shape] = []
        self.poses: list[np.ndarray] = []
        self._free: dict[Shape, list[int]] = {}
        self._moved = False

    def add(self, shape, matrix) -> int:
        """Place a shape and return its slot."""
        if self._free.get(shape):
            slot = self._free[shape].pop()
        else:
            slot = self.scene.object_count
            # First, so that an interruption leaves no object without a shape.
            self.poses[slot:], self.shapes[slot:] = [matrix], [shape]
            self.scene.add(shape.model, matrix, solid=self._solids and shape.is_closed)
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
        return sum(map(len, self._free.values())) > max(FREE_SLOTS_KEPT, used)

    def upload(self):
        """Copy poses that have changed to the device."""
        if self._moved:
            self.scene.set_poses(np.array(self.poses[: self.scene.object_count]))
            self._moved = False

    def gaps(self, pairs):
        """Return a lower bound on the distance of each pair, that of their boxes, rounded outwards, (p,)."""
        poses = np.array(self.poses[: len(self.shapes)]).reshape(-1, 4, 4)
        middle, half = np.array([(shape.middle, shape.half) for shape in self.shapes]).reshape(-1, 2, 3).swapaxes(0, 1)
        rotation, position = poses[:, :3, :3], poses[:, :3, 3]
        size = np.linalg.norm(middle, axis=1) + np.linalg.norm(half, axis=1)
        skew = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max((1, 2), initial=0)
        # Rounding of terms that may cancel, and of a frame that is off orthonormal, as in the broad phase.
        skew *= 3
        pad = skew * size + 1e-12 * (size + np.abs(position).max(1, initial=0))
        middle = np.einsum("nij,nj->ni", rotation, middle) + position
        half = np.einsum("nij,nj->ni", np.abs(rotation), half)
        half = half + pad[:, None]
        i, j = pairs.T
        gaps = np.linalg.norm(np.maximum(np.abs(middle[i] - middle[j]) - half[i] - half[j], 0), axis=1)
        # Distances are those in the frame of either, which may be shorter.
        return gaps * (1 - np.maximum(skew[i], skew[j]))

    def find_likely(self, pairs, gaps) -> int:
        """Return the index of the pair that has the nearest corners, which bounds the least distance of all."""
        corners = np.array([s.corners @ p[:3, :3].T + p[:3, 3] for s, p in zip(self.shapes, self.poses)])
        upper, likely = np.inf, 0
        for start in range(0, len(pairs), PAIRS_AT_ONCE):
            part = start + np.flatnonzero(gaps[start : start + PAIRS_AT_ONCE] <= upper)
            if len(part):
                i, j = pairs[part].T
                apart = np.linalg.norm(corners[i, :, None] - corners[j, None], axis=-1).min((1, 2))
                if apart.min() < upper:
                    upper, likely = float(apart.min()), int(part[apart.argmin()])
        return likely
