"""Scenes as TOML files.

    [scene]                          # all optional
    title = "Tori through a bunny"
    frames = 120                     # frames that `run` makes
    time_step = 0.0333               # time between frames [s]
    seed = 1                         # of everything under `random`

    [models.NAME]                    # one of mesh and shape
    mesh = "cow.obj"                 # path from the scene file's folder, or "warp:bunny", "warp:bear", "warp:rocks"
    shape = "torus"                  # or box, icosphere, uv_sphere, cylinder, cone, capsule, annulus,
    major_radius = 1.0               # with the parameters that trimesh.creation has under these names
    size = 1.0                       # scales the longest extent to this length [units], or
    scale = 2.0                      # scales all coordinates
    centre = true                    # moves the middle of the box to the model's origin (default false)
    base_faces = 10                  # faces of the coarsest LOD

    [[objects]]                      # one object, or many
    model = "NAME"                   # or a list, taken in turn
    name = "left"                    # for lod_sweep and picture
    position = [0, 0, 0]             # [units]
    rotation = { axis = [0, 1, 0], degrees = 30 }    # or { quaternion = [x, y, z, w] }
    world = 0                        # objects of different worlds never meet; -1 is in every world
    static = false                   # static objects never meet each other
    importance = 1                   # 1, 2 or 3, for the selection of LODs
    lod = 0.25                       # part of the faces; or a whole number, "finest", "coarsest", "tol:0.01" [units],
                                     # or a list, taken in turn
    velocity = [0, 0, 0]             # [units/s]
    turn = { axis = [0, 1, 0], degrees = 45 }        # each second, about the object's origin
    shuttle = { by = [0, 0, 1], period = 4, phase = 0 }  # there and back in a period [s]
    count = 8                        # copies in the same world
    grid = { size = [4, 4, 2], spacing = [1, 1, 1] } # or copies on a grid around the position
    worlds = 16                      # and all of them once in each of so many worlds
    random = { position = [1, 1, 1], rotation = true, velocity = 0.5, turn = 90, phase = true }  # up to so much

    [[lod_sweep]]                    # fine to coarse and back, in equal ratios
    model = "NAME"                   # or objects = ["left"]
    from = 1.0                       # parts of the faces
    to = 0.02
    period = 4                       # there and back [s]

    [picture]                        # for `run --picture`
    eye = [1, 0.5, 2]                # direction from the scene to the eye
    up = [0, 1, 0]
    world = 0                        # the world drawn
    time = 1.0                       # [s]; otherwise the last frame
    lods = [1.0, 0.02]               # of the swept objects, a panel each; otherwise the ends of their sweep

A key that is not listed here is refused.
"""

import importlib
import math
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import trimesh

from warp_abtree import Frame, Kinematic, LodSweep, Model, Scene, load_mesh, mesh_from_arrays, resolve_lod

OBJECT_LIMIT = 1_000_000  # of one entry
_MISSING = object()


class SceneError(ValueError):
    """What is wrong with a scene file, with the file and the key, in one line."""


# Values: each check returns the value as it is used, or raises ValueError with what it should be.


def _number(low=-math.inf, high=math.inf, open_low=False):
    def check(value):
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ValueError("not a finite number")
        if not low <= value <= high or (open_low and value == low):
            raise ValueError(f"{value} is not {'above' if open_low else 'from'} {low:g} to {high:g}")
        return float(value)

    return check


def _whole(low, high=2**31 - 1):
    def check(value):
        if isinstance(value, bool) or not isinstance(value, int):
            raise ValueError("not a whole number")
        if not low <= value <= high:
            raise ValueError(f"{value} is outside {low} .. {high}")
        return value

    return check


def _vector(length, check=None):
    check = check or _number()

    def check_vector(value):
        if not isinstance(value, list) or len(value) != length:
            raise ValueError(f"not a list of {length} numbers")
        return [check(entry) for entry in value]

    return check_vector


def _direction(value):
    value = np.array(_vector(3)(value))
    if not value.any():
        raise ValueError("a direction of no length")
    value /= np.abs(value).max()  # no square over- or underflows
    return value / np.linalg.norm(value)


def _kind(kind, name):
    def check(value):
        if not isinstance(value, kind):
            raise ValueError(f"not {name}")
        return value

    return check


_text, _truth, _table = _kind(str, "a text"), _kind(bool, "true or false"), _kind(dict, "a table")


def _one_or_list(check):
    def check_list(value):
        if value == []:
            raise ValueError("an empty list")
        return [check(entry) for entry in (value if isinstance(value, list) else [value])]

    return check_list


def _lod(value):
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError('not a LOD: a part of the faces such as 0.25, a whole number, "finest" or "coarsest"')
    return value


_LENGTH, _PART, _SECTIONS = _number(0.0, open_low=True), _number(0.0, 1.0, open_low=True), _whole(3, 10_000)
_ORIGIN = [0.0, 0.0, 0.0]


class _Keys:
    """A table whose keys are taken one by one; what is left over is refused."""

    def __init__(self, path, where, values):
        self.path, self.where = path, where
        if not isinstance(values, dict):
            raise SceneError(f"{path}: {where}: not a table")
        self.values = dict(values)

    def at(self, key):
        return ".".join(part for part in (self.where, key) if part) or "the file"

    def fail(self, key, message):
        """Raise SceneError about a key, or about the table itself where key is None."""
        raise SceneError(f"{self.path}: {self.at(key)}: {message}") from None

    def take(self, key, check, default=_MISSING):
        if key not in self.values:
            if default is _MISSING:
                self.fail(None, f"the key {key!r} is missing")
            return default
        try:
            return check(self.values.pop(key))
        except (ValueError, OverflowError) as error:
            self.fail(key, error)

    def table(self, key):
        """Return the table under a key, or None."""
        return _Keys(self.path, self.at(key), self.values.pop(key)) if key in self.values else None

    def tables(self, key):
        rows = self.values.pop(key, [])
        if not isinstance(rows, list):
            self.fail(key, f"not a list of tables; write [[{key}]]")
        return [_Keys(self.path, f"{key}[{i}]", row) for i, row in enumerate(rows)]

    def end(self):
        if self.values:
            self.fail(sorted(self.values)[0], "unknown key")


# Models.

SHAPES = {
    "box": {"extents": _vector(3, _LENGTH)},
    "icosphere": {"subdivisions": _whole(0, 8), "radius": _LENGTH},
    "uv_sphere": {"radius": _LENGTH, "count": _vector(2, _SECTIONS)},
    "cylinder": {"radius": _LENGTH, "height": _LENGTH, "sections": _SECTIONS},
    "cone": {"radius": _LENGTH, "height": _LENGTH, "sections": _SECTIONS},
    "capsule": {"radius": _LENGTH, "height": _LENGTH, "count": _vector(2, _SECTIONS)},
    "annulus": {"r_min": _LENGTH, "r_max": _LENGTH, "height": _LENGTH, "sections": _SECTIONS},
    "torus": dict.fromkeys(("major_radius", "minor_radius"), _LENGTH)
    | dict.fromkeys(("major_sections", "minor_sections"), _SECTIONS),
}


def _read_model(keys: _Keys, name, folder: Path):
    """Check [models.NAME] and return a function that builds the model."""
    mesh_name, shape = keys.take("mesh", _text, None), keys.take("shape", _text, None)
    if (mesh_name is None) == (shape is None):
        keys.fail(None, "give one of mesh and shape")
    if shape is not None and shape not in SHAPES:
        keys.fail("shape", f"{shape!r} is none of {', '.join(sorted(SHAPES))}")
    parameters = {key: keys.take(key, check) for key, check in SHAPES.get(shape, {}).items() if key in keys.values}
    size, scale = keys.take("size", _LENGTH, None), keys.take("scale", _LENGTH, None)
    if size is not None and scale is not None:
        keys.fail(None, "give size or scale, not both")
    centre, base_faces = keys.take("centre", _truth, False), keys.take("base_faces", _whole(1), 10)
    keys.end()

    def source():
        if shape is not None:
            return getattr(trimesh.creation, shape)(**parameters)
        return mesh_name if mesh_name.startswith("warp:") else folder / mesh_name

    def build(progress) -> Model:
        try:
            mesh = load_mesh(source(), name=name if shape is not None else None)
        except (ValueError, TypeError) as error:
            keys.fail("mesh" if shape is None else "shape", error)
        try:
            lower, upper = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
            vertices = mesh.vertices - (lower / 2 + upper / 2) if centre else mesh.vertices
            factor = (scale or 1.0) if size is None else size / float((upper - lower).max())
            if centre or factor != 1.0:
                with np.errstate(over="ignore"):
                    mesh = mesh_from_arrays(vertices * factor, mesh.faces, name=mesh.name)
            return Model.load(mesh, base_faces=base_faces, progress=progress)
        except ValueError as error:
            keys.fail(None, error)

    return build


# Objects.


def _rotation(keys: _Keys | None):
    if keys is None:
        return np.array([0.0, 0.0, 0.0, 1.0])
    if "quaternion" in keys.values:
        quaternion = np.array(keys.take("quaternion", _vector(4)))
        if abs(np.linalg.norm(quaternion) - 1) > 1e-3:
            keys.fail("quaternion", f"its norm is {np.linalg.norm(quaternion):.6g}, off 1 by more than 1e-3")
    else:
        axis, half = keys.take("axis", _direction), math.radians(keys.take("degrees", _number())) / 2
        quaternion = np.append(axis * math.sin(half), math.cos(half))
    keys.end()
    return quaternion


def _offsets(keys: _Keys) -> np.ndarray:
    """Return the offset of every copy within one world, (count, 3)."""
    count, grid = keys.take("count", _whole(1, OBJECT_LIMIT), None), keys.table("grid")
    if grid is None:
        return np.zeros((count or 1, 3))
    if count is not None:
        keys.fail(None, "give count or grid, not both")
    size = np.array(grid.take("size", _vector(3, _whole(1, OBJECT_LIMIT))))
    spacing = np.array(grid.take("spacing", _vector(3)))
    grid.end()
    if math.prod(size.tolist()) > OBJECT_LIMIT:
        grid.fail("size", f"more than {OBJECT_LIMIT} objects")
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in size), indexing="ij"), axis=-1).reshape(-1, 3)
    return (cells - (size - 1) / 2) * spacing


def _scatter(keys: _Keys, motion, rng):
    """Add what the table `random` asks for; always draws the same numbers, so that one key does not change another."""
    random = keys.table("random") or _Keys(keys.path, keys.at("random"), {})
    count = len(motion["position"])
    box = rng.uniform(-1, 1, (count, 3))
    way, axis, rotation = (
        vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
        for vectors in (rng.normal(size=(count, width)) for width in (3, 3, 4))
    )
    speed, rate, phase = rng.uniform(0, 1, (3, count))
    motion["position"] += box * random.take("position", _vector(3, _number(0.0)), _ORIGIN)
    motion["velocity"] += way * (speed * random.take("velocity", _number(0.0), 0.0))[:, None]
    if random.take("rotation", _truth, False):
        motion["rotation"][:] = rotation
    if "turn" in random.values:
        motion["axis"][:], motion["rate"][:] = axis, rate * math.radians(random.take("turn", _number(0.0)))
    if random.take("phase", _truth, False):
        motion["phase"][:] = phase
    random.end()


def _read_object(keys: _Keys, models, rng) -> SimpleNamespace:
    """Check one entry of [[objects]] and lay out its copies; arrays have one row a copy."""
    name = keys.take("name", _text, None)
    model = keys.take("model", _one_or_list(_text))
    for entry in model:
        if entry not in models:
            keys.fail("model", f"there is no [models.{entry}]")
    offsets = _offsets(keys)
    first, worlds = keys.take("world", _whole(-1, 2**30), 0), keys.take("worlds", _whole(1, OBJECT_LIMIT), 1)
    if first < 0 and worlds > 1:
        keys.fail("worlds", "the world -1 is every world already")
    count = len(offsets) * worlds
    if count > OBJECT_LIMIT:
        keys.fail("worlds", f"more than {OBJECT_LIMIT} objects")
    motion = {
        "position": np.tile(offsets + keys.take("position", _vector(3), _ORIGIN), (worlds, 1)),
        "rotation": np.tile(_rotation(keys.table("rotation")), (count, 1)),
        "velocity": np.tile(keys.take("velocity", _vector(3), _ORIGIN), (count, 1)),
        "axis": np.tile([0.0, 0.0, 1.0], (count, 1)),
        "shuttle": np.zeros((count, 3)),
        "period": np.full(count, np.inf),
        **{key: np.zeros(count) for key in ("rate", "phase")},
    }
    turn, shuttle = keys.table("turn"), keys.table("shuttle")
    if turn is not None:
        motion["axis"][:] = turn.take("axis", _direction)
        motion["rate"][:] = math.radians(turn.take("degrees", _number()))
        turn.end()
    if shuttle is not None:
        motion["shuttle"][:] = shuttle.take("by", _vector(3))
        motion["period"][:] = shuttle.take("period", _LENGTH)
        motion["phase"][:] = shuttle.take("phase", _number(), 0.0)
        shuttle.end()
    _scatter(keys, motion, rng)
    row = SimpleNamespace(
        **{"keys": keys, "name": name, "model": model, "motion": motion},
        lod=keys.take("lod", _one_or_list(_lod), ["finest"]),
        world=np.repeat(np.arange(first, first + worlds), len(offsets)),
        static=keys.take("static", _truth, False),
        importance=keys.take("importance", _whole(1, 3), 1),
    )
    keys.end()
    return row


# LODs over time.


def _read_sweep(keys: _Keys, models, rows):
    model, names = keys.take("model", _text, None), keys.take("objects", _one_or_list(_text), None)
    if (model is None) == (names is None):
        keys.fail(None, "give one of model and objects")
    if model is not None and model not in models:
        keys.fail("model", f"there is no [models.{model}]")
    for name in names or []:
        if name not in {row.name for row in rows}:
            keys.fail("objects", f"no object is named {name!r}")
    ends = keys.take("from", _PART), keys.take("to", _PART), keys.take("period", _LENGTH)
    keys.end()
    return model, names, ends


# The whole file.


@dataclass(eq=False)
class SceneFile:
    """A scene as a file describes it.

    Attributes:
        path, title: Where it came from.
        frames, time_step: How many frames, and the time between them [s].
        models: `Model` by name.
        scene: `Scene` with every object at its start.
        motion: `Kinematic` of all objects.
        worlds: World of each object, int (n,).
        base_lods: LOD of each object before sweeps, int64 (n,).
        sweeps: `LodSweep`s.
        picture: What [picture] asks for: eye, up, world, time or None, lods or None.
    """

    path: Path
    title: str
    frames: int
    time_step: float
    models: dict
    scene: Scene
    motion: Kinematic
    worlds: np.ndarray
    base_lods: np.ndarray
    sweeps: list
    picture: SimpleNamespace

    def lods_at(self, time: float) -> np.ndarray:
        """Return the LOD of every object at a time [s], int64 (n,)."""
        lods = self.base_lods.copy()
        for sweep in self.sweeps:
            sweep.apply(sweep.fraction(time), lods)
        return lods

    def frame(self, output: str = "count", **options) -> Frame:
        """Return a `Frame` that runs this scene; options are those of `Frame`."""
        lods = self.lods_at if self.sweeps else None
        return Frame(self.scene, self.motion, lods, output=output, time_step=self.time_step, **options)


def _read_toml(path: Path) -> dict:
    try:
        tomllib = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    except ImportError:
        raise SceneError(f"{path}: scene files need the package tomli on Python 3.10: pip install tomli") from None
    try:
        return tomllib.loads(path.read_bytes().decode())
    except OSError as error:
        raise SceneError(f"{path}: {error.strerror or error}") from None
    except ValueError as error:  # bytes that are no UTF-8 among them
        raise SceneError(f"{path}: not valid TOML: {error}") from None


def load_scene(path: str | os.PathLike, device=None, progress=None) -> SceneFile:
    """Read a scene file, build its models and place its objects.

    Args:
        path: TOML file; the module docstring of `warp_abtree.scene_file` lists its keys.
        device: Warp device; None for Warp's default.
        progress: Called as progress(stage, done, total) during long builds.

    Raises:
        SceneError: The file is missing or wrong; nothing is left half done.
        ValueError: No such device on this machine.
    """
    path = Path(path)
    scene = Scene(device=device)
    top = _Keys(path, "", _read_toml(path))
    head = top.table("scene") or _Keys(path, "scene", {})
    title = head.take("title", _text, path.stem)
    frames, seed = head.take("frames", _whole(1), 60), head.take("seed", _whole(0), 0)
    time_step = head.take("time_step", _LENGTH, 1 / 60)
    head.end()
    tables = top.take("models", _table)
    keys = {name: _Keys(path, f"models.{name}", table) for name, table in tables.items()}
    builders = {name: _read_model(keys[name], name, path.parent) for name in tables}
    objects = top.tables("objects")
    if not objects:
        top.fail(None, "no [[objects]]")
    rows = [_read_object(keys, builders, np.random.default_rng([seed, i])) for i, keys in enumerate(objects)]
    wishes = [_read_sweep(keys, builders, rows) for keys in top.tables("lod_sweep")]
    picture = _read_picture(top.table("picture") or _Keys(path, "picture", {}))
    top.end()

    try:
        motion = Kinematic(**{key: np.concatenate([row.motion[key] for row in rows]) for key in rows[0].motion})
    except ValueError as error:  # a sum of finite numbers that is not
        top.fail("objects", error)
    models = {name: build(progress) for name, build in builders.items()}
    owners = _add_objects(scene, rows, models)
    worlds = np.concatenate([row.world for row in rows])
    sweeps = [_make_sweep(wish, models, owners) for wish in wishes]
    head = path, title, frames, time_step
    loaded = SceneFile(*head, models, scene, motion, worlds, scene.lods.astype(np.int64), sweeps, picture)
    scene.set_lods(loaded.lods_at(0.0))
    scene.set_poses(motion.poses(0.0))
    return loaded


def _read_picture(keys: _Keys) -> SimpleNamespace:
    picture = SimpleNamespace(
        eye=keys.take("eye", _direction, [0.4, 0.35, 1.0]),
        up=keys.take("up", _direction, [0.0, 1.0, 0.0]),
        world=keys.take("world", _whole(0), 0),
        time=keys.take("time", _number(), None),
        lods=keys.take("lods", _one_or_list(_PART), None),
    )
    if not np.linalg.norm(np.cross(picture.eye, picture.up)) > 1e-6:
        keys.fail("up", "points along eye")
    keys.end()
    return picture


def _add_objects(scene, rows, models):
    """Add every object of every row; return (row's name, model's name) of each."""
    owners = []
    for row in rows:
        poses = np.concatenate([row.motion["position"], row.motion["rotation"]], axis=1)
        for i in range(len(row.world)):
            name = row.model[i % len(row.model)]
            try:
                lod = resolve_lod(models[name], row.lod[i % len(row.lod)])
            except ValueError as error:
                row.keys.fail("lod", error)
            scene.add(models[name], poses[i], int(row.world[i]), lod, row.importance, row.static)
            owners.append((row.name, name))
    return owners


def _make_sweep(wish, models, owners) -> LodSweep:
    model, names, ends = wish
    chosen = {
        of: [i for i, (name, its) in enumerate(owners) if its == of and (of == model or name in (names or ()))]
        for of in models
    }
    return LodSweep([(models[of], np.array(indices)) for of, indices in chosen.items() if indices], *ends)
