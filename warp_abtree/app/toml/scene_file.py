"""Scenes as TOML files: `load_scene` checks a file, builds its models and places its objects.

The keys of a file are the fields of the structs in `warp_abtree.app.toml.tables`.
"""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warp_abtree.app.toml.control import LodControl, make_control
from warp_abtree.app.toml.decode import read_tables
from warp_abtree.app.toml.errors import SceneError, fail
from warp_abtree.app.toml.folder import find_scene
from warp_abtree.app.toml.models import build_model, check_faces
from warp_abtree.app.toml.objects import make_groups
from warp_abtree.checks.arguments import whole_number
from warp_abtree.interop.scenes import is_assembly, scene_from_file
from warp_abtree.model.files.found import MeshError
from warp_abtree.scene.scene import Scene
from warp_abtree.simulate.frame import Frame
from warp_abtree.simulate.lod_request import LodSweep, resolve_lod
from warp_abtree.simulate.motion import Kinematic
from warp_abtree.simulate.rigid_bodies import Dynamics

STATE_LIMIT = 2**25  # faces of models times the LODs that their objects begin at; one takes 130 bytes
MOTION_LIMIT = 2**27  # objects times frames of the window of a controller; one takes 8 bytes


@dataclass(eq=False)
class SceneFile:
    """A scene as a file describes it."""

    path: Path
    title: str
    frames: int
    time_step: float  # between frames [s]
    models: dict  # `Model` by name
    scene: Scene  # with every object at its start
    motion: Kinematic  # of all objects; that of rigid bodies is how they start
    worlds: np.ndarray  # world of each object, int (n,)
    base_lods: np.ndarray  # LOD of each object before sweeps, int64 (n,)
    sweeps: list  # `LodSweep`s
    picture: Any  # `PictureTable`
    camera: Any  # `CameraTable`, called with a time [s] returns a `Camera`; None without [camera]
    control: LodControl  # of [lod]
    dynamics: Any  # `DynamicsTable`, None without [dynamics]
    kinematic: np.ndarray  # whether each object moves as told among rigid bodies, bool (n,)

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
            return Dynamics(
                self.scene,
                friction=self.dynamics.friction,
                gravity=self.dynamics.gravity,
                kinematic=self.kinematic,
                velocity=self.motion.velocity,
                angular_velocity=self.motion.axis * self.motion.rate[:, None],
                continuous=self.dynamics.continuous,
            )
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


@np.errstate(all="ignore")  # what is not finite is refused, with its key
def load_scene(path: str | os.PathLike, device=None, progress=None, objects=None, text=None) -> SceneFile:
    """Read a scene file, build its models and place its objects.

    Args:
        path: TOML file, or the name of a scene that comes with the package, such as "bunny_tori"; or a file of several
            objects that `scene_from_file` reads, which stand still.
        device: Warp device; None for Warp's default.
        progress: Called as progress(stage, done, total) during long builds.
        objects: About so many objects in all: every `worlds`, or else `count`, of the file is multiplied by the same
            number. None keeps them.
        text: TOML in the place of what the file holds.

    Raises:
        SceneError: The file is missing or wrong; nothing is left half done.
        ValueError: No such device on this machine, or objects is no whole number from 1.
    """
    if isinstance(objects, float):
        raise ValueError(f"objects {objects!r} is not a whole number")
    objects = None if objects is None else whole_number(objects, "objects", 1, 2**31 - 1)
    path, scene = find_scene(path), Scene(device=device)
    if text is None and path.suffix.lower() not in ("", ".toml") and is_assembly(path):
        if objects is not None:
            fail(path, "objects", "are those of the file; their number is for scene files in TOML")
        return load_assembly(path, device, progress)
    tables = read_tables(path, text)
    if not tables.objects:
        fail(path, "the file", "no [[objects]]")
    control = make_control(path, tables.lod)
    groups = make_groups(path, tables.objects, tables.dynamics, tables.scene.seed, objects)
    _check_names(path, tables)
    if tables.dynamics is not None and tables.dynamics.continuous:
        if all(table.static or table.kinematic for table in tables.objects):
            fail(path, "dynamics.continuous", "no object is a rigid body, which it would stop")
    try:
        motion = Kinematic(**{key: np.concatenate([group.motion[key] for group in groups]) for key in groups[0].motion})
    except ValueError as error:  # a sum of finite numbers that is not
        fail(path, "objects", error)
    check_faces(path, tables.models)
    count, window = len(motion.position), 1 if tables.lod is None else tables.lod.window or 1
    if window * count > MOTION_LIMIT:
        fail(path, "lod.window", f"{window:,} frames of {count:,} objects are more than {MOTION_LIMIT:,} together")
    models = {name: build_model(path, name, table, progress) for name, table in tables.models.items()}
    owners = _add_objects(path, scene, groups, models)
    sweeps = [_make_sweep(table, models, owners) for table in tables.lod_sweep]
    worlds, kinematic = (np.concatenate([getattr(g, name) for g in groups]) for name in ("world", "kinematic"))
    loaded = _loaded(path, tables, scene, models, motion, worlds, kinematic, control, sweeps)
    scene.set_lods(loaded.lods_at(0.0))
    scene.set_poses(motion.poses(0.0))
    return loaded


def load_assembly(path: Path, device=None, progress=None) -> SceneFile:
    """Read a file of several objects, which stand still at their finest, as `load_scene`."""
    tables = read_tables(path, "models = {}")  # all that a file may leave out
    scene = scene_from_file(path, device, progress=progress)
    poses = scene.poses
    models = {scene.name(scene.object_model.index(k)): model for k, model in enumerate(scene.models)}
    motion, still = Kinematic(poses[:, :3], poses[:, 3:]), np.zeros(scene.object_count, bool)
    return _loaded(path, tables, scene, models, motion, scene.worlds, still, make_control(path, None), [])


def _loaded(path, tables, scene, models, motion, worlds, kinematic, control, sweeps) -> SceneFile:
    return SceneFile(
        path=path,
        title=path.stem if tables.scene.title is None else tables.scene.title,
        frames=tables.scene.frames,
        time_step=tables.scene.time_step,
        models=models,
        scene=scene,
        motion=motion,
        worlds=worlds,
        base_lods=scene.lods.astype(np.int64),
        sweeps=sweeps,
        picture=tables.picture,
        camera=tables.camera,
        control=control,
        dynamics=tables.dynamics,
        kinematic=kinematic,
    )


def as_list(value) -> list:
    """Return one value, or a list of them, as a list."""
    return value if isinstance(value, list) else [value]


def _check_names(path, tables):
    """Refuse names of models and objects that there are not, and LODs that are chosen twice."""
    for i, table in enumerate(tables.objects):
        for name in as_list(table.model):
            if name not in tables.models:
                fail(path, f"objects[{i}].model", f"there is no [models.{name}]")
    names = {table.name for table in tables.objects}
    for i, table in enumerate(tables.lod_sweep):
        if table.model is not None and table.model not in tables.models:
            fail(path, f"lod_sweep[{i}].model", f"there is no [models.{table.model}]")
        for name in [] if table.objects is None else as_list(table.objects):
            if name not in names:
                fail(path, f"lod_sweep[{i}].objects", f"no object is named {name!r}")
    if tables.lod_sweep and tables.lod is not None:
        fail(path, "lod", "LODs are swept, or chosen by a controller, not both")


def _add_objects(path, scene, groups, models):
    """Add every object of every group; return the names of the group and of the model of each."""
    owners, states = [], set()
    room = STATE_LIMIT + sum(model.face_count for model in models.values())  # whatever the models, one LOD each
    for group in groups:
        table = group.table
        poses = np.concatenate([group.motion["position"], group.motion["rotation"]], axis=1)
        names, lods = as_list(table.model), as_list(table.lod)
        turns = [(i % len(names), i % len(lods)) for i in range(len(group.world))]
        try:
            found = {(k, at): resolve_lod(models[names[k]], lods[at]) for k, at in dict.fromkeys(turns)}
        except ValueError as error:
            fail(path, f"{group.key}.lod", error)
        asked = {(names[k], lod) for (k, _), lod in found.items()} - states
        states |= asked
        room -= sum(models[name].face_count for name, _ in asked)
        if room < 0:
            about = f"{len(states):,} LODs of {len(models):,} models have more than {STATE_LIMIT:,} faces together"
            fail(path, f"{group.key}.lod", about)
        try:
            scene.add_many(
                [models[names[k]] for k, _ in turns],
                poses,
                group.world,
                [found[turn] for turn in turns],
                table.importance,
                table.static,
                table.collision_group,
                table.collision_mask,
                table.solid,
                None if table.name is None else [table.name + (f" {k}" if k else "") for k in range(len(poses))],
            )
        except MeshError as error:
            fail(path, f"{group.key}.solid", error)
        owners += [(table.name, names[k]) for k, _ in turns]
    return owners


def _make_sweep(table, models, owners) -> LodSweep:
    """Return the sweep of a `SweepTable`: its objects by model."""
    names = [] if table.objects is None else as_list(table.objects)
    chosen = {
        model: [i for i, (name, own) in enumerate(owners) if own == model and (model == table.model or name in names)]
        for model in models
    }
    objects = [(models[model], np.array(indices)) for model, indices in chosen.items() if indices]
    return LodSweep(objects, table.start, table.turn, table.period)
