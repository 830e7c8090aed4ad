"""What the host knows of a model's original mesh: its box, outermost corners, and the planes of a convex solid."""

import weakref

import numpy as np
import trimesh

from warp_abtree.interop.nearest import NodeBoxes
from warp_abtree.model.mesh import component_labels, load_mesh
from warp_abtree.model.model import Model


class Shape:
    """A model and what the host knows of its original mesh, float64, model frame.

    Attributes:
        model: `Model`.
        middle, half: Its box, (3,) each.
        probes: Corners farthest along each axis, both ways: (6 c, 3) of its c components.
        probe_faces: A face at each, (6 c,).
        planes: Outer unit normals and offsets of a convex solid's faces, and the faces, or None.
    """

    def __init__(self, model, convex):
        self.model = model
        self._node_boxes = None
        faces = np.delete(model.progressive.face_vertex, model.dropped_faces, axis=0)
        face_ids = np.delete(np.arange(model.face_count), model.dropped_faces)
        vertices = model.progressive.vertex_pos[: model.vertex_count]
        lower, upper = vertices.min(0), vertices.max(0)
        self.middle, self.half = lower / 2 + upper / 2, upper / 2 - lower / 2
        used = np.unique(faces)
        label = component_labels(faces, len(vertices))[used]
        probes = []
        for axis in range(3):
            order = used[np.lexsort((vertices[used, axis], label))]
            ends = np.flatnonzero(np.diff(np.sort(label))) + 1
            probes += [order[np.append(0, ends)], order[np.append(ends, len(used)) - 1]]
        found = np.concatenate(probes)
        face_at = np.zeros(len(vertices), np.int64)
        face_at[faces] = face_ids[:, None]
        self.probes, self.probe_faces = vertices[found], face_at[found]
        self.planes = None
        if convex:
            a, b, c = (vertices[faces[:, k]] for k in range(3))
            normals = np.cross(b - a, c - a)
            length = np.linalg.norm(normals, axis=1)
            wide = length > 0
            normals = normals[wide] / length[wide, None]
            self.planes = normals, np.einsum("ij,ij->i", normals, a[wide]), face_ids[wide]

    def node_boxes(self) -> NodeBoxes:
        """Return the boxes of the model's tree at its original mesh, made at the first use."""
        if self._node_boxes is None:
            self._node_boxes = NodeBoxes(self.model)
        return self._node_boxes

    def find_inside(self, pose, other, other_pose):
        """Find what of another shape lies inside this one, where it is a solid and the two surfaces do not meet.

        No corner of a part is inside where one is not, or the surfaces would meet; the deepest tells best.

        Args:
            pose, other_pose: Rigid (4, 4) matrices [world units].

        Returns:
            None, or the deepest probe of `other` [world units], the outer normal [world] of the plane nearest to it,
            its depth under that, that plane's face, and a face of `other` at the probe.
        """
        if self.planes is None:
            return None
        normals, offsets, face_ids = self.planes
        world = other.probes @ other_pose[:3, :3].T + (other_pose[:3, 3] - pose[:3, 3])
        local = world @ pose[:3, :3]
        near = np.flatnonzero((np.abs(local - self.middle) <= self.half).all(1))
        if not len(near):
            return None
        room = offsets - local[near] @ normals.T
        deepest = int(room.min(1).argmax())
        plane, probe = int(room[deepest].argmin()), near[deepest]
        depth = float(room[deepest, plane])
        if not depth > 0:
            return None
        normal = pose[:3, :3] @ normals[plane]
        return world[probe] + pose[:3, 3], normal, depth, int(face_ids[plane]), int(other.probe_faces[probe])


# Managers share the shapes of equal meshes, and so their models, as long as one of them holds any.
_SHAPES = weakref.WeakValueDictionary()


def shape_of(mesh) -> Shape:
    """Return the shape of a mesh's content, or of a model."""
    key: tuple | None = ("model", id(mesh)) if isinstance(mesh, Model) else None
    if isinstance(mesh, trimesh.Trimesh):
        key = (hash(mesh), len(mesh.vertices), len(mesh.faces))
    shape = None if key is None else _SHAPES.get(key)
    if shape is not None:
        return shape
    if isinstance(mesh, Model):
        vertices, faces, _ = mesh.mesh_at(mesh.lod_max)
        shape = Shape(mesh, is_convex(trimesh.Trimesh(vertices, faces, process=False)))
    else:
        source = load_mesh(mesh)
        # Only the original is asked, so no collapses are made.
        model = Model.load(source, base_faces=len(source.faces))
        shape = Shape(model, isinstance(mesh, trimesh.Trimesh) and is_convex(mesh))
    if key is not None:
        _SHAPES[key] = shape
    return shape


def is_convex(mesh) -> bool:
    """Return `mesh.is_convex` of trimesh, without the graph package that it takes."""
    if not mesh.is_watertight:
        return False
    faces = np.asarray(mesh.faces)
    if len(np.unique(component_labels(faces, len(mesh.vertices))[faces])) != 1:
        return False
    solid = (mesh.area_faces > trimesh.tol.zero)[mesh.face_adjacency].all(axis=1)
    bend = mesh.face_adjacency_projections[solid]
    return len(bend) > 0 and bool(bend.max() < trimesh.tol.planar * mesh.scale)
