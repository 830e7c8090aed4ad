"""Scenes from and to trimesh, glTF and USD."""

import hashlib
from pathlib import Path

import numpy as np

from warp_abtree.interop.usd import read_usd
from warp_abtree.model.files.found import FileSurface, Remarks
from warp_abtree.model.files.read import USD, read_file, split_file_name
from warp_abtree.model.mesh import MeshError, load_mesh
from warp_abtree.model.model import Model
from warp_abtree.query.result import Result
from warp_abtree.scene.posed_objects import expect_scene
from warp_abtree.scene.scene import Scene
from warp_abtree.state.poses import RIGID_TOLERANCE

# Stretches within this relative difference share a model.
STRETCH_TOLERANCE = 1e-9


class FileScene(Scene):
    """The scene of a file, which also unpacks as `scene, names`.

    That pair is what reading returned before objects had names; programs of then keep running. `scene.name(i)` is how
    to ask for a name.
    """

    def __getitem__(self, k):
        return (self, [self.name(i) for i in np.flatnonzero(self.present)])[k]


def scene_from_trimesh(source, device=None, base_faces=10, progress=None, solid=False, orient=False) -> FileScene:
    """Make a scene of a trimesh.Scene: every node that holds a mesh becomes an object of the node's name.

    Nodes of equal meshes share a model, whether of one geometry or of several. Of a transform that is not rigid, the
    stretch goes into the model, which nodes of equal stretch share. Points and paths are ignored.

    Args:
        source: trimesh.Scene.
        device: As for `Scene`.
        base_faces, progress, orient: As for `Model.load`.
        solid: Whether each object is a solid, as for `Scene.add`; "closed" makes solids of those whose mesh is closed.

    Raises:
        TypeError: source is no trimesh.Scene.
        ValueError: solid is neither a bool nor "closed".
        MeshError: A mesh cannot be used, a node's transform is singular or not affine, or there is no mesh; or the mesh
            of a node that is to be a solid is not closed. The message names the node.
    """
    import trimesh

    if not isinstance(source, trimesh.Scene):
        raise TypeError(f"source is a {type(source).__name__}, not a trimesh.Scene")
    if solid != "closed" and not isinstance(solid, bool | np.bool_):
        raise ValueError(f"solid {solid!r} is neither True nor False nor 'closed'")
    every = solid != "closed" and bool(solid)
    keys = {name: _mesh_hash(mesh) for name, mesh in source.geometry.items() if isinstance(mesh, trimesh.Trimesh)}
    placed = []
    for node in source.graph.nodes_geometry:
        transform, geometry = source.graph[node]
        if geometry in keys and len(source.geometry[geometry].faces):
            placed.append((node, geometry, *_split_transform(np.asarray(transform, np.float64), node)))
    if not placed:
        raise MeshError("there is no node with a mesh")
    scene, models = FileScene(device), dict[bytes, list]()
    names = _distinct(str(node) or "object" for node, *_ in placed)
    for name, (node, geometry, pose, stretch) in zip(names, placed):
        known = models.setdefault(keys[geometry], [])
        alike = (pair for pair in known if np.abs(pair[0] - stretch).max() <= STRETCH_TOLERANCE * np.abs(pair[0]).max())
        own, model = next(alike, (stretch, None))
        try:
            if model is None:
                stretched, matrix = trimesh.Scene(), np.eye(4)
                matrix[:3, :3] = stretch
                stretched.add_geometry(source.geometry[geometry], transform=matrix)
                mesh = load_mesh(stretched, name=str(geometry))
                model = Model.load(mesh, base_faces, progress, orient=orient)
                known.append((stretch, model))
            if own is not stretch and not (own == np.eye(3)).all():
                # The pose takes up the small difference of the two stretches.
                pose[:3, :3] = pose[:3, :3] @ stretch @ np.linalg.inv(own)
            scene.add(model, pose, solid=every or (solid == "closed" and model.winding.is_closed), name=name)
        except MeshError as error:
            raise MeshError(f"node {node!r}: {error}") from None
    return scene


def _mesh_hash(mesh) -> bytes:
    """Return a hash of the vertices and faces of a trimesh.Trimesh."""
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    return hashlib.blake2b(vertices.tobytes() + faces.tobytes(), digest_size=32).digest()


def _distinct(names) -> list[str]:
    """Return names with a suffix to those that repeat."""
    from trimesh.util import unique_name

    seen, counts = dict[str, None](), {}
    for name in names:
        seen[unique_name(name, seen, counts)] = None
    return list(seen)


def _split_transform(transform, node):
    """Split an affine transform into a rigid matrix and a symmetric stretch (3, 3), which has the mirror if any."""
    linear = transform[:3, :3]
    if not np.isfinite(transform).all() or np.abs(transform[3] - [0, 0, 0, 1]).max() > 0:
        raise MeshError(f"node {node!r}: its transform is not finite and affine")
    pose = transform.copy()
    if np.abs(linear.T @ linear - np.eye(3)).max() <= RIGID_TOLERANCE and np.linalg.det(linear) > 0:
        return pose, np.eye(3)
    left, sizes, right = np.linalg.svd(linear)
    if not sizes[-1] > 1e-12 * sizes[0]:
        raise MeshError(f"node {node!r}: its transform is singular")
    sign = np.sign(np.linalg.det(left @ right))
    pose[:3, :3] = sign * left @ right
    return pose, sign * right.T @ np.diag(sizes) @ right


def scene_from_file(path, device=None, base_faces=10, progress=None, solid=False, orient=False) -> FileScene:
    """Make a scene of a file: every node that holds a mesh becomes an object, equal meshes share a model.

    Args:
        path: GLB, glTF, 3MF, STEP (extra `cad`, in millimetres) or another format that `Model.load` reads; USD (extra
            `usd`), at the stage's first time. All in the file's units and axes. A node is one object whatever its
            number of materials. Of OBJ each `o` line begins an object, `g` and `usemtl` do not; of STL, each solid is
            one. Objects of USD are its visible meshes and basic shapes of default or render purpose, including
            instances and those of point instancers. Cubes and planes are exact; spheres (5,120 faces), cylinders, cones
            and capsules (64 sections) lie within 0.002 of their radius inside. A warning names what is left out, such
            as invisible prims, guides, proxies, points and lines, and what is taken at rest or not subdivided.
        device, base_faces, progress, solid, orient: As for `scene_from_trimesh`.

    Returns:
        The scene, whose objects are named by the node, the `o` line, or the file; in USD by the prim's path. A name
        that repeats gets a suffix.

    Raises:
        MeshError: The file is missing or cannot be read, or as for `load_mesh` and `scene_from_trimesh`.
        ValueError: As for `scene_from_trimesh`.
    """
    path, remarks = Path(path), Remarks()
    source = _read_objects(path, remarks)
    try:
        made = scene_from_trimesh(source, device, base_faces, progress, solid, orient)
    except MeshError as error:
        raise MeshError(f"{path}: {error}" + (f" ({remarks})" if str(remarks) else "")) from None
    remarks.warn(path)
    return made


def _read_objects(path: Path, remarks):
    """Return what a file holds as a trimesh.Scene."""
    name, kind, _ = split_file_name(path)
    found = read_usd(path, remarks) if kind in USD and path.is_file() else read_file(path, remarks)
    return found.as_scene(name) if isinstance(found, FileSurface) else found


def is_assembly(path, readable=False) -> bool:
    """Return whether a file is a scene of its own: of several objects, or USD, of which `Model.load` reads no mesh.

    One that cannot be read is none; or MeshError is raised, where it has to be readable.
    """
    try:
        count = len(_read_objects(Path(path), Remarks()).graph.nodes_geometry)
    except MeshError:
        if readable:
            raise
        return False
    return count > (0 if split_file_name(Path(path))[1] in USD else 1)


def to_trimesh(scene, result=None, names=None, world=None, hit_colour=(214, 39, 40), colour=(176, 176, 176)):
    """Return a scene as a trimesh.Scene, with the meshes at their LODs and poses. Waits for the device.

    `to_trimesh(scene, result).export("hits.glb")` writes a file for viewers of glTF.

    Args:
        scene: `Scene`.
        result: `Result` of the scene at its poses: intersecting faces are coloured, or whole objects if it has none.
        names: Node name of each object, n different strings; by default those of the scene, a suffix to what repeats.
        world: Include only objects of this world and those in every world.
        hit_colour, colour: Red, green, blue, 0 to 255, of intersecting faces or objects and of the rest.

    Raises:
        ValueError: names are not n different strings, or the result names objects that the scene does not have.
    """
    import trimesh

    count, present = expect_scene(scene).object_count, np.flatnonzero(scene.present).tolist()
    if names is None:
        node = dict(zip(present, _distinct(map(scene.name, present))))
    else:
        node = dict(enumerate(names))
        if len(node) != count or len(set(node.values())) != count or not all(isinstance(n, str) for n in node.values()):
            raise ValueError(f"names: not {count} different strings")
    if result is not None and not isinstance(result, Result):
        raise TypeError(f"result: a Result is expected, not a {type(result).__name__}")
    if result is not None and len(result.pairs) and int(result.pairs.max()) >= count:
        raise ValueError(f"result: asks object {int(result.pairs.max())}, the scene has {count}")
    hit = {} if result is None else _intersecting_faces(result)
    objects = scene.batch().objects.pool
    worlds, rotation, position = objects.world.numpy(), objects.rotation.numpy(), objects.position.numpy()
    # The frame of all others is no object's.
    made = trimesh.Scene(base_frame=_distinct([*node.values(), "world"])[-1])
    for i in present:
        if world is not None and worlds[i] not in (world, -1):
            continue
        model, lod = scene.models[scene.object_model[i]], int(scene.lods[i])
        vertices, faces, face_ids = model.mesh_at(lod)
        geometry = f"model {scene.object_model[i]} {model.name} at LOD {lod}"
        colours = np.tile(colour, (len(vertices), 1))
        if i in hit:
            red = np.isin(face_ids, hit[i]) if hit[i] is not None else np.ones(len(faces), bool)
            # glTF has colours per vertex: faces of two colours must not share any.
            vertices, faces = vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
            geometry, colours = f"{node[i]} hit", np.repeat(np.where(red[:, None], hit_colour, colour), 3, axis=0)
        if geometry not in made.geometry:
            colours = np.concatenate([colours, np.full((len(colours), 1), 255)], 1).astype(np.uint8)
            made.geometry[geometry] = trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation[i], position[i]
        made.graph.update(node[i], geometry=geometry, matrix=pose)
    return made


def _intersecting_faces(result):
    """Return the intersecting faces of each intersecting object, None for all of its faces."""
    if result.faces is None:
        return dict.fromkeys(result.pairs[result.any].ravel().tolist())
    objects, faces = result.pairs[result.faces[:, 0]], result.faces[:, 1:]
    return {i: np.unique(faces[objects == i]) for i in np.unique(objects).tolist()}
