"""Models of scene files: mesh files and generated shapes, brought to a size and a number of faces."""

import importlib.util
import math
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from warp_abtree.app.toml.errors import fail
from warp_abtree.app.toml.shapes import FACE_BOUNDS, GENERATED
from warp_abtree.checks.arguments import warn_caller
from warp_abtree.model.mesh import Mesh, load_mesh, mesh_from_arrays
from warp_abtree.model.model import Model

SCENE_FACE_LIMIT = 2**22  # of all models of a file that are generated; a face takes 1 KB while a model is built


def check_faces(path: Path, tables: dict):
    """Refuse models, `ModelTable`s by name, whose faces would exhaust the memory, before any is made.

    Counted are shapes, and meshes that are brought to a number of faces: SCENE_FACE_LIMIT together.
    """
    total = 0
    for name, table in tables.items():
        shape = table.__struct_config__.tag
        made = 0 if shape is None else FACE_BOUNDS[shape](**table.parameters())
        made = max(made, table.faces or 0)
        total += made
        if total > SCENE_FACE_LIMIT:
            among = "" if total == made else f", {total:,} with those of the models before"
            fail(path, f"models.{name}", f"asks for {made:,} faces{among}; a file may generate {SCENE_FACE_LIMIT:,}")


def build_model(path: Path, name: str, table, progress=None) -> Model:
    """Build the model that [models.NAME] describes; raise SceneError where its mesh is missing, bad or out of range."""
    mesh = _load(path, name, table)
    if mesh.parts > 1:
        about = f"the {mesh.parts} parts of {table.mesh} are joined into one mesh"
        warn_caller(f"{path}: models.{name}: {about}; scene_from_file makes an object of each", UserWarning)
    try:
        lower, upper = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        vertices = mesh.vertices - (lower / 2 + upper / 2) if table.centre else mesh.vertices
        factor = (table.scale or 1.0) if table.size is None else table.size / float((upper - lower).max())
        if table.centre or factor != 1.0:
            mesh = mesh_from_arrays(vertices * factor, mesh.faces, name=mesh.name)
        if table.faces is not None:
            mesh = _bring_to(mesh, table.faces, progress)
        return Model.load(mesh, table.base_faces, progress, orient=table.orient)
    except ValueError as error:
        fail(path, f"models.{name}", error)


def _load(path, name, table) -> Mesh:
    """Return the mesh of a file, or of the shape that stands in for it."""
    names = [] if table.mesh is None else [table.mesh] if isinstance(table.mesh, str) else table.mesh
    shape, source = table.__struct_config__.tag, None
    try:
        source = _find_source(names, path.parent, shape is not None)
        if source is not None:
            chosen = len(names) + (shape is not None) > 1
            return load_mesh(source, name=f"{name} ({getattr(source, 'name', source)})" if chosen else None)
        make: Any = GENERATED.get(shape) or getattr(trimesh.creation, shape)
        title = f"{name} ({'an' if shape[0] in 'aeiou' else 'a'} {shape})" if names else name
        return load_mesh(make(**table.parameters()), name=title)
    except OSError as error:  # a name that is too long
        fail(path, f"models.{name}.mesh", error.strerror)
    except (ValueError, TypeError) as error:
        fail(path, f"models.{name}.{'shape' if source is None else 'mesh'}", error)


def _find_source(names, folder, has_shape):
    """Return the first mesh that is found, else the last, or None where a shape stands in."""
    for name in names:
        if name.startswith("warp:"):
            if len(names) + has_shape == 1 or importlib.util.find_spec("pxr") is not None:
                return name
        elif (folder / name).is_file():
            return folder / name
    if has_shape or not names:
        return None
    return names[-1] if names[-1].startswith("warp:") else folder / names[-1]


def _bring_to(mesh, faces, progress):
    """Return a mesh of that many faces, or one less: smoothed by Loop subdivision if need be, then collapsed."""
    rounds = math.ceil(math.log(faces / len(mesh.faces), 4)) if len(mesh.faces) < faces else 0
    if rounds and len(mesh.faces) * 4**rounds > SCENE_FACE_LIMIT:
        most = len(mesh.faces) * 4 ** math.floor(math.log(SCENE_FACE_LIMIT / len(mesh.faces), 4))
        raise ValueError(f"faces: Loop subdivision of {len(mesh.faces):,} faces reaches {most:,} at most")
    vertices = mesh.vertices
    corners = np.delete(mesh.faces, mesh.dropped_faces, axis=0)
    if rounds:
        vertices, corners = trimesh.remesh.subdivide_loop(vertices, corners, iterations=rounds)
    model = Model.load(mesh_from_arrays(vertices, corners, name=mesh.name), base_faces=faces, progress=progress)
    vertices, corners, _ = model.mesh_at(0)
    return mesh_from_arrays(vertices, corners, name=mesh.name)
