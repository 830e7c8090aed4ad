"""Recorded runs: the row, poses and LODs of every frame in one .npz file.

A recording holds the text of the scene file, so that it needs no other file but the meshes that the text names, which
must be the same.
"""

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warp_abtree.app.toml.decode import import_msgspec
from warp_abtree.app.toml.scene_file import SceneFile, load_scene
from warp_abtree.checks.atomic_write import atomic_write
from warp_abtree.simulate.frame import FrameRow

FORMAT_NAME, FORMAT_VERSION = "warp_abtree recording", 2


@dataclass
class RunSettings:
    """What a run was asked for."""

    path: str  # of the scene file
    objects: int | None  # their number, None for the file's own
    controller: str  # as for `SceneFile.frame`


@dataclass(eq=False)
class Recording:
    """A run, frame by frame."""

    text: str  # the scene file
    settings: RunSettings
    models: list  # `Model.digest` of each model
    rows: list  # one `FrameRow` a frame
    lods: np.ndarray  # of every object in each frame, int32 (frames, n)
    poses: np.ndarray  # of every object in each frame, x y z qx qy qz qw, float64 (frames, n, 7)

    def save(self, path):
        """Write to an .npz file; it appears whole or not at all."""
        encode = import_msgspec(path).json.encode
        with atomic_write(path) as file:
            np.savez_compressed(
                file,
                format=np.array(FORMAT_NAME),
                version=np.array(FORMAT_VERSION),
                text=np.array(self.text),
                settings=np.array(encode(self.settings).decode()),
                rows=np.array(encode(self.rows).decode()),
                models=np.array(self.models),
                lods=self.lods,
                poses=self.poses,
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
        decode = import_msgspec(path).json.decode
        try:
            settings = decode(str(arrays["settings"]), type=RunSettings)
            rows = decode(str(arrays["rows"]), type=list[FrameRow])
            lods, poses = arrays["lods"], arrays["poses"]
            shapes = (len(rows), *lods.shape[1:2]), (*lods.shape[:2], 7)
            for name, array, shape, kind in zip(("lods", "poses"), (lods, poses), shapes, ("int32", "float64")):
                if array.shape != shape or array.dtype != kind or array.ndim < 2 or not array.size:
                    raise ValueError(f"{name}: shape {array.shape} and type {array.dtype} of {len(rows)} frames")
            return cls(str(arrays["text"]), settings, arrays["models"].tolist(), rows, lods, poses)
        except (ValueError, KeyError) as error:
            what = f"{error} is missing" if isinstance(error, KeyError) else error
            raise ValueError(f"{path}: a damaged recording ({what})") from None

    def load_scene(self, path, device=None, progress=None) -> SceneFile:
        """Return the scene of the recording; `path` is the recording's, for messages.

        Raises:
            ValueError: A mesh is missing, or another one.
        """
        loaded = load_scene(self.settings.path, device, progress, self.settings.objects, self.text)
        for (name, model), known in zip(loaded.models.items(), self.models):
            if model.digest != known:
                raise ValueError(f"{path}: the mesh of models.{name} is not the one of the recording")
        if (len(loaded.models), loaded.scene.object_count) != (len(self.models), self.lods.shape[1]):
            raise ValueError(f"{path}: a damaged recording (the scene has other objects)")
        return loaded


def record_run(loaded: SceneFile, frames: int, keep=True, progress=None, **options):
    """Run a scene from its start.

    Args:
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
    settings = RunSettings(str(Path(loaded.path).absolute()), loaded.objects, control.controller)
    models = [model.digest for model in loaded.models.values()] if keep else []
    return frame, Recording(loaded.text, settings, models, list(frame.history), lods, poses)
