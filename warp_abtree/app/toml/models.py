"""Models of scene files: mesh files and generated shapes, brought to a size and a number of faces."""

import importlib.util
import math
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from warp_abtree.app.toml.errors import fail
from warp_abtree.model.files.found import warn_caller
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


# Shapes that trimesh does not generate.


def _halve_quads(*corners) -> list[np.ndarray]:
    """Return the two triangles of each of some quadrangles a b c d, of which four arrays hold the vertices."""
    a, b, c, d = (array.ravel() for array in corners)
    return [np.stack([a, b, c], 1), np.stack([a, c, d], 1)]


def _wrap(points, closed):
    """Return a surface over a grid of rings: each is closed, and all are if `closed`, else ended by two poles.

    Args:
        points: Corners, float64 (rings, sections, 3); a ring runs counterclockwise as seen from the rings after it.
    """
    rings, sections, _ = points.shape
    i, j = np.meshgrid(np.arange(rings if closed else rings - 1), np.arange(sections), indexing="ij")
    here, there = i * sections, (i + 1) % rings * sections
    after = (j + 1) % sections
    faces = _halve_quads(here + j, here + after, there + after, there + j)
    vertices = [points.reshape(-1, 3)]
    if not closed:
        vertices += [points[0].mean(0)[None], points[-1].mean(0)[None]]
        first, last = rings * sections, rings * sections + 1
        own = np.arange(sections)
        turn = (own + 1) % sections
        faces.append(np.stack([np.full(sections, first), turn, own], 1))
        top = (rings - 1) * sections
        faces.append(np.stack([np.full(sections, last), top + own, top + turn], 1))
    return trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)


def knot(radius, tube_radius, sections):
    """Return a trefoil tube: (2, 3) torus knot."""
    u = np.linspace(0, 2 * np.pi, sections[0], endpoint=False)
    w = np.linspace(0, 2 * np.pi, sections[1], endpoint=False)
    r = np.cos(3 * u) + 2
    middle = np.stack([r * np.cos(2 * u), r * np.sin(2 * u), -np.sin(3 * u)], 1) * (radius / 3)
    along = np.roll(middle, -1, 0) - np.roll(middle, 1, 0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.cross(along, [0, 0, 1.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    ring = np.cos(w)[:, None] * side[:, None] + np.sin(w)[:, None] * np.cross(along, side)[:, None]
    return _wrap(middle[:, None] + tube_radius * ring, closed=True)


def terrain(extents, cells, bumps, waves, rim):
    """Return an open sheet, y upwards, whose bumps rise to the rim of a basin."""
    x, z = (np.linspace(-1, 1, n + 1) for n in cells)
    x, z = np.meshgrid(x, z, indexing="ij")
    y = bumps * np.sin(np.pi * waves * x) * np.cos(np.pi * waves * z) + rim * (x**6 + z**6)
    vertices = np.stack([x * extents[0] / 2, y, z * extents[1] / 2], -1).reshape(-1, 3)
    number = np.arange(len(vertices)).reshape(x.shape)
    faces = _halve_quads(number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1])
    return trimesh.Trimesh(vertices, np.concatenate(faces), process=False)


def _thread(height, turn, pitch):
    """Return the fraction of a thread's depth at a height and an angle: 0 at the crest, 1 at the root."""
    phase = height / pitch - turn / (2 * np.pi)
    return np.abs(2 * (phase - np.floor(phase)) - 1)


def _hexagon(turn, width):
    """Return the radius of a hexagon of a width across its flats."""
    return 0.5 * width / np.cos((turn + np.pi / 6) % (np.pi / 3) - np.pi / 6)


def _around(radius, height, turn):
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), np.broadcast_to(height, radius.shape)], -1)


def bolt(radius, length, pitch, head, sections):
    """Return a threaded rod along z with a hexagonal head on top; the thread is cut into `radius`."""
    turn = np.linspace(0, 2 * np.pi, sections[0], endpoint=False)[None]
    rows = np.linspace(0, length, sections[1])[:, None]
    rod = _around(radius - 0.5 * pitch * _thread(rows, turn, pitch), rows, turn)
    side = np.broadcast_to(_hexagon(turn, head), turn.shape)
    top = [_around(side, level, turn) for level in (length, length + 0.6 * radius)]
    return _wrap(np.concatenate([rod, *top]), closed=False)


def nut(radius, height, pitch, width, sections):
    """Return a hexagonal nut along z, whose thread of the same pitch lies around a bolt of that radius."""
    turn = np.linspace(0, 2 * np.pi, sections[0], endpoint=False)[None]
    rows = np.linspace(0, height, sections[1])[::-1, None]
    hole = _around(radius + 0.1 * pitch - 0.5 * pitch * _thread(rows, turn, pitch), rows, turn)
    side = [_around(np.broadcast_to(_hexagon(turn, width), turn.shape), level, turn) for level in (0.0, height)]
    return _wrap(np.concatenate([hole, *side]), closed=True)


def revolve(profile, sections):
    """Return a profile of points [radius, z], z rising, turned about z and closed by two poles."""
    radius, height = np.array(profile).T
    if not (np.diff(height) > 0).all():
        raise ValueError("profile: z does not rise")
    turn = np.linspace(0, 2 * np.pi, sections, endpoint=False)[None]
    return _wrap(_around(np.repeat(radius[:, None], sections, 1), height[:, None], turn), closed=False)


GENERATED = {"knot": knot, "terrain": terrain, "bolt": bolt, "nut": nut, "revolve": revolve}

# At least the faces that a shape has with its parameters, those of its module by default.
FACE_BOUNDS = {
    "box": lambda **_: 12,
    "icosphere": lambda subdivisions=3, **_: 20 * 4**subdivisions,
    "uv_sphere": lambda count=(32, 32), **_: 4 * (count[0] + 2) * (count[1] + 2),
    "cylinder": lambda sections=32, **_: 4 * sections,
    "cone": lambda sections=32, **_: 2 * sections,
    "capsule": lambda count=(32, 64), **_: 2 * (count[0] + 4) * (count[1] + 4),
    "annulus": lambda sections=32, **_: 8 * sections,
    "torus": lambda major_sections=32, minor_sections=32, **_: 2 * major_sections * minor_sections,
    "knot": lambda sections=(0, 0), **_: 2 * sections[0] * sections[1],
    "terrain": lambda cells=(0, 0), **_: 2 * cells[0] * cells[1],
    "bolt": lambda sections=(0, 0), **_: 2 * sections[0] * (sections[1] + 2),
    "nut": lambda sections=(0, 0), **_: 2 * sections[0] * (sections[1] + 2),
    "revolve": lambda profile=(), sections=0, **_: 2 * len(profile) * sections,
}
