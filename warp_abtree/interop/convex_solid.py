"""A model's original mesh on the host: its box, extreme corners, and the planes of a convex solid."""

import weakref

import numpy as np

from warp_abtree.model.mesh import load_mesh
from warp_abtree.model.model import Model
from warp_abtree.model.winding import component_labels


class Shape:
    """A model and its original mesh on the host, float64, model frame.

    Attributes:
        model: `Model`.
        middle, half: Centre and half extents of its box, (3,) each.
        probes: Extreme corners of its c components along each axis in both directions, (6 c, 3).
        probe_faces: A face at each probe, (6 c,).
        planes: Outer unit normals and offsets of a convex solid's faces, and their indices, or None.
    """

    def __init__(self, model, convex):
        self.model = model
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

    def find_inside(self, pose, other, other_pose):
        """Find a component of another shape inside this solid; the two surfaces must not intersect.

        A component is then inside or outside as a whole, so its probes decide. Returns None, or the deepest probe of
        `other` [world units], the outer normal [world] of the nearest plane, the depth below that plane, its face, and
        a face of `other` at the probe.
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


# Shapes of equal meshes are shared by all managers while any of them uses one.
_SHAPES = weakref.WeakValueDictionary()


def shape_of(mesh) -> Shape:
    """Return the shape of a mesh, by content, or of a model."""
    import trimesh

    key: tuple = ("model", id(mesh))
    if isinstance(mesh, trimesh.Trimesh):
        key = (hash(mesh), len(mesh.vertices), len(mesh.faces))
    shape = _SHAPES.get(key)
    if shape is None:
        model, solid = mesh, mesh
        if isinstance(mesh, Model):
            vertices, faces, _ = mesh.mesh_at(mesh.lod_max)
            solid = trimesh.Trimesh(vertices, faces, process=False)
        else:
            source = load_mesh(mesh)
            # Only the finest LOD is used, so there is nothing to collapse.
            model = Model.load(source, base_faces=len(source.faces))
        shape = Shape(model, isinstance(solid, trimesh.Trimesh) and is_convex(solid))
        if isinstance(solid, trimesh.Trimesh):
            _SHAPES[key] = shape
    return shape


def is_convex(mesh) -> bool:
    """Return `mesh.is_convex` of trimesh, without the graph package that trimesh needs for it."""
    import trimesh

    if not mesh.is_watertight:
        return False
    faces = np.asarray(mesh.faces)
    if len(np.unique(component_labels(faces, len(mesh.vertices))[faces])) != 1:
        return False
    solid = (mesh.area_faces > trimesh.tol.zero)[mesh.face_adjacency].all(axis=1)
    bend = mesh.face_adjacency_projections[solid]
    return len(bend) > 0 and bool(bend.max() < trimesh.tol.planar * mesh.scale)
