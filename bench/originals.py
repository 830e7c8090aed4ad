"""Distances of originals from coarse LODs: certified brackets beside the finest LODs, and what refining costs.

Configurations are two LODs of a mesh (of the robot and its surroundings: one of each) and a pose, crossing to far
apart. Each is asked with options that LODs may decide, and its bracket compared with that of the finest LODs at the
default tolerance, which `distance` itself compares with python-fcl.
"""

import time
from functools import partial

import numpy as np
import warp as wp

import warp_abtree as ab

from .meshes import ModelFolder, mesh_file
from .shapes import longest_side, place_at_gaps, pose_matrices, random_poses, scene_of_poses
from .timing import medians, no_garbage_collection, one_core, time_call, time_rounds

MESHES = ("cow", "fandisk", "homer", "rocker-arm", "stanford-bunny", "woody")
ROBOT = ("fcl-env", "fcl-rob")
REFINED = ("rocker-arm", "stanford-bunny")
IDENTITY = (0, 0, 0, 0, 0, 0, 1)
GROUP = 100  # configurations of two LODs
REACH = 0.2, 2.5  # distances of centres, in sizes
ASKED = ({"tolerance": 10.0}, {"tolerance": 0.1}, {"relative": 0.5}, {"relative": 0.1}, {"beyond": 0.3})
TIMED = ({"relative": 0.05}, {"relative": 0.2}, {"tolerance": 0.03}, {"beyond": 0.1, "relative": 0.1})
FRACTIONS = 0.1, 0.01


def run(device, count=None, quick=False):
    """Yield the rows of times, then those of brackets at a number of configurations.

    Raises:
        RuntimeError: A bracket does not hold the distance.
    """
    device, folder = wp.get_device(device), ModelFolder(None)
    for name in [name for name in REFINED if mesh_file(name)][: 1 if quick else None]:
        model = folder.load([name])
        yield from time_refining(name, model, place_at_gaps(model, 4 if quick else 256), device, 1 if quick else 7)
    yield from verify(device, count or (60 if quick else 100_000))


def pairs_at_hand(folder) -> dict:
    """Return pairs of models by name: real meshes, else a mesh of trimesh's."""
    names = {name: (name, name) for name in MESHES} | {"-".join(ROBOT): ROBOT}
    found = {name: pair for name, pair in names.items() if all(map(mesh_file, pair))}
    found = found or {"knot:2000": ("knot:2000", "knot:2000")}
    return {name: tuple(folder.load([one]) for one in pair) for name, pair in found.items()}


def scale_options(options, size) -> dict:
    """Return options whose lengths are given in sizes."""
    return {name: value if name == "relative" else value * size for name, value in options.items()}


def verify(device, count):
    """Yield one row a mesh: configurations, how many LODs decided, and violations of the bracket.

    Raises:
        RuntimeError: There was a violation.
    """
    rng, pairs = np.random.default_rng(0), pairs_at_hand(ModelFolder(None))
    violations = 0
    for name, models in pairs.items():
        row = {"device": device.name, "workload": f"brackets of originals, {name}", "configurations": 0, "decided": 0}
        row |= {"meet": 0, "violations": 0}
        while row["configurations"] < count / len(pairs):
            some = min(GROUP, int(np.ceil(count / len(pairs))) - row["configurations"])
            for key, value in check_group(rng, models, some, device).items():
                row[key] += value
        violations += row["violations"]
        yield row
    if violations:
        raise RuntimeError(f"{violations} brackets do not hold the distance of the originals")


def check_group(rng, models, count, device) -> dict:
    """Ask configurations of two LODs; return counts."""
    size = max(map(longest_side, models))
    lods = [model.lod_for(fraction=float(10 ** rng.uniform(-3, -0.1))) for model in models]
    poses = random_poses(0.0, count, seed=int(rng.integers(2**31)))
    away = rng.normal(size=(count, 3))
    away *= size * rng.uniform(*REACH, (count, 1)) / np.linalg.norm(away, axis=1, keepdims=True)
    middle = [(m.mesh_at(m.lod_max)[0].max(0) + m.mesh_at(m.lod_max)[0].min(0)) / 2 for m in models]
    matrices = pose_matrices(poses)
    matrices[:, :3, 3] = middle[0] + away - np.einsum("nij,j->ni", matrices[:, :3, :3], middle[1])
    truth = ab.sweep(*models, matrices, output="distance", device=device)
    options = scale_options(ASKED[rng.integers(len(ASKED))], size)
    found = ab.sweep(*models, matrices, *lods, output="distance", device=device, originals=True, **options)
    (lower, upper), (least, most) = found["bracket"].T, truth["bracket"].T
    wrong = (lower > most) | (upper < least) | ((found["distance"] == 0) != (truth["distance"] == 0))
    wrong |= found["distance"] < least
    # Brackets of the finest LODs are as wide as was asked, and reach to 0 where that is more than the distance.
    near = np.where(np.isfinite(upper), found["distance"], 0.0)
    wide = np.maximum(options.get("tolerance", 0.0), options.get("relative", 0.0) * near)
    decided = (lower > 0) & (upper - lower < 0.999 * wide)
    counts = {"configurations": count, "decided": decided, "meet": truth["distance"] == 0, "violations": wrong}
    return {name: int(np.sum(value)) for name, value in counts.items()}


class Moving:
    """A scene of a mesh and many others of it at a LOD, in two sets of poses in turn."""

    def __init__(self, device, model, matrices, lod):
        rows = np.concatenate([np.eye(4)[None], matrices])
        self.sets = [rows, np.concatenate([rows[:1], np.roll(rows[1:], len(matrices) // 2, axis=0)])]
        self.scene, self.pairs = scene_of_poses(device, model, model, [IDENTITY] * len(matrices))
        self.lods = {name: np.full(len(rows), value) for name, value in (("own", lod), ("finest", model.lod_max))}
        self.scene.set_poses(rows)
        self.scene.set_lods(self.lods["own"])

    def ask(self, **asked):
        """Ask distances at the other set of poses."""
        self.sets.reverse()
        self.scene.set_poses(self.sets[0])
        return self.scene.intersect(self.pairs, "distance", **asked)

    def ask_finest(self, **asked):
        """Ask at the finest LODs, and go back."""
        self.scene.set_lods(self.lods["finest"])
        self.ask(**asked)
        self.scene.set_lods(self.lods["own"])


def time_refining(name, model, matrices, device, repeats):
    """Yield one row a fraction of the faces and options: times of a pose [ms], all poses at once, others each time.

    Of objects at their finest LODs; of objects at a coarse LOD that are brought to the finest and back; of originals
    while objects stay at the coarse LOD; and of the first such call of a scene, with what it makes.
    """
    for fraction in FRACTIONS:
        lod = model.lod_for(fraction=fraction)
        fine, moved, kept = (Moving(device, model, matrices, k) for k in (model.lod_max, lod, lod))
        for options in TIMED:
            asked = scale_options(options, longest_side(model))
            row = {"device": device.name, "workload": f"originals of {name}, LODs of {fraction:.0%} of the faces"}
            row |= {"poses": len(matrices), "asked": " ".join(f"{key} {value}" for key, value in options.items())}
            calls = {
                "finest": partial(fine.ask, **asked),
                "moved": partial(moved.ask_finest, **asked),
                "originals": partial(kept.ask, originals=True, **asked),
            }
            kept.ask(originals=True)  # makes the tree states at the finest LODs
            with one_core(), no_garbage_collection():
                runs = {key: time_call(call, device, time.thread_time) for key, call in calls.items()}
                times = medians(time_rounds(runs, repeats))
                first = [
                    time_call(partial(scene.ask, originals=True, **asked), device, time.thread_time)()
                    for scene in (Moving(device, model, matrices, lod) for _ in range(3))
                ]
            times = {key: value / len(matrices) for key, value in (times | {"first": np.median(first)}).items()}
            row |= {f"{key}_ms": float(f"{value:.3g}") for key, value in times.items()}
            yield row | {
                "finest_ratio": round(times["originals"] / times["finest"], 2),
                "moved_ratio": round(times["originals"] / times["moved"], 2),
            }
