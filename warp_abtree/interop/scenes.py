"""Poses from any array framework without copies; scenes from and to trimesh, glTF and USD."""

from pathlib import Path

import numpy as np
import trimesh
import warp as wp

from warp_abtree.checks.arguments import check_device, wrap_array
from warp_abtree.kernels import pipeline as kernels
from warp_abtree.model.mesh import MeshError, load_mesh, triangulate
from warp_abtree.model.model import Model
from warp_abtree.scene.poses import QUATERNION_TOLERANCE, RIGID_TOLERANCE
from warp_abtree.scene.scene import Scene
from warp_abtree.state.device_update import NO_FAULTS
from warp_abtree.state.generation import STALE_GRAPH, LaunchGuard

USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
# Two stretches that differ by this part are one.
STRETCH_TOLERANCE = 1e-9

# Poses.


class PoseInput:
    """Poses of a scene's objects from device memory, as an operator: nothing passes through the host.

    For `Query` and `ContactQuery` what `FrameGraph.poses` is for a frame. `launch()` only launches, so that a CUDA
    graph can capture it.

    Args:
        scene: `Scene` with all its objects.

    Attributes:
        poses: x y z qx qy qz qw [world units, unit quaternion], device float64 (n, 7); those of the scene at first.
            `wp.to_torch(poses)` and the like give views to write to.
    """

    def __init__(self, scene):
        check_device(scene.device, "making a PoseInput")
        self.scene = scene
        self.device = scene.device
        self._batch = scene.batch()
        self._guard = LaunchGuard(self.device, self._batch.objects.generation)
        count = scene.object_count
        self.poses = wp.empty((count, 7), dtype=wp.float64, device=self.device)
        self._faults = wp.array(NO_FAULTS, dtype=wp.int32, device=self.device)
        wp.launch(kernels.read_pose_kernel, count, [self._batch.objects.pool, self.poses], device=self.device)

    def launch(self, poses=None):
        """Place every object. Launches only.

        Args:
            poses: (n, 7) array of any framework on the scene's device, float64 (read where it lies) or float32 (copied
                to `poses` on the device); None reads what stands in `poses`. A graph keeps the address that it was
                captured with: capture `launch()`, and write to `poses`.

        Raises:
            ValueError: Another shape, type or device; nothing is changed.
            RuntimeError: Objects were added to the scene since this was made.
        """
        self._batch.check("pose input")
        check_device(self.device)
        with self._guard.launching(self):
            self._launch(poses)

    def _launch(self, poses):
        rows = self.poses if poses is None else self._check(wrap_array(poses, "poses"))
        if rows.dtype == wp.float32:
            wp.utils.array_cast(rows, self.poses)
            rows = self.poses
        inputs = [QUATERNION_TOLERANCE, rows, self._batch.objects.pool, self._faults, self._guard.record()]
        wp.launch(kernels.place_object_kernel, len(self.poses), inputs, device=self.device)

    def _check(self, rows):
        if rows.shape != self.poses.shape or rows.dtype not in (wp.float32, wp.float64):
            kind = getattr(rows.dtype, "__name__", rows.dtype)
            raise ValueError(
                f"poses: shape {tuple(rows.shape)} of {kind}, not {tuple(self.poses.shape)} of float32 or float64"
            )
        if rows.device != self.device:
            raise ValueError(f"poses: on {rows.device}, the scene is on {self.device}; Scene.set_poses copies them")
        return rows

    def check(self):
        """Raise what was wrong with poses since the last call. Waits for the device.

        Raises:
            ValueError: A pose was not finite, or a quaternion off unit length by more than 1e-3; its object kept the
                pose before.
            RuntimeError: Poses were set by a graph captured before objects were added to the scene; they are lost.
        """
        check_device(self.device, "PoseInput.check")
        stale = self._guard.launched.numpy()[1]
        if stale:
            self._guard.clear_stale()
            raise RuntimeError(f"poses since the last check are lost: the graph {STALE_GRAPH}")
        count, first = self._faults.numpy().tolist()
        self._faults.assign(np.array(NO_FAULTS, np.int32))
        if count:
            raise ValueError(
                f"poses: {count} rows since the last check were not finite or not of unit quaternions; the first "
                f"object that had one is {first}, and kept its pose"
            )


# Scenes in.


def scene_from_trimesh(source, device=None, base_faces=10, progress=None):
    """Make a scene of a trimesh.Scene: every node that holds a mesh becomes an object.

    Nodes of one geometry share a model. A transform that is not rigid is split: its stretch goes into the model, and
    nodes of one stretch share that. Points and paths are left out.

    Args:
        source: trimesh.Scene.
        device: As for `Scene`.
        base_faces, progress: As for `Model.load`.

    Returns:
        The `Scene`, and the node's name of each object, a list.

    Raises:
        TypeError: source is no trimesh.Scene.
        MeshError: A mesh cannot be used, a node's transform is singular or not affine, or there is no mesh.
    """
    if not isinstance(source, trimesh.Scene):
        raise TypeError(f"source is a {type(source).__name__}, not a trimesh.Scene")
    placed = []
    for node in source.graph.nodes_geometry:
        transform, geometry = source.graph[node]
        mesh = source.geometry[geometry]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            placed.append((str(node), geometry, mesh, *_split_transform(np.asarray(transform, np.float64), node)))
    if not placed:
        raise MeshError("the trimesh.Scene holds no node with a mesh")
    scene, names = Scene(device), []
    models: dict[str, list] = {}
    for node, geometry, mesh, pose, stretch in placed:
        known = models.setdefault(geometry, [])
        match = next(
            ((s, m) for s, m in known if np.abs(s - stretch).max() <= STRETCH_TOLERANCE * np.abs(s).max()), None
        )
        if match is None:
            model = Model.load(load_mesh(_stretched(mesh, stretch), name=str(geometry)), base_faces, progress)
            match = stretch, model
            known.append(match)
        if match[0] is not stretch and not (match[0] == np.eye(3)).all():
            # What the model's stretch differs by goes back into the pose.
            pose = pose.copy()
            pose[:3, :3] = pose[:3, :3] @ stretch @ np.linalg.inv(match[0])
        scene.add(match[1], pose)
        names.append(node)
    return scene, names


def _split_transform(transform, node):
    """Return a rigid matrix and a symmetric stretch (3, 3) whose product is an affine transform; mirrors stretch."""
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


def _stretched(mesh, stretch):
    if (stretch == np.eye(3)).all():
        return mesh
    faces = np.asarray(mesh.faces)
    # A mirrored surface keeps its outside.
    faces = faces if np.linalg.det(stretch) > 0 else faces[:, ::-1]
    return trimesh.Trimesh(np.asarray(mesh.vertices) @ stretch.T, faces, process=False)


def scene_from_file(path, device=None, base_faces=10, progress=None):
    """Make a scene of a file: every node that holds a mesh becomes an object, equal meshes share a model.

    Args:
        path: GLB or glTF, or whatever else trimesh reads; USD (extra `usd`), at the stage's first time, in the file's
            units and axes. Of USD, prims of type Mesh count, instances and those of point instancers included.
        device, base_faces, progress: As for `scene_from_trimesh`.

    Returns:
        The `Scene`, and the name of each object, a list: the node's, in USD the prim's path.

    Raises:
        MeshError: The file is missing or cannot be read, or as for `scene_from_trimesh`.
    """
    path = Path(path)
    if not path.is_file():
        raise MeshError(f"{path}: no such file")
    try:
        source = _read_usd(path) if path.suffix.lower() in USD_SUFFIXES else trimesh.load_scene(path, process=False)
    except MeshError:
        raise
    except Exception as error:  # trimesh's readers raise whatever goes wrong inside them
        raise MeshError(f"{path}: cannot be read: {str(error).splitlines()[0] if str(error) else error!r}") from None
    try:
        return scene_from_trimesh(source, device, base_faces, progress)
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from None


def _read_usd(path) -> trimesh.Scene:
    try:
        from pxr import Tf, Usd, UsdGeom
    except ImportError:
        raise MeshError(f"{path}: reading it needs usd-core: pip install warp-abtree[usd]") from None
    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise MeshError(f"{path}: cannot be read: {str(error).splitlines()[-1].strip()}") from None
    time = Usd.TimeCode(stage.GetStartTimeCode()) if stage.HasAuthoredTimeCodeRange() else Usd.TimeCode.EarliestTime()
    places = UsdGeom.XformCache(time)
    scene, known = trimesh.Scene(), {}

    def add(prim, name, transform):
        mesh = _usd_mesh(UsdGeom.Mesh(prim), time, f"{path}: {prim.GetPath()}")
        if mesh is not None:
            key = mesh.vertices.tobytes(), mesh.faces.tobytes()
            if key not in known:
                known[key] = str(prim.GetPath())
                scene.geometry[known[key]] = mesh
            scene.graph.update(name, geometry=known[key], matrix=np.array(transform).T)

    def visit(root, prefix, transform_of):
        prims = iter(Usd.PrimRange(root, Usd.TraverseInstanceProxies()))
        for prim in prims:
            if prim.IsA(UsdGeom.PointInstancer):
                prims.PruneChildren()
                spread(UsdGeom.PointInstancer(prim), prefix + str(prim.GetPath()), transform_of(prim))
            elif prim.IsA(UsdGeom.Mesh):
                add(prim, prefix + str(prim.GetPath()), transform_of(prim))

    def spread(instancer, prefix, base):
        targets = instancer.GetPrototypesRel().GetForwardedTargets()
        indices = instancer.GetProtoIndicesAttr().Get(time) or []
        ways = instancer.ComputeInstanceTransformsAtTime(time, time, UsdGeom.PointInstancer.IncludeProtoXform)
        for k, (index, way) in enumerate(zip(indices, ways)):
            prototype = stage.GetPrimAtPath(targets[index])
            root = places.GetLocalToWorldTransform(prototype).GetInverse()

            def posed(prim, root=root, way=way):
                return places.GetLocalToWorldTransform(prim) * root * way * base

            visit(prototype, f"{prefix}[{k}]", posed)

    visit(stage.GetPseudoRoot(), "", places.GetLocalToWorldTransform)
    return scene


def _usd_mesh(mesh, time, where):
    points, counts = mesh.GetPointsAttr().Get(time), mesh.GetFaceVertexCountsAttr().Get(time)
    if not points or not counts:
        return None
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get(time))
    counts = np.array(counts)
    if (counts < 3).any() or counts.sum() != len(corners):
        raise MeshError(f"{where}: its face counts do not fit its indices")
    vertices = np.array(points, np.float64)
    faces = triangulate(vertices, counts, corners, where)
    if mesh.GetOrientationAttr().Get(time) == "leftHanded":
        faces = faces[:, ::-1]
    return trimesh.Trimesh(vertices, faces, process=False)


# Scenes out.


def to_trimesh(scene, result=None, names=None, world=None, hit_colour=(214, 39, 40), colour=(176, 176, 176)):
    """Return a scene as a trimesh.Scene, meshes at their LODs where they stand. Waits for the device.

    `to_trimesh(scene, result).export("hits.glb")` writes what a viewer of glTF shows.

    Args:
        scene: `Scene`.
        result: `Result` of the scene as it stands: with faces, those that meet are coloured, else whole objects that
            do.
        names: Node of each object, n different strings; by default "object 0" and on.
        world: Leave out objects that are neither in this world nor in every one.
        hit_colour, colour: Red, green, blue, 0 to 255, of what meets and of the rest.

    Raises:
        ValueError: names are not n different strings, or the result names objects that the scene does not have.
    """
    count = scene.object_count
    names = [f"object {i}" for i in range(count)] if names is None else list(names)
    if len(names) != count or len(set(names)) != count or not all(isinstance(name, str) for name in names):
        raise ValueError(f"names: not {count} different strings")
    if result is not None and len(result.pairs) and int(result.pairs.max()) >= count:
        raise ValueError(f"result: asks object {int(result.pairs.max())}, the scene has {count}")
    hit = _faces_hit(scene, result)
    objects = scene.batch().objects.pool
    worlds = objects.world.numpy()
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = objects.rotation.numpy(), objects.position.numpy()
    made = trimesh.Scene()
    for i in range(count):
        if world is not None and worlds[i] not in (world, -1):
            continue
        model, lod = scene.models[scene.object_model[i]], int(scene.lods[i])
        vertices, faces, face_ids = model.mesh_at(lod)
        if i in hit:
            red = np.isin(face_ids, hit[i]) if hit[i] is not None else np.ones(len(faces), bool)
            # Colours of glTF belong to corners: faces of two colours share none.
            vertices, faces = vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
            colours = np.repeat(np.where(red[:, None], hit_colour, colour), 3, axis=0)
            geometry = f"{names[i]} hit"
        else:
            colours = np.tile(colour, (len(vertices), 1))
            geometry = f"model {scene.object_model[i]} {model.name} at LOD {lod}"
        if geometry not in made.geometry:
            colours = np.concatenate([colours, np.full((len(colours), 1), 255)], 1).astype(np.uint8)
            mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)
            made.add_geometry(mesh, node_name=names[i], geom_name=geometry, transform=poses[i])
        else:
            made.graph.update(names[i], geometry=geometry, matrix=poses[i])
    return made


def _faces_hit(scene, result):
    """Return the faces of each object that meet others, None for all of them; objects that meet none are missing."""
    if result is None:
        return {}
    if result.faces is None:
        return dict.fromkeys(result.pairs[result.any].ravel().tolist())
    pair = result.faces[:, 0]
    objects = np.concatenate([result.pairs[pair, 0], result.pairs[pair, 1]])
    faces = np.concatenate([result.faces[:, 1], result.faces[:, 2]])
    return {i: np.unique(faces[objects == i]) for i in np.unique(objects).tolist()}
