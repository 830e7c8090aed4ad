"""The folder of a job: `job.json` with a hash of the job, and a file for each range of poses.

Beside its columns a shard has the hash of its job, its range, and a digest of all three, in arrays of the .npz
file. Existing shards are read and checked, one column at a time.
"""

import hashlib
import json
import re
import zipfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from warp_abtree.checks.arguments import first_line
from warp_abtree.checks.atomic_write import atomic_write, find_partial, is_special

SHARD_FORMAT, SHARD_VERSION = "warp_abtree shards", 2
MANIFEST = "job.json"
SHARD_NAME = re.compile(r"shard-\d{12,}-\d{12,}\.npz")
WRITTEN = re.compile(rf"{re.escape(MANIFEST)}|{SHARD_NAME.pattern}")
# Outputs of which a row is a pose, and the column that tells whether it intersects.
POSE_OUTPUTS = {"any": "any", "count": "count", "distance": "distance", "first_contact": "clear"}
STAMP_FIELDS = ("job", "range", "digest")


class DamagedShard(ValueError):
    """A shard's file is not what was written for its range of the job."""


class ShardFolder:
    """The folder of one job.

    `left` has the ranges that are still to be computed, in order, as keys, `damaged` those of them whose file is
    damaged; `intersecting` counts poses that intersect, in the shards that were checked or written.
    """

    def __init__(self, out, job):
        self.path = Path(out)
        known = json.loads(json.dumps({**job.describe(), "file": "npz"}))
        self.manifest = {"format": SHARD_FORMAT, "version": SHARD_VERSION, "hash": _hash_job(known), "job": known}
        self.left = dict.fromkeys(_ranges(known))
        self.damaged: list = []
        self.intersecting = 0

    def open(self, progress):
        """Make the folder, or check the shards that it holds of this job.

        Calls progress("check", done, total) after each. Raises ValueError where it holds another job, a shard of one,
        or something else, and changes nothing; OSError where a shard cannot be read.
        """
        if self.path.exists() and not self.path.is_dir():
            raise ValueError(f"{self.path}: is a file")
        if not self.path.parent.is_dir():
            raise ValueError(f"{self.path}: there is no folder {self.path.parent}")
        self.path.mkdir(exist_ok=True)
        if not (self.path / MANIFEST).exists():
            if set(self.path.iterdir()) - set(find_partial(self.path, WRITTEN)):  # half a manifest may be left
                raise ValueError(f"{self.path}: is not empty and holds no {MANIFEST}")
            with atomic_write(self.path / MANIFEST, "w", encoding="utf-8") as file:
                json.dump(self.manifest, file, indent=1)
            return
        held = _read_manifest(self.path)
        if held["hash"] != self.manifest["hash"]:
            other = [key for key, value in self.manifest["job"].items() if held["job"].get(key) != value]
            raise ValueError(f"{self.path}: holds another job; not the same: {', '.join(other)}")
        shards = _find_shards(self.path, held["job"])
        for done, (part, path) in enumerate(shards.items(), start=1):
            try:
                counts = _read_shard(path, held, *part, read=partial(_count_poses, held["job"]))
                self.intersecting += sum(counts.values())
                del self.left[part]
            except DamagedShard:
                self.damaged.append(part)
            progress("check", done, len(shards))

    def write(self, start, stop, columns):
        """Write the shard of a range; raise RuntimeError for columns of another, OSError where it cannot be written."""
        job = self.manifest["job"]
        intersecting = sum(_count_poses(job, name, values) for name, values in columns.items())
        fault = _row_fault(job, {len(values) for values in columns.values()}, start, stop)
        if fault:
            raise RuntimeError(f"shard {start} to {stop} was answered with {fault}")
        digest = hashlib.sha256()
        for name, values in columns.items():
            _add_column(digest, name, values)
        stamp = {"job": self.manifest["hash"], "range": f"{start} {stop}"}
        stamp["digest"] = _close_digest(digest, stamp["job"], stamp["range"])
        with atomic_write(self.path / _shard_name(start, stop)) as file:
            arrays: dict[str, Any] = {name: np.array(text) for name, text in stamp.items()}
            np.savez(file, **arrays, **columns)
        self.intersecting += intersecting


def read_shards(out) -> Iterator[tuple[int, int, dict]]:
    """Yield (start, stop, columns) of each shard of a finished job, in order; columns are arrays by name.

    A row is a pose, from `start` on, with the columns of `sweep`; for "faces" and "contacts" a face pair, with its pose
    in the column `pose`. Each shard is checked first.

    Raises:
        ValueError: No such folder, shards are missing, or a shard is damaged, altered or of another job; it names the
            file.
        OSError: A shard cannot be read.
    """
    path = Path(out)
    manifest = _read_manifest(path)
    shards, ranges = _find_shards(path, manifest["job"]), _ranges(manifest["job"])
    missing = len(ranges) - len(shards)
    if missing:
        raise ValueError(f"{path}: {missing} of {len(ranges)} shards are missing; run the job again to finish it")
    for start, stop in ranges:
        try:
            columns = _read_shard(shards[start, stop], manifest, start, stop)
        except DamagedShard as error:
            raise ValueError(f"{error}; run the job again to do this shard anew") from None
        yield start, stop, columns
        del columns  # only one shard is held


# Shards.


def _read_shard(path, manifest, start, stop, read=lambda name, values: values) -> dict:
    """Check a shard and return its columns, or what `read` makes of each.

    Raises DamagedShard for what was not written for this range, ValueError for another job's, OSError.
    """
    stamp, columns, rows, digest = {}, {}, set(), hashlib.sha256()
    with open(path, "rb") as file:
        try:
            for name, values in _read_npz(file):
                if name in STAMP_FIELDS:
                    stamp[name] = str(values)
                    continue
                _add_column(digest, name, values)
                rows.add(len(values))
                columns[name] = read(name, values)
                del values  # frees it before the next is read
        except MemoryError:
            raise
        except Exception as error:  # readers raise many types on damaged data
            raise DamagedShard(f"{path}: damaged ({first_line(error)})") from None
    if set(stamp) != set(STAMP_FIELDS) or stamp["digest"] != _close_digest(digest, stamp["job"], stamp["range"]):
        raise DamagedShard(f"{path}: damaged or altered")
    if stamp["job"] != manifest["hash"]:
        raise ValueError(f"{path}: a shard of another job")
    if stamp["range"] != f"{start} {stop}":
        raise DamagedShard(f"{path}: holds the range {stamp['range']}")
    fault = _row_fault(manifest["job"], rows, start, stop)
    if fault:
        raise DamagedShard(f"{path}: holds {fault}")
    return columns


def _read_npz(file):
    """Yield names and arrays."""
    with zipfile.ZipFile(file) as archive:
        # First, as a damaged header may ask for any amount of memory.
        damaged = archive.testzip()
        if damaged is not None:
            raise ValueError(f"checksum of {damaged}")
        for name in archive.namelist():
            with archive.open(name) as member:
                yield name.removesuffix(".npy"), np.lib.format.read_array(member, allow_pickle=False)


def _add_column(digest, name, values):
    digest.update(f"{name} {values.dtype.str} {values.shape}\n".encode())
    digest.update(np.ascontiguousarray(values))


def _close_digest(digest, job, part) -> str:
    digest.update(f"{job} {part}".encode())
    return digest.hexdigest()


def _row_fault(job, lengths, start, stop) -> str | None:
    """Return what is wrong with the lengths of a shard's columns, or None."""
    if len(lengths) != 1:
        return "columns of different lengths" if lengths else "no columns"
    rows, expected = min(lengths), stop - start
    if job.get("output") in POSE_OUTPUTS and rows != expected:
        return f"{rows} rows, not {expected}"
    return None


def _count_poses(job, name, values) -> int:
    """Return how many poses intersect by a column: yes or no, a number, or the pose of each row, in order.

    Of motions those that are not proved clear.
    """
    if job["output"] in POSE_OUTPUTS:
        meets = values <= 0 if name == "distance" else ~values if name == "clear" else values
        return int(np.count_nonzero(meets)) if name == POSE_OUTPUTS[job["output"]] else 0
    return int(np.count_nonzero(values[1:] != values[:-1])) + bool(len(values)) if name == "pose" else 0


# Names and the manifest.


def _ranges(job) -> list[tuple[int, int]]:
    count, shard = job["count"], job["shard"]
    return [(start, min(start + shard, count)) for start in range(0, count, shard)]


def _shard_name(start, stop) -> str:
    return f"shard-{start:012d}-{stop:012d}.npz"


def _find_shards(path, job) -> dict[tuple[int, int], Path]:
    """Return the file of each range that has one, in order; raise ValueError for a name that is not the job's."""
    held = {entry.name for entry in path.iterdir() if SHARD_NAME.fullmatch(entry.name) and not is_special(entry)}
    names = {part: _shard_name(*part) for part in _ranges(job)}
    for other in sorted(held.difference(names.values())):
        raise ValueError(f"{path / other}: a shard of another job")
    return {part: path / name for part, name in names.items() if name in held}


def _hash_job(job) -> str:
    return hashlib.sha256(json.dumps(job, sort_keys=True).encode()).hexdigest()


def _read_manifest(path) -> dict:
    try:
        held = json.loads((path / MANIFEST).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ValueError(f"{path}: holds no {MANIFEST}") from None
    except ValueError as error:
        raise ValueError(f"{path / MANIFEST}: damaged ({error})") from None
    if not isinstance(held, dict) or (held.get("format"), held.get("version")) != (SHARD_FORMAT, SHARD_VERSION):
        raise ValueError(f"{path / MANIFEST}: not of {SHARD_FORMAT}, version {SHARD_VERSION}")
    if held.get("hash") != _hash_job(held.get("job")):
        raise ValueError(f"{path / MANIFEST}: damaged (the hash is not that of the job)")
    return held
