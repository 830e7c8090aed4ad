"""Geometry of a scene at one time, as arrays in the world: intersecting faces, contacts, boxes of trees, bounds.

The viewer sends these arrays to the browser, and pictures draw them.
"""

import numpy as np

from warp_abtree.app.styles import COLOURS
from warp_abtree.checks.quaternions import matrices_of
from warp_abtree.scene.scene import Scene

LIFT = 1.5e-3  # of a model's diagonal: offset of intersecting faces from the mesh, to both sides
NORMAL = 0.1  # length of a normal, in diagonals of the median object shown
LINES = 20_000  # contacts drawn at most, spread evenly over all
BOXES = 4_000  # boxes of trees drawn at most
PICKED = (0.95, 0.50, 0.20)
COARSE, FINE = np.array((0.16, 0.24, 0.60)), np.array((1.0, 0.80, 0.20))
CACHED_FACES = 4_000_000  # that a cache of meshes keeps
# Corners of a box joined by its twelve edges; bit a of a corner's number says lower or upper along axis a.
EDGES = np.array([(c, c | bit) for c in range(8) for bit in (1, 2, 4) if not c & bit])


def place(poses, objects, points) -> np.ndarray:
    """Return points (t, k, 3) of objects (t,) in the world."""
    turn = matrices_of(poses[:, 3:])[objects]
    return np.einsum("tij,tkj->tki", turn, points) + poses[objects, None, :3]


class MeshCache:
    """Meshes of models at LODs; the least recently used are dropped when there are too many faces.

    Args:
        scene: `Scene`.
    """

    def __init__(self, scene: Scene):
        self.scene = scene
        self._kept: dict = {}
        self._faces = 0
        self.diagonals = []
        for model in scene.models:
            vertices = model.mesh_at(model.lod_max)[0]
            self.diagonals.append(float(np.linalg.norm(np.ptp(vertices, axis=0))))

    def mesh(self, model: int, lod: int):
        """Return vertices (v, 3), faces (f, 3) and face ids (f,), rising, of a model by index."""
        key = int(model), int(lod)
        found = self._kept.pop(key, None)
        if found is None:
            found = self.scene.models[key[0]].mesh_at(key[1])
            self._faces += len(found[1])
        self._kept[key] = found
        while self._faces > CACHED_FACES and len(self._kept) > 1:
            self._faces -= len(self._kept.pop(next(iter(self._kept)))[1])
        return found

    def count(self, model: int, lod: int) -> int:
        """Return the active faces of a model at a LOD."""
        return len(self.mesh(model, lod)[1])


def mesh_keys(scene: Scene, lods) -> np.ndarray:
    """Return one number for the model and LOD of each object, equal where they share a mesh, int64 (n,)."""
    return (np.array(scene.object_model, np.int64) << 32) + lods


def split_key(key) -> tuple[int, int]:
    """Return the model and LOD that a number of `mesh_keys` stands for."""
    return int(key) >> 32, int(key) & 0xFFFFFFFF


def group_objects(keys, objects) -> dict[int, np.ndarray]:
    """Return objects by their key, those of a key in their order; `keys` are of every object."""
    order = objects[np.argsort(keys[objects], kind="stable")]
    found, starts = np.unique(keys[order], return_index=True)
    return dict(zip(found.tolist(), np.split(order, starts[1:]))) if len(order) else {}


def object_colours(scene: Scene, lods, picked=None, by_lod=False) -> np.ndarray:
    """Return the colour of every object, uint8 (n, 3): its model's, or its LOD's; the picked one stands out."""
    model = np.array(scene.object_model)
    if by_lod:
        # The cube root spreads the coarse LODs, where most changes happen.
        part = np.cbrt(lods / np.maximum(np.array([m.lod_max for m in scene.models])[model], 1))[:, None]
        colours = COARSE + part * (FINE - COARSE)
    else:
        colours = np.array([COLOURS[i % len(COLOURS)][0] for i in range(len(scene.models))])[model]
    if picked is not None:
        colours[picked] = PICKED
    return np.round(255 * colours).astype(np.uint8)


# Results.


def intersecting_faces(result, shown) -> np.ndarray:
    """Return (object, face) of every intersecting face of pairs that are shown, each once, sorted, int64 (k, 2)."""
    faces, pairs = result.faces, result.pairs
    if faces is None or not len(faces):
        return np.empty((0, 2), np.int64)
    faces = faces[shown[pairs].all(axis=1)[faces[:, 0]]]
    objects = pairs[faces[:, 0]].astype(np.int64)
    keys = np.unique((objects << 32) + faces[:, 1:])
    return np.stack([keys >> 32, keys & 0xFFFFFFFF], axis=1)


def intersecting_triangles(cache: MeshCache, snapshot, intersecting) -> dict[int, np.ndarray]:
    """Return intersecting faces in the world by model, LIFT above each face and below it, float32 (t, 3, 3)."""
    found: dict[int, list] = {}
    keys = mesh_keys(cache.scene, snapshot.lods)[intersecting[:, 0]]
    for key, rows in group_objects(keys, np.arange(len(keys))).items():
        owner, lod = split_key(key)
        rows = intersecting[rows]
        vertices, faces, face_ids = cache.mesh(owner, lod)
        corners = place(snapshot.poses, rows[:, 0], vertices[faces[np.searchsorted(face_ids, rows[:, 1])]])
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        step = (LIFT * cache.diagonals[owner] * normal / np.where(length > 0, length, 1.0))[:, None]
        corners = np.concatenate([corners + step, corners - step])
        found.setdefault(owner, []).append(corners.astype(np.float32))
    return {owner: np.concatenate(parts) for owner, parts in found.items()}


def contact_lines(result, length, shown):
    """Return segments of contacts of shown pairs and their normals in the world, float32 (k, 2, 3) both."""
    contacts = result.contacts
    if contacts is None or not len(contacts):
        return np.empty((2, 0, 2, 3), np.float32)
    contacts = contacts[shown[result.pairs].all(axis=1)[contacts["pair"]]]
    if len(contacts) > LINES:
        contacts = contacts[np.linspace(0, len(contacts) - 1, LINES).astype(int)]
    p0, p1 = contacts["p0"], contacts["p1"]
    middle = 0.5 * (p0 + p1)
    segments = np.stack([p0, p1], axis=1)
    normals = np.stack([middle, middle + length * contacts["normal"]], axis=1)
    return segments.astype(np.float32), normals.astype(np.float32)


def normal_length(cache: MeshCache, shown) -> float:
    """Return how long normals are drawn [units]."""
    return NORMAL * float(np.median(np.array(cache.diagonals)[np.array(cache.scene.object_model)[shown]]))


# Trees.


def tree_depth(scene: Scene, objects) -> int:
    """Return the deepest level that the trees of objects have; the root is level 0."""
    nodes = max(scene.models[scene.object_model[i]].face_count for i in objects)
    return max(nodes - 1, 0).bit_length()


def level_boxes(tree, level: int) -> np.ndarray:
    """Return the boxes of the active nodes at a level of a `TreeState`, float64 (b, 2, 3), model frame."""
    nodes = slice(min(1 << level, len(tree.status)), min(2 << level, len(tree.status)))
    active = tree.status[nodes] != 0
    return np.stack([tree.lower[nodes][active], tree.upper[nodes][active]], axis=1)


def box_lines(boxes) -> np.ndarray:
    """Return the edges of boxes (b, 2, 3), float64 (12 b, 2, 3)."""
    corner = np.arange(8)
    corners = np.stack([boxes[:, (corner >> axis) & 1, axis] for axis in range(3)], axis=-1)
    return corners[:, EDGES].reshape(-1, 2, 3)


def tree_lines(scene: Scene, snapshot, objects, level: int):
    """Return the edges of the boxes of active nodes of some objects' trees in the world, and how many boxes there are.

    Objects that share a model and a LOD share a tree. At most BOXES are drawn, those of the first objects.

    Returns:
        float32 (12 b, 2, 3), and the number of boxes with those that are not drawn.
    """
    trees, lines, count = {}, [], 0
    for i in objects:
        key = scene.object_model[i], int(snapshot.lods[i])
        if key not in trees:
            trees[key] = level_boxes(scene.tree_state(int(i)), level)
        boxes = trees[key][: max(BOXES - count, 0)]
        count += len(trees[key])
        if len(boxes):
            edges = box_lines(boxes)
            lines.append(place(snapshot.poses, np.full(len(edges), i), edges))
    return np.concatenate(lines or [np.empty((0, 2, 3))]).astype(np.float32), count


def bounds(cache: MeshCache, snapshot, shown) -> tuple[np.ndarray, float]:
    """Return the centre and radius of a ball around the shown objects [units]."""
    model = np.array(cache.scene.object_model)[shown]
    centres = np.array([m.centre for m in cache.scene.models])[model]
    points = place(snapshot.poses, shown, centres[:, None])[:, 0]
    reach = 0.5 * np.array(cache.diagonals)[model]
    lower, upper = (points - reach[:, None]).min(axis=0), (points + reach[:, None]).max(axis=0)
    centre = 0.5 * (lower + upper)
    return centre, float((np.linalg.norm(points - centre, axis=1) + reach).max()) or 1.0
