"""One pair of models at many poses, as a job."""

import hashlib
import os
from pathlib import Path
from typing import Any

import numpy as np

from warp_abtree.checks.arguments import flag, to_numpy, whole_number
from warp_abtree.query.request import check_options
from warp_abtree.scene.objects import check_models
from warp_abtree.scene.scene import Scene
from warp_abtree.scene.sweep import sweep
from warp_abtree.state.poses import IDENTITY_POSE, check_poses

# Poses of a shard, and rows read at a time while a job is checked.
READ_ROWS = SHARD = 65536
# Limits of the scene that finds contacts, or LODs that differ between poses: poses at a time, bytes of tree states.
SCENE_POSES, STATE_BYTES, BYTES_A_FACE = 4096, 2**28, 190


# Options that outputs take beside solid.
JOB_OPTIONS = {"any": ("within",), "count": ("within",), "faces": (), "contacts": ()}
JOB_OPTIONS |= {"distance": ("tolerance", "beyond"), "first_contact": ("tolerance",)}


class _Rows:
    """Rows of numbers in memory, or in an .npy file that is read in parts: (p, width), of poses (p, 4, 4) too."""

    def __init__(self, source, what, width):
        self.what, of_file = what, isinstance(source, str | os.PathLike)
        self.path: Any = Path(source) if of_file else None
        self.array = None if of_file else to_numpy(source, what)
        rows = self._open()
        if rows.dtype.kind not in "iuf":
            raise ValueError(f"{what}: type {rows.dtype} holds no real numbers")
        matrices = width == 7 and rows.ndim == 3 and rows.shape[1:] == (4, 4)
        if not matrices and (rows.ndim != 2 or rows.shape[1] != width):
            wanted = f"(p, {width})" if width != 7 else "(p, 7) or (p, 4, 4)"
            raise ValueError(f"{what}: shape {rows.shape}, not {wanted}")
        self.dtype, self.count = rows.dtype, len(rows)

    def _open(self) -> np.ndarray:
        """Return all rows; those of a file are mapped, so that only what is used of them is in memory."""
        if self.array is not None:
            return self.array
        try:
            rows = np.load(self.path, mmap_mode="r", allow_pickle=False)
        except FileNotFoundError:
            raise ValueError(f"{self.what}: {self.path}: no such file") from None
        except (OSError, ValueError, EOFError) as error:
            raise ValueError(f"{self.what}: {self.path} cannot be read as .npy ({error})") from None
        if not isinstance(rows, np.memmap) or not rows.flags.c_contiguous:
            raise ValueError(f"{self.what}: {self.path} is not an .npy file of one array in C order")
        return rows

    def read(self, start, stop) -> np.ndarray:
        """Return a range of rows, without a copy if they are in memory."""
        rows = self._open()[start:stop]
        if len(rows) != stop - start:
            raise ValueError(f"{self.what}: {self.path} ends before row {stop}")
        return rows if self.array is not None else np.array(rows)

    def hash_checked(self, check) -> str:
        """Return a hash of all rows; check(index of the first, rows) is called on each part and raises on bad rows."""
        found = hashlib.sha256(f"{self.dtype.str} {self.count}".encode())
        for start in range(0, self.count, READ_ROWS):
            rows = self.read(start, min(start + READ_ROWS, self.count))
            check(start, rows)
            found.update(rows.tobytes())
        return found.hexdigest()


class SweepJob:
    """One pair of models at many poses, or LODs, as a job for `run_shards`.

    The constructor checks all poses and LODs, part by part.

    Args:
        model_a, model_b: `Model`; may be the same.
        poses: (p, 7) or (p, 4, 4) as for `sweep`, an array or the path of an .npy file.
        lods: LODs of A and B: (2,) for all poses, or (p, 2), an array or the path of an .npy file; None is the finest.
            Poses with the LODs of nearby poses are faster.
        output: "any", "count", "faces", "contacts", "distance" or "first_contact".
        precision: As for `sweep`.
        shard: Poses per shard.
        end_poses: As poses, for "first_contact" alone.
        solid, within, tolerance, beyond: As for `sweep`; with these, "distance" and "first_contact" LODs are those of
            all poses.

    Attributes:
        count: Poses.

    Raises:
        TypeError: model_a or model_b is no Model.
        ValueError: Bad poses or LODs (the message names the first), or an unknown option.
    """

    def __init__(
        self,
        model_a,
        model_b,
        poses,
        lods=None,
        output="any",
        precision="exact",
        shard=SHARD,
        *,
        end_poses=None,
        solid=False,
        within=None,
        tolerance=None,
        beyond=None,
    ):
        check_models([model_a, model_b], 2)
        given = {"within": within, "tolerance": tolerance, "beyond": beyond}
        self.options = check_options(JOB_OPTIONS, output, precision, given)
        self.options |= {"solid": True} if flag(solid, "solid") else {}
        self.models = (model_a, model_b)
        self.output, self.precision = output, precision
        self.shard = whole_number(shard, "shard", 1, 2**31 - 1)
        self.fixed, self.lods = (model_a.lod_max, model_b.lod_max), None
        if lods is not None and not isinstance(lods, str | os.PathLike) and np.shape(lods) == (2,):
            self.fixed = tuple(model.check_lod(lod) for model, lod in zip(self.models, np.asarray(lods).tolist()))
        elif lods is not None:
            self.lods = _Rows(lods, "lods", 2)
        self.poses = _Rows(poses, "poses", 7)
        self.count = self.poses.count
        self.ends = None if end_poses is None else _Rows(end_poses, "end_poses", 7)
        if (self.ends is None) != (output != "first_contact"):
            raise ValueError(f"end_poses: needed for output 'first_contact' alone, which is {output!r}")
        if self.ends is not None and self.ends.count != self.count:
            raise ValueError(f"end_poses: {self.ends.count} given for {self.count} poses")
        if self.options or output in ("distance", "first_contact"):
            if self.lods is not None or output == "contacts":
                raise ValueError(f"lods and contacts: not with {', '.join(self.options) or f'output {output!r}'}")
            none = np.empty((0, 7))  # the options are checked all the same
            asked = {**self.options, "end_poses": None if self.ends is None else none}
            sweep(model_a, model_b, none, output=output, device="cpu", **asked)
        if self.lods is not None and self.lods.count != self.count:
            raise ValueError(f"lods: {self.lods.count} given for {self.count} poses")
        self._known = {
            "kind": "sweep",
            "count": self.count,
            "shard": self.shard,
            "models": [model.digest for model in self.models],
            "poses": self.poses.hash_checked(lambda start, rows: check_poses(rows, first=start)),
            "lods": self.fixed if self.lods is None else self.lods.hash_checked(self._check_lods),
            "output": output,
            "precision": precision,
        }
        if self.ends is not None:
            checked = self.ends.hash_checked(lambda start, rows: check_poses(rows, "end_poses", start))
            self._known["end_poses"] = checked
        if self.options:
            self._known["options"] = self.options

    def _check_lods(self, start, rows):
        top = np.array([model.lod_max for model in self.models])
        bad = np.flatnonzero(~((rows >= 0) & (rows <= top) & (rows == np.floor(rows))).all(1))
        if len(bad):
            found = f"those of pose {start + bad[0]} are {rows[bad[0]].tolist()}"
            raise ValueError(f"lods: {found}, not whole numbers from 0 to {top.tolist()}")

    def describe(self) -> dict:
        """Return everything that determines the results, for JSON."""
        return self._known

    def task(self, start, stop):
        """Return the input of one shard, sent to a worker."""
        lods = None if self.lods is None else self.lods.read(start, stop).astype(np.int64)
        ends = None if self.ends is None else self.ends.read(start, stop)
        return start, self.poses.read(start, stop), lods, ends

    def runner(self) -> "SweepRunner":
        """Return the task runner, sent to each worker once."""
        return SweepRunner(self.models, self.fixed, self.output, self.precision, self.options)


class SweepRunner:
    """Task runner of a `SweepJob` on one device; pickled without its scene."""

    def __init__(self, models, fixed, output, precision, options):
        self.models, self.fixed, self.output, self.precision = models, fixed, output, precision
        self.options = options
        self._scene: Any = None  # made at the first use

    def __getstate__(self):
        return {**vars(self), "_scene": None}

    def run(self, task, device=None) -> dict:
        """Return the columns of a shard, arrays of one length."""
        start, poses, lods, ends = task
        if lods is None and self.output != "contacts":
            options = {"output": self.output, "precision": self.precision, "device": device, "end_poses": ends}
            (model_a, model_b), (lod_a, lod_b) = self.models, self.fixed
            found = sweep(model_a, model_b, poses, lod_a, lod_b, **options, **self.options)
            if found.dtype.names:
                return {name: np.ascontiguousarray(found[name]) for name in found.dtype.names}
            return {self.output: found} if self.output != "faces" else _name_faces(found, start)
        parts = []
        room = self._make_scene(len(poses), device)
        for first in range(0, len(poses), room):
            part = slice(first, first + room)
            result = self._intersect(poses[part], None if lods is None else lods[part], room)
            if self.output in ("any", "count"):
                parts.append({self.output: getattr(result, self.output)})
                continue
            columns = _name_faces(result.faces, start + first)
            if self.output == "contacts":
                names = result.contacts.dtype.names[2:]
                columns |= {name: np.ascontiguousarray(result.contacts[name]) for name in names}
            parts.append(columns)
        return {name: np.concatenate([columns[name] for columns in parts]) for name in parts[0]}

    def _make_scene(self, count, device) -> int:
        """Make the scene, with an A and a B for each pose, at the first call; return how many poses it holds."""
        if self._scene is None:
            faces = sum(model.face_count for model in self.models)
            room = min(SCENE_POSES, count, max(1, STATE_BYTES // (BYTES_A_FACE * faces)))
            scene = Scene(device)
            for model, lod in zip(self.models, self.fixed):
                scene.add_many(model, [IDENTITY_POSE] * room, lods=lod)
            self._scene = scene
        return self._scene.object_count // 2

    def _intersect(self, poses, lods, room):
        """Intersect A and B at up to `room` poses; the other objects stay at the origin."""
        count = len(poses)
        placed = np.tile(np.eye(4) if poses.ndim == 3 else np.eye(7)[6], (2 * room, *[1] * (poses.ndim - 1)))
        placed[room : room + count] = poses
        self._scene.set_poses(placed)
        if lods is not None:
            levels = np.tile(lods[-1:], (room, 1))
            levels[:count] = lods
            self._scene.set_lods(levels.T.reshape(-1))
        pairs = np.arange(count)[:, None] + [0, room]
        return self._scene.intersect(pairs, output=self.output, precision=self.precision)


def _name_faces(faces, start) -> dict:
    return {"pose": faces[:, 0].astype(np.int64) + start, "face_a": faces[:, 1], "face_b": faces[:, 2]}
