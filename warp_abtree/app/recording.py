"""Recorded runs: what every frame did, with poses, LODs and the clock, in one .npz file that runs again.

A recording holds the scene file's text, so that it runs without it; meshes that the text names must lie where they did,
and be the same. Run again, a controller hears the times of the recording, and every row must come out bit for bit.
"""

import json
import zipfile
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from warp_abtree.app.toml.scene_file import SceneFile, load_scene
from warp_abtree.checks.atomic_write import atomic_write
from warp_abtree.lod.timing import ReplayClock
from warp_abtree.simulate.frame import FrameRow

FORMAT_NAME, FORMAT_VERSION = "warp_abtree recording", 1
COLUMNS = tuple(field.name for field in fields(FrameRow))
_OPTIONAL = ("hits", "budget_ms")  # NaN in the file where they are None
_SETTINGS = {"path": str, "objects": int, "controller": str, "budget_ms": float, "device": str}


@dataclass(eq=False)
class Recording:
    """A run, frame by frame.

    Attributes:
        text: The scene file.
        settings: path of the scene file, objects asked for or None, controller, budget_ms or None, and device.
        models: Digest of each model's mesh.
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
        table = [asdict(row) for row in self.rows]
        columns: dict[str, Any] = {}
        for name in COLUMNS:
            values = [row[name] for row in table]
            if name in _OPTIONAL:
                columns[f"row_{name}"] = np.array([np.nan if value is None else value for value in values], np.float64)
            else:
                columns[f"row_{name}"] = np.array(values, np.float64 if _is_real(name) else np.int64)
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
        """Read what `save` wrote; nothing in the file is run.

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
        if lods.ndim != 2 or len(lods) != frames or lods.dtype != np.int32 or not frames:
            raise ValueError(f"lods: shape {lods.shape} and type {lods.dtype} of {frames} frames")
        if poses.shape != (*lods.shape, 7) or poses.dtype != np.float64:
            raise ValueError(f"poses: shape {poses.shape} and type {poses.dtype} of {frames} frames")
        columns = {}
        for name in COLUMNS:
            column = arrays[f"row_{name}"]
            real = _is_real(name) or name in _OPTIONAL
            if column.shape != (frames,) or column.dtype != (np.float64 if real else np.int64):
                raise ValueError(f"row_{name}: shape {column.shape} and type {column.dtype} of {frames} frames")
            if name not in _OPTIONAL and not np.isfinite(column).all():
                raise ValueError(f"row_{name}: a number is not finite")
            columns[name] = column.tolist()
            if name in _OPTIONAL:
                whole = int if name == "hits" else float
                columns[name] = [None if np.isnan(value) else whole(value) for value in columns[name]]
        rows = [FrameRow(*values) for values in zip(*(columns[name] for name in COLUMNS))]
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

    def difference(self, other: "Recording") -> str | None:
        """Return the first difference of another run, as far as both go, to the bit; None if there is none."""
        for i, (mine, its) in enumerate(zip(self.rows, other.rows)):
            for name in COLUMNS:
                if getattr(mine, name) != getattr(its, name):
                    return f"frame {i}: {name} is {getattr(its, name)}, recorded is {getattr(mine, name)}"
            for name in ("lods", "poses"):
                if getattr(self, name)[i].tobytes() != getattr(other, name)[i].tobytes():
                    return f"frame {i}: {name} are not those recorded"
        return None


def _is_real(name):
    return name == "time" or name.endswith("_ms") or name.startswith("error_")


def record_run(loaded: SceneFile, frames: int, replay=None, keep=True, progress=None, **options):
    """Run a scene from its start.

    Args:
        loaded: What `load_scene` returned.
        frames: How many.
        replay: `Recording` whose clock the run reads.
        keep: Whether poses are kept.
        progress: Called as progress(done, total) after each frame.
        options: Of `SceneFile.frame`.

    Returns:
        The `Frame`, and the `Recording`, whose poses are empty unless kept.
    """
    bodies = loaded.make_bodies()
    if replay is not None:
        options["clock"] = ReplayClock(replay.rows)
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
