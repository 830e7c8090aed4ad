"""Scenes as TOML files.

    [scene]                          # all optional
    title = "Tori through a bunny"
    frames = 120                     # frames that `run` makes
    time_step = 0.0333               # time between frames [s]
    seed = 1                         # of everything under `random`

    [models.NAME]                    # mesh, or shape, or both: the shape stands in where no mesh is at hand
    mesh = "cow.obj"                 # path from the scene file's folder, or "warp:bunny", "warp:bear", "warp:rocks";
                                     # of a list the first that is at hand
    shape = "torus"                  # or box, icosphere, uv_sphere, cylinder, cone, capsule, annulus, with the
    major_radius = 1.0               # parameters that trimesh.creation has under these names; or one of
                                     #   knot: radius, tube_radius, sections = [along, around]
                                     #   bolt: radius, length, pitch, head, sections = [around, along]
                                     #   nut: radius, height, pitch, width, sections = [around, along]
                                     #   terrain: extents = [x, z], cells = [x, z], bumps, waves, rim (heights along y)
                                     #   revolve: profile = [[radius, z], ...], sections
    size = 1.0                       # scales the longest extent to this length [units], or
    scale = 2.0                      # scales all coordinates
    centre = true                    # moves the middle of the box to the model's origin (default false)
    faces = 5804                     # brings the mesh to so many, or one less: by Loop subdivision and edge collapses
    base_faces = 10                  # faces of the coarsest LOD

    [[objects]]                      # one object, or many
    model = "NAME"                   # or a list, taken in turn
    name = "left"                    # for lod_sweep and picture
    position = [0, 0, 0]             # [units]
    rotation = { axis = [0, 1, 0], degrees = 30 }    # or { quaternion = [x, y, z, w] }
    world = 0                        # objects of different worlds never meet; -1 is in every world
    static = false                   # static objects never meet each other
    importance = 1                   # 1 (most), 2 or 3, for the selection of LODs
    lod = 0.25                       # part of the faces; or a whole number, "finest", "coarsest", "tol:0.01" [units],
                                     # or a list, taken in turn
    velocity = [0, 0, 0]             # [units/s]
    turn = { axis = [0, 1, 0], degrees = 45 }        # each second, about the object's origin
    shuttle = { by = [0, 0, 1], period = 4, phase = 0 }  # there and back in a period [s]
    count = 8                        # copies in the same world
    grid = { size = [4, 4, 2], spacing = [1, 1, 1] } # or copies on a grid around the position; along an axis of size 0
                                     # it grows from the position, layer by layer, with count
    worlds = 16                      # and all of them once in each of so many worlds
    random = { position = [1, 1, 1], rotation = true, velocity = 0.5, turn = 90, phase = true }  # up to so much
    kinematic = false                # with [dynamics]: moves as told, and pushes
    density = 1.0                    # with [dynamics], as there; so are restitution and friction

    [[lod_sweep]]                    # fine to coarse and back, in equal ratios
    model = "NAME"                   # or objects = ["left"]
    from = 1.0                       # parts of the faces
    to = 0.02
    period = 4                       # there and back [s]

    [lod]                            # a controller chooses LODs, in the place of sweeps
    controller = "predictive"        # or "paper", with a budget; or "tolerance"
    budget_ms = 8.0                  # T: selection, refinement, broad phase and query of a frame [ms]
    tolerance = 0.01                 # error of an important, still object at the eye [units]
    steps = 50                       # LODs that objects may stand at; spacing = "ratio" or "operations" (not paper)
    window = 10                      # frames over which motion on the screen is measured
    threshold_ms = 0.8               # paper: t; a tenth of the budget by default
    aim = 0.9                        # predictive: parts of the budget; also low, hold_frames, loosest
    loosest = 64.0                   # predictive, tolerance: most that a tolerance is loosened

    [camera]                         # whom LODs are for: near, still objects come first
    eye = [0, 2, 9]                  # [units]
    target = [0, 0, 0]
    up = [0, 1, 0]
    field_of_view = 60               # vertical [degrees]
    size = [1920, 1080]              # [pixels]
    far = 100.0                      # how far one sees: D of the paper [units]
    loop = false                     # whether the key points begin again
    [[camera.keys]]                  # in the place of eye and target: straight from one key point to the next
    time = 0.0                       # [s]
    eye = [0, 2, 9]
    target = [0, 0, 0]

    [dynamics]                       # objects that are neither static nor kinematic are rigid bodies; velocity and turn
                                     # are how they start
    gravity = [0, -9.81, 0]          # [units/s^2]
    density = 1.0                    # of objects that give none; as restitution and friction
    restitution = 0.0                # 0 to 1
    friction = 0.5
    iterations = 16                  # rounds of relaxation in a step
    sleep_time = 0.5                 # rest before bodies sleep [s]

    [picture]                        # for `run --picture`
    eye = [1, 0.5, 2]                # direction from the scene to the eye
    up = [0, 1, 0]
    world = 0                        # the world drawn
    time = 1.0                       # [s]; otherwise the last frame, which rigid bodies always show
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
from typing import Any

import numpy as np

from warp_abtree.app.toml import keys as keys_of
from warp_abtree.app.toml.control import (
    BODY,
    CameraPath,
    DynamicsSettings,
    LodControl,
    read_camera,
    read_dynamics,
    read_lod,
)
from warp_abtree.app.toml.folder import find_scene, scene_names
from warp_abtree.app.toml.keys import Keys, SceneError
from warp_abtree.app.toml.models import read_model
from warp_abtree.scene.scene import Scene
from warp_abtree.simulate.frame import Frame, LodSweep, resolve_lod
from warp_abtree.simulate.motion import Kinematic
from warp_abtree.simulate.rigid_bodies import Dynamics

OBJECT_LIMIT = 1_000_000  # of one entry


# Objects.


def _rotation(keys: Keys | None):
    if keys is None:
        return np.array([0.0, 0.0, 0.0, 1.0])
    if "quaternion" in keys.values:
        quaternion = np.array(keys.take("quaternion", keys_of.vector(4)))
        if abs(np.linalg.norm(quaternion) - 1) > 1e-3:
            keys.fail("quaternion", f"its norm is {np.linalg.norm(quaternion):.6g}, off 1 by more than 1e-3")
    else:
        axis, half = keys.take("axis", keys_of.direction), math.radians(keys.take("degrees", keys_of.number())) / 2
        quaternion = np.append(axis * math.sin(half), math.cos(half))
    keys.end()
    return quaternion


def _offsets(keys: Keys) -> np.ndarray:
    """Return the offset of every copy within one world, (count, 3)."""
    count, grid = keys.take("count", keys_of.whole(1, OBJECT_LIMIT), None), keys.table("grid")
    if grid is None:
        return np.zeros((count or 1, 3))
    size = np.array(grid.take("size", keys_of.vector(3, keys_of.whole(0, OBJECT_LIMIT))))
    spacing = np.array(grid.take("spacing", keys_of.vector(3)))
    grid.end()
    grows = size == 0
    if grows.sum() != (count is not None):
        keys.fail(None, "give count or grid, not both, unless the size of the grid is 0 along one axis")
    layer = math.prod(size[~grows].tolist())
    if count is not None:
        size = np.where(grows, -(-count // layer), size)
    if (layer if count is not None else math.prod(size.tolist())) > OBJECT_LIMIT:
        grid.fail("size", f"more than {OBJECT_LIMIT} objects")
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in size), indexing="ij"), axis=-1).reshape(-1, 3)
    if count is not None:
        cells = cells[np.argsort(cells[:, grows][:, 0], kind="stable")][:count]
    return (cells - np.where(grows, 0, (size - 1) / 2)) * spacing


def _scatter(keys: Keys, motion, rng):
    """Add what the table `random` asks for; always draws the same numbers, so that one key does not change another."""
    random = keys.table("random") or Keys(keys.path, keys.at("random"), {})
    count = len(motion["position"])
    box = rng.uniform(-1, 1, (count, 3))
    way, axis, rotation = (
        vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
        for vectors in (rng.normal(size=(count, width)) for width in (3, 3, 4))
    )
    speed, rate, phase = rng.uniform(0, 1, (3, count))
    motion["position"] += box * random.take("position", keys_of.vector(3, keys_of.number(0.0)), keys_of.ORIGIN)
    motion["velocity"] += way * (speed * random.take("velocity", keys_of.number(0.0), 0.0))[:, None]
    if random.take("rotation", keys_of.truth, False):
        motion["rotation"][:] = rotation
    if "turn" in random.values:
        motion["axis"][:], motion["rate"][:] = axis, rate * math.radians(random.take("turn", keys_of.number(0.0)))
    if random.take("phase", keys_of.truth, False):
        motion["phase"][:] = phase
    random.end()


def _read_object(keys: Keys, models, rng, dynamics) -> SimpleNamespace:
    """Check one entry of [[objects]] and lay out its copies; arrays have one row a copy."""
    static, kinematic = (keys.take(key, keys_of.truth, False) for key in ("static", "kinematic"))
    rigid = dynamics is not None and not static and not kinematic
    if dynamics is None:
        for key in ("kinematic", *BODY):
            if kinematic or key in keys.values:
                keys.fail(key, "the scene has no [dynamics]")
    if static and kinematic:
        keys.fail("kinematic", "a static object does not move")
    if rigid and "shuttle" in keys.values:
        keys.fail("shuttle", "a rigid body goes its own way; kinematic = true lets it shuttle")
    own = {name: keys.take(name, check, dynamics and dynamics.body[name]) for name, (check, _) in BODY.items()}
    name = keys.take("name", keys_of.text, None)
    model = keys.take("model", keys_of.one_or_list(keys_of.text))
    for entry in model:
        if entry not in models:
            keys.fail("model", f"there is no [models.{entry}]")
    offsets = _offsets(keys)
    first = keys.take("world", keys_of.whole(-1, 2**30), 0)
    worlds = keys.take("worlds", keys_of.whole(1, OBJECT_LIMIT), 1)
    if first < 0 and worlds > 1:
        keys.fail("worlds", "the world -1 is every world already")
    count = len(offsets) * worlds
    if count > OBJECT_LIMIT:
        keys.fail("worlds", f"more than {OBJECT_LIMIT} objects")
    motion = {
        "position": np.tile(offsets + keys.take("position", keys_of.vector(3), keys_of.ORIGIN), (worlds, 1)),
        "rotation": np.tile(_rotation(keys.table("rotation")), (count, 1)),
        "velocity": np.tile(keys.take("velocity", keys_of.vector(3), keys_of.ORIGIN), (count, 1)),
        "axis": np.tile([0.0, 0.0, 1.0], (count, 1)),
        "shuttle": np.zeros((count, 3)),
        "period": np.full(count, np.inf),
        **{key: np.zeros(count) for key in ("rate", "phase")},
    }
    turn, shuttle = keys.table("turn"), keys.table("shuttle")
    if turn is not None:
        motion["axis"][:] = turn.take("axis", keys_of.direction)
        motion["rate"][:] = math.radians(turn.take("degrees", keys_of.number()))
        turn.end()
    if shuttle is not None:
        motion["shuttle"][:] = shuttle.take("by", keys_of.vector(3))
        motion["period"][:] = shuttle.take("period", keys_of.LENGTH)
        motion["phase"][:] = shuttle.take("phase", keys_of.number(), 0.0)
        shuttle.end()
    _scatter(keys, motion, rng)
    row = SimpleNamespace(
        **{"keys": keys, "name": name, "model": model, "motion": motion, "static": static},
        kinematic=np.full(count, kinematic),
        body={key: np.full(count, np.nan if value is None else value) for key, value in own.items()},
        lod=keys.take("lod", keys_of.one_or_list(keys_of.lod), ["finest"]),
        world=np.repeat(np.arange(first, first + worlds), len(offsets)),
        importance=keys.take("importance", keys_of.whole(1, 3), 1),
    )
    keys.end()
    return row


def _read_objects(path, tables, models, seed, dynamics, objects):
    """Read all of [[objects]], for about so many objects unless that is None."""

    def read():
        return [
            _read_object(Keys(path, f"objects[{i}]", table), models, np.random.default_rng([seed, i]), dynamics)
            for i, table in enumerate(tables)
        ]

    rows = read()
    if objects is None:
        return rows
    keys = ["worlds" if table.get("worlds", 1) > 1 else "count" for table in tables]
    scaled = [len(row.world) if table.get(key, 1) > 1 else 0 for row, key, table in zip(rows, keys, tables)]
    if not any(scaled):
        raise SceneError(f"{path}: no entry of [[objects]] has a count or worlds, which another number would change")
    factor = (objects - (sum(len(row.world) for row in rows) - sum(scaled))) / sum(scaled)
    for table, key, changes in zip(tables, keys, scaled):
        if changes:
            table[key] = max(1, round(factor * table[key]))
    return read()


# LODs over time.


def _read_sweep(keys: Keys, models, rows):
    model, names = keys.take("model", keys_of.text, None), keys.take("objects", keys_of.one_or_list(keys_of.text), None)
    if (model is None) == (names is None):
        keys.fail(None, "give one of model and objects")
    if model is not None and model not in models:
        keys.fail("model", f"there is no [models.{model}]")
    for name in names or []:
        if name not in {row.name for row in rows}:
            keys.fail("objects", f"no object is named {name!r}")
    ends = keys.take("from", keys_of.PART), keys.take("to", keys_of.PART), keys.take("period", keys_of.LENGTH)
    keys.end()
    return model, names, ends


# The whole file.


@dataclass(eq=False)
class SceneFile:
    """A scene as a file describes it.

    Attributes:
        path, title: Where it came from.
        text: The file.
        objects: The number of objects that was asked for, None for the file's own.
        frames, time_step: How many frames, and the time between them [s].
        models: `Model` by name.
        scene: `Scene` with every object at its start.
        motion: `Kinematic` of all objects; that of rigid bodies is how they start.
        worlds: World of each object, int (n,).
        base_lods: LOD of each object before sweeps, int64 (n,).
        sweeps: `LodSweep`s.
        picture: What [picture] asks for: eye, up, world, time or None, lods or None.
        camera: Called with a time [s] returns a `Camera`; None without [camera].
        control: What [lod] asks for.
        dynamics: What [dynamics] asks for, None without.
        kinematic: Objects that move as told among rigid bodies, bool (n,).
        body: density, restitution and friction of each object, (n,).
    """

    path: Path
    title: str
    text: str
    objects: int | None
    frames: int
    time_step: float
    models: dict
    scene: Scene
    motion: Kinematic
    worlds: np.ndarray
    base_lods: np.ndarray
    sweeps: list
    picture: SimpleNamespace
    camera: CameraPath | None
    control: LodControl
    dynamics: DynamicsSettings | None
    kinematic: np.ndarray
    body: dict

    def lods_at(self, time: float) -> np.ndarray:
        """Return the LOD of every object at a time [s] without a controller, int64 (n,)."""
        lods = self.base_lods.copy()
        for sweep in self.sweeps:
            sweep.apply(sweep.fraction(time), lods)
        return lods

    def make_bodies(self) -> Dynamics | None:
        """Return rigid bodies at their start, and put the scene there; None without [dynamics].

        Raises:
            SceneError: A body without a mass.
        """
        if self.dynamics is None:
            return None
        self.scene.set_poses(self.motion.poses(0.0))
        try:
            return self.dynamics.make(self.scene, self.motion, self.kinematic, self.body)
        except ValueError as error:
            raise SceneError(f"{self.path}: objects: {error}") from None

    def frame(self, output: str = "count", controller=None, budget_ms=None, bodies=None, **options) -> Frame:
        """Put the scene to its start and return a `Frame` that runs it, its kernels loaded.

        Args:
            output: As for `Frame`; rigid bodies ask for contacts themselves.
            controller: "predictive", "paper", "tolerance" or "none" in the place of the file's.
            budget_ms: T in the place of the file's [ms].
            bodies: What `make_bodies` returned, to hold on to it; None makes them.
            options: clock of `Frame`.

        Raises:
            ValueError: A controller without its budget, or one that holds none with a budget.
            SceneError: A body without a mass.
        """
        control = self.control.asked(controller, budget_ms)
        self.scene.set_lods(self.lods_at(0.0))
        self.scene.set_poses(self.motion.poses(0.0))
        lods = control.make(self.scene, self.camera)
        if lods is None and self.sweeps:
            lods = self.lods_at
        motion = self.motion
        if self.dynamics is not None:
            bodies = self.make_bodies() if bodies is None else bodies
            motion = bodies.motion(self.motion)
        frame = Frame(self.scene, motion, lods, output=output, time_step=self.time_step, **options)
        frame.warm_up()
        return frame


def _read_toml(path: Path, text):
    try:
        tomllib = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    except ImportError:
        raise SceneError(f"{path}: scene files need the package tomli on Python 3.10: pip install tomli") from None
    try:
        text = path.read_bytes().decode() if text is None else text
        return text, tomllib.loads(text)
    except FileNotFoundError as error:
        known = ", ".join(scene_names())
        raise SceneError(f"{path}: {error.strerror}; scenes that come with the package: {known}") from None
    except OSError as error:
        raise SceneError(f"{path}: {error.strerror or error}") from None
    except ValueError as error:  # bytes that are no UTF-8 among them
        raise SceneError(f"{path}: not valid TOML: {error}") from None


def load_scene(path: str | os.PathLike, device=None, progress=None, objects=None, text=None) -> SceneFile:
    """Read a scene file, build its models and place its objects.

    Args:
        path: TOML file; the module docstring of `warp_abtree.app.toml.scene_file` lists its keys. Or the name of a
            scene that comes with the package, such as "bunny_tori".
        device: Warp device; None for Warp's default.
        progress: Called as progress(stage, done, total) during long builds.
        objects: About so many objects in all: every `worlds`, or else `count`, of the file is multiplied by the same
            number. None keeps them.
        text: TOML in the place of what the file holds.

    Raises:
        SceneError: The file is missing or wrong; nothing is left half done.
        ValueError: No such device on this machine, or objects is no whole number from 1.
    """
    objects, path = keys_of.object_count(objects), find_scene(path)
    scene = Scene(device=device)
    text, tree = _read_toml(path, text)
    top = Keys(path, "", tree)
    head = top.table("scene") or Keys(path, "scene", {})
    title = head.take("title", keys_of.text, path.stem)
    frames, seed = head.take("frames", keys_of.whole(1), 60), head.take("seed", keys_of.whole(0), 0)
    time_step = head.take("time_step", keys_of.LENGTH, 1 / 60)
    head.end()
    tables = top.take("models", keys_of.table)
    keys = {name: Keys(path, f"models.{name}", table) for name, table in tables.items()}
    builders = {name: read_model(keys[name], name, path.parent) for name in tables}
    dynamics = read_dynamics(top.table("dynamics"))
    rows = _read_objects(path, [keys.values for keys in top.tables("objects")], builders, seed, dynamics, objects)
    if not rows:
        top.fail(None, "no [[objects]]")
    wishes = [_read_sweep(keys, builders, rows) for keys in top.tables("lod_sweep")]
    picture = _read_picture(top.table("picture") or Keys(path, "picture", {}))
    if dynamics is not None and picture.time is not None:
        top.fail("picture.time", "rigid bodies are drawn as the last frame leaves them")
    camera, control = read_camera(top.table("camera")), read_lod(top.table("lod"))
    if wishes and control.controller != "none":
        top.fail("lod", "LODs are swept, or chosen by a controller, not both")
    top.end()

    try:
        motion = Kinematic(**{key: np.concatenate([row.motion[key] for row in rows]) for key in rows[0].motion})
    except ValueError as error:  # a sum of finite numbers that is not
        top.fail("objects", error)
    models = {name: build(progress) for name, build in builders.items()}
    owners = _add_objects(scene, rows, models)
    worlds = np.concatenate([row.world for row in rows])
    sweeps = [_make_sweep(wish, models, owners) for wish in wishes]
    given: dict[str, Any] = {"path": path, "title": title, "text": text, "objects": objects, "frames": frames}
    given |= {"time_step": time_step, "camera": camera, "control": control, "dynamics": dynamics}
    given |= {"models": models, "scene": scene, "motion": motion, "worlds": worlds, "sweeps": sweeps}
    loaded = SceneFile(
        **given,
        picture=picture,
        base_lods=scene.lods.astype(np.int64),
        kinematic=np.concatenate([row.kinematic for row in rows]),
        body={name: np.concatenate([row.body[name] for row in rows]) for name in BODY},
    )
    scene.set_lods(loaded.lods_at(0.0))
    scene.set_poses(motion.poses(0.0))
    return loaded


def _read_picture(keys: Keys) -> SimpleNamespace:
    picture = SimpleNamespace(
        eye=keys.take("eye", keys_of.direction, [0.4, 0.35, 1.0]),
        up=keys.take("up", keys_of.direction, [0.0, 1.0, 0.0]),
        world=keys.take("world", keys_of.whole(0), 0),
        time=keys.take("time", keys_of.number(), None),
        lods=keys.take("lods", keys_of.one_or_list(keys_of.PART), None),
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
