"""Geometry of a scene at one time, as arrays in the world, which the viewer sends to the browser and pictures draw."""

from functools import cached_property

import numpy as np

from warp_abtree.app.cli.model_commands import diagonal_of
from warp_abtree.app.styles import COLOURS
from warp_abtree.checks.quaternions import matrices_of
from warp_abtree.query.stages.points import ManifoldQuery
from warp_abtree.scene.scene import Scene

LIFT = 1.5e-3  # of a model's diagonal: offset of intersecting faces from the mesh, to both sides
COARSE, FINE = np.array((0.16, 0.24, 0.60)), np.array((0.94, 0.90, 0.84))  # LODs; far from all intersecting faces
FEW_OBJECTS = 12  # all pairs of which have distances drawn
CONTACT_GAP = 2.0**-9  # of the smallest model's diagonal: contact points of faces nearer than that
NO_SEGMENTS = np.empty((0, 2, 3)), np.empty(0)
CERTIFIED_FACES = 300_000  # of models whose errors are certified to be told, which takes seconds
CACHED_FACES = 4_000_000  # that a cache of meshes keeps


def place(poses, objects, points) -> np.ndarray:
    """Return points (t, k, 3) of objects (t,) in the world."""
    turn = matrices_of(poses[:, 3:])[objects]
    return np.einsum("tij,tkj->tki", turn, points) + poses[objects, None, :3]


class MeshCache:
    """Meshes of a scene's models at LODs; the least recently used are dropped when there are too many faces."""

    def __init__(self, scene: Scene):
        self.scene = scene
        self._kept: dict = {}
        self._faces = 0
        self.diagonals = [diagonal_of(model) for model in scene.models]

    @cached_property
    def contact_query(self) -> ManifoldQuery:
        """The query of contact points, made when they are first shown."""
        return ManifoldQuery(self.scene, gap=CONTACT_GAP * min(self.diagonals))

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


def object_colours(scene: Scene, lods, by_lod=False) -> np.ndarray:
    """Return the colour of every object, uint8 (n, 3): its model's, or its LOD's."""
    model = np.array(scene.object_model)
    if by_lod:
        # The cube root spreads the coarse LODs, where most changes happen.
        part = np.cbrt(lods / np.maximum(np.array([m.lod_max for m in scene.models])[model], 1))[:, None]
        colours = COARSE + part * (FINE - COARSE)
    else:
        colours = np.array([COLOURS[i % len(COLOURS)][0] for i in range(len(scene.models))])[model]
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
        found_at = np.searchsorted(face_ids, rows[:, 1]).clip(max=len(face_ids) - 1)
        if not np.array_equal(face_ids[found_at], rows[:, 1]):
            raise ValueError("result: has faces that are not there at the objects' LODs")
        corners = place(snapshot.poses, rows[:, 0], vertices[faces[found_at]])
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        step = (LIFT * cache.diagonals[owner] * normal / np.where(length > 0, length, 1.0))[:, None]
        corners = np.concatenate([corners + step, corners - step])
        found.setdefault(owner, []).append(corners.astype(np.float32))
    return {owner: np.concatenate(parts) for owner, parts in found.items()}


def nearest_points(scene: Scene, shown, result) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest points of shown object pairs that are apart, (k, 2, 3), and their distances, (k,).

    Of a few objects these are all pairs, of more those whose boxes overlap, which the result has. Waits for the device.
    """
    if len(shown) <= FEW_OBJECTS:
        pairs = shown[np.stack(np.triu_indices(len(shown), 1), 1)]
    else:
        pairs = result.pairs[np.isin(result.pairs, shown).all(axis=1)]
    if not len(pairs):
        return NO_SEGMENTS
    found = scene.intersect(pairs, output="distance")
    apart = found.distance > 0
    return found.points[apart], found.distance[apart]


def contact_points(cache: MeshCache, shown) -> np.ndarray:
    """Return the contact points of pairs of shown objects, float64 (k, 3). Waits for the device."""
    cache.contact_query.grow()
    found = cache.contact_query.result()
    of_shown = np.isin(found.pairs, shown)[found.points["pair"]]
    return found.points["point"][of_shown.all(axis=1)]


# Corners of a box, as bits for x, y and z, at the ends of its edges.
EDGES = np.array([(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit])


def tree_boxes(scene: Scene, snapshot, i: int, level: int) -> np.ndarray:
    """Return the edges of the boxes of the active nodes at a level of object i's AB-Tree, in the world, (k, 2, 3).

    Level 0 is the root. Waits for the device.
    """
    state = scene.tree_state(i)
    nodes = np.arange(2**level, min(2 ** (level + 1), len(state.status)))
    nodes = nodes[state.status[nodes] != 0]
    upper = (np.arange(8)[:, None] >> np.arange(3) & 1).astype(bool)
    corners = np.where(upper, state.upper[nodes, None], state.lower[nodes, None])
    return place(snapshot.poses, np.full(len(nodes), i), corners)[:, EDGES].reshape(-1, 2, 3)


def bounds(cache: MeshCache, snapshot, shown) -> tuple[np.ndarray, float]:
    """Return the centre and radius of a ball around the shown objects [units]."""
    model = np.array(cache.scene.object_model)[shown]
    centres = np.array([m.centre for m in cache.scene.models])[model]
    points = place(snapshot.poses, shown, centres[:, None])[:, 0]
    reach = 0.5 * np.array(cache.diagonals)[model]
    lower, upper = (points - reach[:, None]).min(axis=0), (points + reach[:, None]).max(axis=0)
    centre = 0.5 * (lower + upper)
    return centre, float((np.linalg.norm(points - centre, axis=1) + reach).max()) or 1.0
