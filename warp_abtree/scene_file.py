"""Scenes as TOML files.

    [scene]                          # all optional
    title = "Tori through a bunny"
    frames = 120                     # frames that `run` makes
    time_step = 0.0333               # time between frames [s]
    seed = 1                         # of everything under `random`

    [models.NAME]                    # one of mesh and shape
    mesh = "cow.obj"                 # path from the scene file's folder, or "warp:bunny", "warp:bear", "warp:rocks"
    shape = "torus"                  # or box, icosphere, uv_sphere, cylinder, cone, capsule, annulus, with the parameters
    major_radius = 1.0               # that trimesh.creation has under these names
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
    lod = 0.25                       # part of the faces; or a whole number, "finest", "coarsest", "tol:0.01" [units], or a
                                     # list, taken in turn
    velocity = [0, 0, 0]             # [units/s]
    turn = { axis = [0, 1, 0], degrees = 45 }        # each second, about the object's origin
    shuttle = { by = [0, 0, 1], period = 4, phase = 0 }  # there and back in a period [s]
    count = 8                        # copies in the same world
    grid = { size = [4, 4, 2], spacing = [1, 1, 1] } # or copies on a grid around the position
    worlds = 16                      # and all of them once in each of so many worlds
    random = { position = [1, 1, 1], rotation = true, velocity = 0.5, turn = 90, phase = true }  # up to so much, each way

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

import math
import os
import re
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh

from warp_abtree import Frame, Kinematic, Model, Scene, load_mesh, mesh_from_arrays

OBJECT_LIMIT = 1_000_000
_MISSING = object()


class SceneError(ValueError):
    """What is wrong with a scene file, with the file and the key, in one line."""


# Values: each check returns the value as it is used, or raises ValueError with what it should be.


def _number(low=-math.inf, high=math.inf, open_low=False):
    def check(value):
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ValueError("not a finite number")
        if not low <= value <= high or (open_low and value == low):
            raise ValueError(f"{value} is not {'above' if open_low else 'at least'} {low:g}" if high == math.inf else
                             f"{value} is outside {low:g} .. {high:g}")
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
    if not np.linalg.norm(value) > 0:
        raise ValueError("a direction of no length")
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
        entries = value if isinstance(value, list) else [value]
        if not entries:
            raise ValueError("an empty list")
        return [check(entry) for entry in entries]

    return check_list


def _lod(value):
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError("not a LOD: a part of the faces such as 0.25, a whole number, \"finest\" or \"coarsest\"")
    return value


class _Keys:
    """A table whose keys are taken one by one; what is left over is refused."""

    def __init__(self, path, where, values):
        self.path, self.where = path, where
        if not isinstance(values, dict):
            raise SceneError(f"{path}: {where}: not a table")
        self.values = dict(values)

    def at(self, key):
        return f"{self.where}.{key}" if self.where else key

    def fail(self, key, message):
        raise SceneError(f"{self.path}: {self.at(key)}: {message}") from None

    def take(self, key, check, default=_MISSING):
        if key not in self.values:
            if default is _MISSING:
                raise SceneError(f"{self.path}: {self.where or 'the file'}: the key {key!r} is missing")
            return default
        try:
            return check(self.values.pop(key))
        except ValueError as error:
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
            raise SceneError(f"{self.path}: {self.at(sorted(self.values)[0])}: unknown key")


# Models.

_LENGTH, _SECTIONS = _number(0.0, open_low=True), _whole(3, 10_000)
SHAPES = {
    "box": {"extents": _vector(3, _LENGTH)},
    "icosphere": {"subdivisions": _whole(0, 8), "radius": _LENGTH},
    "uv_sphere": {"radius": _LENGTH, "count": _vector(2, _SECTIONS)},
    "cylinder": {"radius": _LENGTH, "height": _LENGTH, "sections": _SECTIONS},
    "cone": {"radius": _LENGTH, "height": _LENGTH, "sections": _SECTIONS},
    "capsule": {"radius": _LENGTH, "height": _LENGTH, "count": _vector(2, _SECTIONS)},
    "annulus": {"r_min": _LENGTH, "r_max": _LENGTH, "height": _LENGTH, "sections": _SECTIONS},
    "torus": {
        "major_radius": _LENGTH,
        "minor_radius": _LENGTH,
        "major_sections": _SECTIONS,
        "minor_sections": _SECTIONS,
    },
}


@dataclass
class _ModelRow:
    keys: _Keys
    name: str
    mesh: str | None
    shape: str | None
    parameters: dict
    size: float | None
    scale: float | None
    centre: bool
    base_faces: int


def _read_model(keys: _Keys, name) -> _ModelRow:
    mesh, shape = keys.take("mesh", _text, None), keys.take("shape", _text, None)
    if (mesh is None) == (shape is None):
        raise SceneError(f"{keys.path}: {keys.where}: give one of mesh and shape")
    parameters = {}
    if shape is not None:
        if shape not in SHAPES:
            keys.fail("shape", f"{shape!r} is none of {', '.join(sorted(SHAPES))}")
        parameters = {key: keys.take(key, check) for key, check in SHAPES[shape].items() if key in keys.values}
    size, scale = keys.take("size", _LENGTH, None), keys.take("scale", _LENGTH, None)
    if size is not None and scale is not None:
        raise SceneError(f"{keys.path}: {keys.where}: give size or scale, not both")
    row = _ModelRow(
        keys,
        name,
        mesh,
        shape,
        parameters,
        size,
        scale,
        keys.take("centre", _truth, False),
        keys.take("base_faces", _whole(1), 10),
    )
    keys.end()
    return row


def _load_model(row: _ModelRow, folder: Path, progress) -> Model:
    keys = row.keys
    try:
        if row.shape is not None:
            mesh = load_mesh(getattr(trimesh.creation, row.shape)(**row.parameters), name=row.name)
        elif row.mesh.startswith("warp:"):
            mesh = load_mesh(row.mesh)
        else:
            mesh = load_mesh(folder / row.mesh)
    except (ValueError, TypeError) as error:
        keys.fail("mesh" if row.mesh else "shape", error)
    try:
        vertices = mesh.vertices
        lower, upper = vertices.min(axis=0), vertices.max(axis=0)
        if row.centre:
            vertices = vertices - (lower / 2 + upper / 2)
        factor = row.scale or 1.0
        if row.size is not None:
            factor = row.size / float((upper - lower).max())
        if row.centre or factor != 1.0:
            mesh = mesh_from_arrays(vertices * factor, mesh.faces, name=mesh.name)
        return Model.load(mesh, base_faces=row.base_faces, progress=progress)
    except ValueError as error:
        raise SceneError(f"{keys.path}: {keys.where}: {error}") from None


# Objects.


@dataclass
class _ObjectRow:
    """One entry of [[objects]] after its copies are laid out; arrays have one row a copy."""

    keys: _Keys
    name: str | None
    model: list[str]
    lod: list
    world: np.ndarray
    static: bool
    importance: int
    motion: dict = field(default_factory=dict)

    @property
    def count(self):
        return len(self.world)


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
        raise SceneError(f"{keys.path}: {keys.where}: give count or grid, not both")
    size = np.array(grid.take("size", _vector(3, _whole(1, OBJECT_LIMIT))))
    spacing = np.array(grid.take("spacing", _vector(3)))
    grid.end()
    if math.prod(size.tolist()) > OBJECT_LIMIT:
        grid.fail("size", f"more than {OBJECT_LIMIT} objects")
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in size), indexing="ij"), axis=-1).reshape(-1, 3)
    return (cells - (size - 1) / 2) * spacing


def _unit_vectors(rng, count, width):
    vectors = rng.normal(size=(count, width))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _scatter(keys: _Keys, motion, rng):
    """Add what the table `random` asks for; always draws the same numbers, so that one key does not change another."""
    random = keys.table("random")
    if random is None:
        return
    count = len(motion["position"])
    box, way = rng.uniform(-1, 1, (count, 3)), _unit_vectors(rng, count, 3)
    rotation, axis = _unit_vectors(rng, count, 4), _unit_vectors(rng, count, 3)
    speed, rate, phase = rng.uniform(0, 1, (3, count))
    motion["position"] += box * random.take("position", _vector(3, _number(0.0)), [0.0, 0.0, 0.0])
    motion["velocity"] += way * (speed * random.take("velocity", _number(0.0), 0.0))[:, None]
    if random.take("rotation", _truth, False):
        motion["rotation"][:] = rotation
    turn = random.take("turn", _number(0.0), None)
    if turn is not None:
        motion["axis"][:] = axis
        motion["rate"][:] = rate * math.radians(turn)
    if random.take("phase", _truth, False):
        motion["phase"][:] = phase
    random.end()


def _read_object(keys: _Keys, models, rng) -> _ObjectRow:
    name = keys.take("name", _text, None)
    model = keys.take("model", _one_or_list(_text))
    for entry in model:
        if entry not in models:
            keys.fail("model", f"there is no [models.{entry}]")
    offsets = _offsets(keys)
    copies = len(offsets)
    first, worlds = keys.take("world", _whole(-1), 0), keys.take("worlds", _whole(1, OBJECT_LIMIT), 1)
    if first < 0 and worlds > 1:
        keys.fail("worlds", "the world -1 is every world already")
    count = copies * worlds
    if count > OBJECT_LIMIT:
        keys.fail("worlds", f"more than {OBJECT_LIMIT} objects")
    position = np.tile(offsets + keys.take("position", _vector(3), [0.0, 0.0, 0.0]), (worlds, 1))
    motion = {
        "position": position,
        "rotation": np.tile(_rotation(keys.table("rotation")), (count, 1)),
        "velocity": np.tile(keys.take("velocity", _vector(3), [0.0, 0.0, 0.0]), (count, 1)),
        "axis": np.tile([0.0, 0.0, 1.0], (count, 1)),
        "rate": np.zeros(count),
        "shuttle": np.zeros((count, 3)),
        "period": np.full(count, np.inf),
        "phase": np.zeros(count),
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
    row = _ObjectRow(
        keys,
        name,
        model,
        keys.take("lod", _one_or_list(_lod), ["finest"]),
        np.repeat(np.arange(first, first + worlds), copies),
        keys.take("static", _truth, False),
        keys.take("importance", _whole(1, 3), 1),
        motion,
    )
    keys.end()
    return row


# LODs.


def resolve_lod(model: Model, wish) -> int:
    """Return the LOD that a wish means for a model.

    Args:
        wish: A float is a part of the faces in (0, 1], an int a LOD; "finest", "coarsest", or "tol:X", the coarsest LOD whose
            certified error is within X [model units].

    Raises:
        ValueError: None of these, or out of range.
    """
    if isinstance(wish, str):
        if wish == "finest":
            return model.lod_max
        if wish == "coarsest":
            return 0
        if wish.startswith("tol:"):
            try:
                tolerance = float(wish[4:])
            except ValueError:
                raise ValueError(f"LOD {wish!r}: {wish[4:]!r} is not a number") from None
            return model.lod_for(tolerance=tolerance)
        raise ValueError(f"LOD {wish!r} is none of a part of the faces, a whole number, finest, coarsest, tol:X")
    if isinstance(wish, float):
        return model.lod_for(fraction=wish)
    return model.check_lod(wish)


@dataclass(frozen=True)
class LodSweep:
    """LODs of some objects that go from one part of the faces to another and back, in equal ratios.

    Attributes:
        objects: Indices by model, a list of (`Model`, int array).
        fine, coarse: Parts of the faces at the start and half a period later.
        period: Time there and back [s].
    """

    objects: list
    fine: float
    coarse: float
    period: float

    def fraction(self, time: float) -> float:
        """Return the part of the faces at a time [s]."""
        phase = time / self.period
        wave = 1.0 - abs(2.0 * (phase - math.floor(phase)) - 1.0)
        return self.fine * (self.coarse / self.fine) ** wave

    def apply(self, fraction: float, lods: np.ndarray):
        """Write the LODs of a part of the faces into lods, (n,)."""
        for model, indices in self.objects:
            lods[indices] = model.lod_for(fraction=fraction)


def _read_sweep(keys: _Keys, models, rows):
    part = _number(0.0, 1.0, open_low=True)
    model, names = keys.take("model", _text, None), keys.take("objects", _one_or_list(_text), None)
    if (model is None) == (names is None):
        raise SceneError(f"{keys.path}: {keys.where}: give one of model and objects")
    if model is not None and model not in models:
        keys.fail("model", f"there is no [models.{model}]")
    for name in names or []:
        if name not in {row.name for row in rows}:
            keys.fail("objects", f"no object is named {name!r}")
    ends = keys.take("from", part), keys.take("to", part), keys.take("period", _LENGTH)
    keys.end()
    return model, names, ends


# The whole file.


@dataclass(frozen=True)
class Picture:
    """What `[picture]` asks for; time and lods may be None."""

    eye: list
    up: list
    world: int
    time: float | None
    lods: list | None


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
        picture: `Picture`.
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
    picture: Picture

    def lods_at(self, time: float) -> np.ndarray:
        """Return the LOD of every object at a time [s], int64 (n,)."""
        lods = self.base_lods.copy()
        for sweep in self.sweeps:
            sweep.apply(sweep.fraction(time), lods)
        return lods

    def panel_lods(self) -> list[np.ndarray]:
        """Return the LODs of every panel of the picture: both ends of the sweeps, or what the file asks for."""
        panels = [[sweep.fine, sweep.coarse] for sweep in self.sweeps]
        if self.picture.lods is not None:
            panels = [self.picture.lods for _ in self.sweeps]
        count = len(panels[0]) if panels else 1
        chosen = [self.base_lods.copy() for _ in range(count)]
        for sweep, fractions in zip(self.sweeps, panels):
            for lods, fraction in zip(chosen, fractions):
                sweep.apply(fraction, lods)
        return chosen

    def frame(self, output: str = "count", **options) -> Frame:
        """Return a `Frame` that runs this scene; options are those of `Frame`."""
        lods = self.lods_at if self.sweeps else None
        return Frame(self.scene, self.motion, lods, output=output, time_step=self.time_step, **options)


def _read_toml(path: Path) -> dict:
    try:
        import tomllib
    except ImportError:
        try:
            import tomli as tomllib
        except ImportError:
            raise SceneError(f"{path}: scene files need the package tomli on Python 3.10: pip install tomli") from None
    try:
        return tomllib.loads(path.read_bytes().decode())
    except OSError as error:
        raise SceneError(f"{path}: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: not a text file ({error})") from None
    except tomllib.TOMLDecodeError as error:
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
    model_rows = {name: _read_model(_Keys(path, f"models.{name}", table), name) for name, table in tables.items()}
    objects = top.tables("objects")
    if not objects:
        raise SceneError(f"{path}: the file: no [[objects]]")
    rows = [_read_object(keys, model_rows, np.random.default_rng([seed, i])) for i, keys in enumerate(objects)]
    total = sum(row.count for row in rows)
    if total > OBJECT_LIMIT:
        raise SceneError(f"{path}: objects: {total} objects, more than {OBJECT_LIMIT}")
    wishes = [_read_sweep(keys, model_rows, rows) for keys in top.tables("lod_sweep")]
    picture = _read_picture(top.table("picture") or _Keys(path, "picture", {}))
    top.end()

    models = {name: _load_model(row, path.parent, progress) for name, row in model_rows.items()}
    owners = _add_objects(scene, rows, models)
    motion = Kinematic(**{key: np.concatenate([row.motion[key] for row in rows]) for key in rows[0].motion})
    worlds = np.concatenate([row.world for row in rows])
    sweeps = [_make_sweep(wish, models, owners) for wish in wishes]
    base = scene.lods.astype(np.int64)
    loaded = SceneFile(path, title, frames, time_step, models, scene, motion, worlds, base, sweeps, picture)
    scene.set_lods(loaded.lods_at(0.0))
    scene.set_poses(motion.poses(0.0))
    return loaded


def _read_picture(keys: _Keys) -> Picture:
    picture = Picture(
        keys.take("eye", _direction, [0.4, 0.35, 1.0]),
        keys.take("up", _direction, [0.0, 1.0, 0.0]),
        keys.take("world", _whole(0), 0),
        keys.take("time", _number(), None),
        keys.take("lods", _one_or_list(_number(0.0, 1.0, open_low=True)), None),
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
        for i in range(row.count):
            name = row.model[i % len(row.model)]
            wish = row.lod[i % len(row.lod)]
            try:
                lod = resolve_lod(models[name], wish)
            except ValueError as error:
                row.keys.fail("lod", error)
            try:
                scene.add(models[name], poses[i], int(row.world[i]), lod, row.importance, row.static)
            except ValueError as error:
                raise SceneError(f"{row.keys.path}: {row.keys.where}: {error}") from None
            owners.append((row.name, name))
    return owners


def _make_sweep(wish, models, owners) -> LodSweep:
    model, names, (fine, coarse, period) = wish
    chosen = [i for i, (name, of) in enumerate(owners) if of == model or (names is not None and name in names)]
    by_model = {}
    for i in chosen:
        by_model.setdefault(owners[i][1], []).append(i)
    return LodSweep([(models[of], np.array(indices)) for of, indices in by_model.items()], fine, coarse, period)
