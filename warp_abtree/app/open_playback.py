"""Opens what `view` and `picture` are given on the command line."""

from pathlib import Path

import numpy as np

from warp_abtree.app.cli.arguments import Parser, positive_count
from warp_abtree.app.cli.model_commands import load_models, lod_at
from warp_abtree.app.playback import MeshPlayback, Playback, ScenePlayback
from warp_abtree.app.toml.folder import find_scene
from warp_abtree.app.toml.scene_file import load_assembly, load_scene
from warp_abtree.interop.scenes import is_assembly
from warp_abtree.scene.scene import Scene

OVERLAP = 0.25  # of the smaller extent: by so much a mesh without a pose reaches into the one before


def open_playback(paths, device=None, progress=None, objects=None, poses=(), lod=None) -> Playback:
    """Open one scene file (.toml), one file of several objects, or meshes and built models (.npz).

    Poses (k, 7) are of the meshes after the first; those left out are laid beside the mesh before, a little inside.
    `lod` is of every mesh, None the finest; `objects` is for scene files alone, as for `load_scene`.
    """
    paths = [str(find_scene(path)) for path in paths]
    scenes = [path for path in paths if Path(path).suffix.lower() == ".toml"]
    if scenes and len(paths) > 1:
        raise ValueError(f"{scenes[0]}: a scene file is looked at alone")
    if objects is not None and not scenes:
        raise ValueError("--objects: for scene files")
    if not scenes and (len(paths) > 1 or not is_assembly(paths[0])):
        return _open_meshes(paths, device, progress, poses, lod)
    for name, value in (("--pose", len(poses)), ("--lod", lod is not None)):
        if value:
            raise ValueError(f"{name}: for meshes; {paths[0]} says where its objects are and at which LODs")
    if scenes:
        return ScenePlayback(load_scene(paths[0], device=device, progress=progress, objects=objects))
    return ScenePlayback(load_assembly(Path(paths[0]), device, progress))


def _open_meshes(paths, device, progress, poses, lod) -> MeshPlayback:
    if len(poses) >= len(paths):
        raise ValueError(f"--pose: {len(poses)} given for the {len(paths) - 1} meshes after the first")
    Scene(device=device)  # refuses a device that does not exist before models are built
    models = load_models(paths, progress)
    lods = [lod_at("--lod", model, "finest" if lod is None else lod) for model in models]
    places = row_poses(models)
    if len(poses):
        places[1 : 1 + len(poses)] = poses
    try:
        return MeshPlayback(models, places, lods, device)
    except ValueError as error:
        raise ValueError(f"--{error}") from None


def add_playback_arguments(sub: Parser):
    """Add the arguments that name what is shown."""
    about = "one scene file (.toml) or file of several objects, or meshes and built models (.npz)"
    sub.add_scene("source", nargs="+", metavar="SCENE_OR_MESHES", help=about)
    about = "pose of the second mesh, again for the third; without it each stands beside the one before, a bit inside"
    sub.add_pose(about, action="append", default=[])
    sub.add_argument("--lod", metavar="LOD", help="LOD of meshes, as for query (finest)")
    sub.add_number("--objects", "about so many objects of a scene, as for run", positive_count)


def row_poses(models) -> np.ndarray:
    """Return poses (n, 7) in a row along x, in which each model reaches a little into the one before."""
    places = np.zeros((len(models), 7))
    places[:, 6] = 1.0
    boxes = []
    for model in models:
        vertices = model.mesh_at(model.lod_max)[0]
        boxes.append((vertices.min(axis=0), vertices.max(axis=0)))
    middle = 0.5 * (boxes[0][0] + boxes[0][1])
    for i in range(1, len(models)):
        (before_lower, before_upper), (lower, upper) = boxes[i - 1], boxes[i]
        places[i, :3] = middle - 0.5 * (lower + upper)
        inside = OVERLAP * min(upper[0] - lower[0], before_upper[0] - before_lower[0])
        places[i, 0] = places[i - 1, 0] + before_upper[0] - inside - lower[0]
    return places
