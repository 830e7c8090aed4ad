"""Recorded runs: the row, poses and LODs of every frame in one .npz file.

A recording holds the text of the scene file, so that it needs no other file but the meshes that the text names, which
must be the same.
"""

import json
import zipfile
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from warp_abtree.app.toml.scene_file import SceneFile, load_scene
from warp_abtree.checks.atomic_write import atomic_write
from warp_abtree.simulate.frame import FrameRow

FORMAT_NAME, FORMAT_VERSION = "warp_abtree recording", 2
COLUMNS = tuple(field.name for field in fields(FrameRow))
_OPTIONAL = ("hits", "budget_ms")  # NaN in the file where they are None
_SETTINGS = {"path": str, "objects": int, "controller": str, "budget_ms": float, "device": str}


@dataclass(eq=False)
class Recording:
    """A run, frame by frame.

    Attributes:
        text: The scene file.
        settings: path of the scene file, objects asked for or None, controller, budget_ms or None, and device.
        models: `Model.digest` of each model.
        rows: One `FrameRow` a frame.
        lods: LOD of every object in each frame, int32 (frames, n).
        poses: Pose of every object in each frame, x y z qx qy qz qw, float64 (frames, n, 7).
    """

    text: str
    settings: dict
    models: list
    rows: list
    lods: np.ndarray
    poses: np.ndarray

    def save(self, path):
        """Write to an .npz file; it appears whole or not at all."""
        columns: dict[str, Any] = {}
        for name in COLUMNS:
            values = [getattr(row, name) for row in self.rows]
            columns[f"row_{name}"] = np.array([np.nan if value is None else value for value in values], _type_of(name))
        with atomic_write(path) as file:
            np.savez_compressed(
                file,
                format=np.array(FORMAT_NAME),
                version=np.array(FORMAT_VERSION),
                text=np.array(self.text),
                settings=np.array(json.dumps(self.settings)),
                models=np.array(self.models),
                lods=self.lods,
                poses=self.poses,
                **columns,
            )

    @classmethod
    def open(cls, path) -> "Recording":
        """Read what `save` wrote; nothing in the file is executed.

        Raises:
            ValueError: With what is wrong with the file.
        """
        path = Path(path)
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
        except OSError as error:
            raise ValueError(f"{path}: {error.strerror or error}") from None
        except (ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
            raise ValueError(f"{path}: not a recording ({error})") from None
        if not isinstance(arrays, dict) or str(arrays.get("format")) != FORMAT_NAME:
            raise ValueError(f"{path}: not a recording of a run")
        version = str(arrays.get("version"))
        if version != str(FORMAT_VERSION):
            raise ValueError(f"{path}: a recording of version {version}, not {FORMAT_VERSION}")
        try:
            return cls._from_arrays(arrays)
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            what = f"{error} is missing" if isinstance(error, KeyError) else error
            raise ValueError(f"{path}: a damaged recording ({what})") from None

    @classmethod
    def _from_arrays(cls, arrays):
        settings = json.loads(str(arrays["settings"]))
        for name, kind in _SETTINGS.items():
            if not isinstance(settings[name], kind) and (settings[name] is not None or name in ("path", "controller")):
                raise ValueError(f"settings: {name} is {settings[name]!r}")
        lods, poses = arrays["lods"], arrays["poses"]
        frames = len(arrays["row_frame"])
        count = lods.shape[1] if lods.ndim == 2 else 0
        wanted = {"lods": ((frames, count), np.int32), "poses": ((frames, count, 7), np.float64)}
        wanted |= {f"row_{name}": ((frames,), _type_of(name)) for name in COLUMNS}
        for name, (shape, kind) in wanted.items():
            array = arrays[name]
            if array.shape != shape or array.dtype != kind or not array.size:
                raise ValueError(f"{name}: shape {array.shape} and type {array.dtype} of {frames} frames")
        columns = []
        for name in COLUMNS:
            column = arrays[f"row_{name}"]
            if name not in _OPTIONAL and not np.isfinite(column).all():
                raise ValueError(f"row_{name}: a number is not finite")
            values = [None if np.isnan(value) else value for value in column.tolist()]
            columns.append([value and int(value) for value in values] if name == "hits" else values)
        rows = [FrameRow(*values) for values in zip(*columns)]
        return cls(str(arrays["text"]), settings, arrays["models"].tolist(), rows, lods, poses)

    def load_scene(self, path, device=None, progress=None) -> SceneFile:
        """Return the scene of the recording.

        Args:
            path: Of the recording, for messages.
            device, progress: As for `load_scene`.

        Raises:
            SceneError: A mesh is missing.
            ValueError: A mesh is another.
        """
        objects = self.settings["objects"]
        loaded = load_scene(self.settings["path"], device, progress, objects, self.text)
        for (name, model), known in zip(loaded.models.items(), self.models):
            if model.digest != known:
                raise ValueError(f"{path}: the mesh of models.{name} is not the one of the recording")
        if (len(loaded.models), loaded.scene.object_count) != (len(self.models), self.lods.shape[1]):
            raise ValueError(f"{path}: a damaged recording (the scene has other objects)")
        return loaded


def _type_of(name):
    real = name == "time" or name.endswith("_ms") or name.startswith("error_") or name in _OPTIONAL
    return np.float64 if real else np.int64


def record_run(loaded: SceneFile, frames: int, keep=True, progress=None, **options):
    """Run a scene from its start.

    Args:
        loaded: What `load_scene` returned.
        frames: How many.
        keep: Whether poses are kept.
        progress: Called as progress(done, total) after each frame.
        options: Of `SceneFile.frame`.

    Returns:
        The `Frame`, and the `Recording`, whose poses are empty unless kept.
    """
    bodies = loaded.make_bodies()
    frame = loaded.frame(bodies=bodies, **options)
    scene = loaded.scene
    lods = np.empty((frames, scene.object_count), np.int32)
    poses = np.empty((frames if keep else 0, scene.object_count, 7))
    for i in range(frames):
        if keep:
            poses[i] = loaded.motion.poses(i * loaded.time_step) if bodies is None else bodies.poses()
        frame.step()
        lods[i] = scene.lods
        if progress is not None:
            progress(i + 1, frames)
    control = loaded.control.asked(options.get("controller"), options.get("budget_ms"))
    settings = {
        "path": str(Path(loaded.path).absolute()),
        "objects": loaded.objects,
        "controller": control.controller,
        "budget_ms": None if control.controller in ("none", "tolerance") else control.budget_ms,
        "device": str(scene.device),
    }
    models = [model.digest for model in loaded.models.values()] if keep else []
    return frame, Recording(loaded.text, settings, models, list(frame.history), lods, poses)
