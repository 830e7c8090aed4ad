"""Models of scene files: mesh files and generated shapes, brought to a size and a number of faces."""

import importlib.util
import math
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from warp_abtree.app.toml import keys as keys_of
from warp_abtree.model.mesh import load_mesh, mesh_from_arrays
from warp_abtree.model.model import Model

# Generated shapes that trimesh does not have.


def _wrap(points, closed):
    """Return a surface over a grid of rings: each is closed, and all are if `closed`, else ended by two poles.

    Args:
        points: Corners, float64 (rings, sections, 3); a ring runs counterclockwise as seen from the rings after it.
    """
    rings, sections, _ = points.shape
    i, j = np.meshgrid(np.arange(rings if closed else rings - 1), np.arange(sections), indexing="ij")
    here, there = i * sections, (i + 1) % rings * sections
    after = (j + 1) % sections
    a, b, c, d = (x.ravel() for x in (here + j, here + after, there + after, there + j))
    faces = [np.stack([a, b, c], 1), np.stack([a, c, d], 1)]
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
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    return trimesh.Trimesh(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]), process=False)


def _thread(height, turn, pitch):
    """Return the part of a thread's depth that stands at a height and a turn: 0 at the crest, 1 at the root."""
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
    turn = np.linspace(0, 2 * np.pi, sections, endpoint=False)[None]
    return _wrap(_around(np.repeat(radius[:, None], sections, 1), height[:, None], turn), closed=False)


def _profile(value):
    point = keys_of.vector(2)
    if not isinstance(value, list) or len(value) < 2:
        raise ValueError("not a list of points [radius, z]")
    points = [point(entry) for entry in value]
    if min(radius for radius, _ in points) <= 0 or not (np.diff([z for _, z in points]) > 0).all():
        raise ValueError("a radius is not above 0, or z does not rise")
    return points


_LENGTH, _SECTIONS = keys_of.LENGTH, keys_of.SECTIONS
_PAIR = keys_of.vector(2, _SECTIONS)
# Parameters and their checks; those of trimesh have the names there.
SHAPES = {
    "box": {"extents": keys_of.vector(3, _LENGTH)},
    "icosphere": {"subdivisions": keys_of.whole(0, 8), "radius": _LENGTH},
    "uv_sphere": {"radius": _LENGTH, "count": _PAIR},
    "cylinder": {"radius": _LENGTH, "height": _LENGTH, "sections": _SECTIONS},
    "cone": {"radius": _LENGTH, "height": _LENGTH, "sections": _SECTIONS},
    "capsule": {"radius": _LENGTH, "height": _LENGTH, "count": _PAIR},
    "annulus": {"r_min": _LENGTH, "r_max": _LENGTH, "height": _LENGTH, "sections": _SECTIONS},
    "torus": dict.fromkeys(("major_radius", "minor_radius"), _LENGTH)
    | dict.fromkeys(("major_sections", "minor_sections"), _SECTIONS),
    "knot": {"radius": _LENGTH, "tube_radius": _LENGTH, "sections": _PAIR},
    "terrain": {
        "extents": keys_of.vector(2, _LENGTH),
        "cells": keys_of.vector(2, keys_of.whole(1, 4096)),
        **dict.fromkeys(("bumps", "waves", "rim"), keys_of.number(0.0)),
    },
    "bolt": {**dict.fromkeys(("radius", "length", "pitch", "head"), _LENGTH), "sections": _PAIR},
    "nut": {**dict.fromkeys(("radius", "height", "pitch", "width"), _LENGTH), "sections": _PAIR},
    "revolve": {"profile": _profile, "sections": _SECTIONS},
}
OWN = {"knot": knot, "terrain": terrain, "bolt": bolt, "nut": nut, "revolve": revolve}


def _find_source(names, folder, has_shape):
    """Return the first mesh that is at hand, else the last, or None where a shape stands in."""
    for name in names:
        if name.startswith("warp:"):
            if len(names) + has_shape == 1 or importlib.util.find_spec("pxr") is not None:
                return name
        elif (folder / name).is_file():
            return folder / name
    if has_shape or not names:
        return None
    return names[-1] if names[-1].startswith("warp:") else folder / names[-1]


def read_model(keys: keys_of.Keys, name, folder: Path):
    """Check [models.NAME] and return a function of progress that builds the `Model`."""
    mesh_names, shape = keys.take("mesh", keys_of.one_or_list(keys_of.text), []), keys.take("shape", keys_of.text, None)
    if not mesh_names and shape is None:
        keys.fail(None, "give mesh or shape")
    if shape is not None and shape not in SHAPES:
        keys.fail("shape", f"{shape!r} is none of {', '.join(sorted(SHAPES))}")
    checks = SHAPES.get(shape, {})
    parameters = {key: keys.take(key, check) for key, check in checks.items() if key in keys.values}
    size, scale = keys.take("size", _LENGTH, None), keys.take("scale", _LENGTH, None)
    if size is not None and scale is not None:
        keys.fail(None, "give size or scale, not both")
    faces = keys.take("faces", keys_of.whole(1), None)
    centre, base_faces = keys.take("centre", keys_of.truth, False), keys.take("base_faces", keys_of.whole(1), 10)
    keys.end()

    def load():
        source = _find_source(mesh_names, folder, shape is not None)
        try:
            if source is None:
                made: Any = OWN.get(shape) or getattr(trimesh.creation, shape)
                article = "an" if shape[0] in "aeiou" else "a"
                title = f"{name} ({article} {shape})" if mesh_names else name
                return load_mesh(made(**parameters), name=title)
            chosen = len(mesh_names) + (shape is not None) > 1
            return load_mesh(source, name=f"{name} ({getattr(source, 'name', source)})" if chosen else None)
        except (ValueError, TypeError) as error:
            keys.fail("mesh" if source is not None else "shape", error)

    def build(progress) -> Model:
        mesh = load()
        try:
            lower, upper = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
            vertices = mesh.vertices - (lower / 2 + upper / 2) if centre else mesh.vertices
            factor = (scale or 1.0) if size is None else size / float((upper - lower).max())
            if centre or factor != 1.0:
                with np.errstate(over="ignore"):
                    mesh = mesh_from_arrays(vertices * factor, mesh.faces, name=mesh.name)
            if faces is not None:
                mesh = _bring_to(mesh, faces, progress)
            return Model.load(mesh, base_faces=base_faces, progress=progress)
        except ValueError as error:
            keys.fail(None, error)

    return build


def _bring_to(mesh, faces, progress):
    """Return a mesh of that many faces, or one less: smoothed by Loop subdivision if need be, then collapsed."""
    rounds = math.ceil(math.log(faces / len(mesh.faces), 4)) if len(mesh.faces) < faces else 0
    vertices = mesh.vertices
    corners = np.delete(mesh.faces, mesh.dropped_faces, axis=0)
    if rounds:
        vertices, corners = trimesh.remesh.subdivide_loop(vertices, corners, iterations=rounds)
    model = Model.load(mesh_from_arrays(vertices, corners, name=mesh.name), base_faces=faces, progress=progress)
    vertices, corners, _ = model.mesh_at(0)
    return mesh_from_arrays(vertices, corners, name=mesh.name)
