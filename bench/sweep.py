"""Yes or no for one pair of models at many random poses: the launch by itself, and `sweep` with its transfers."""

import os
import time
from pathlib import Path

import numpy as np
import warp as wp

import warp_abtree as ab

from .shapes import knot
from .timing import time_in_turn

FULL = {"faces": 5000, "counts": (1024, 65536), "repeats": 11}
QUICK = {"faces": 300, "counts": (16,), "repeats": 1}


def models(sizes):
    """Yield the knot, and the cow if the folder in ABTREE_MESHES has it."""
    model = ab.Model.from_arrays(*knot(sizes["faces"]))
    yield f"knot {model.face_count:,}", model
    cow = Path(os.environ.get("ABTREE_MESHES", "")) / "cow.obj.gz"
    if cow.is_file():
        yield "cow 5,804", ab.Model.load(cow)


def random_poses(count, size, seed=0):
    """Return float64 (count, 7): any rotation, positions in a cube whose side is twice a size."""
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(count, 4))
    return np.concatenate([size * rng.uniform(-1, 1, (count, 3)), q / np.linalg.norm(q, axis=1, keepdims=True)], 1)


def run(device, quick=False):
    """Yield one row a model and number of poses: share that meets, million poses a second, launch alone and `sweep`."""
    device = wp.get_device(device)
    sizes = QUICK if quick else FULL
    for name, model in models(sizes):
        for count in sizes["counts"]:
            poses = random_poses(count, np.ptp(model.mesh_at(model.lod_max)[0], axis=0).max())
            scene = ab.Scene(device)
            scene.add(model)
            for pose in poses:
                scene.add(model, pose)
            query = ab.Query(scene, "any", pairs=[(0, i + 1) for i in range(count)])
            result = query.run()
            (times,) = time_in_turn({"any": query.launch}, device, sizes["repeats"]).values()
            ab.sweep(model, model, poses, device=device)
            begin = time.perf_counter()
            found = ab.sweep(model, model, poses, device=device)
            whole = time.perf_counter() - begin
            if not np.array_equal(found, result.any):
                raise RuntimeError("the sweep and the query differ")
            row = {"device": device.name, "model": name, "poses": count, "meet": round(float(found.mean()), 4)}
            row["launch_ms"] = round(float(np.median(times)), 4)
            row["launch_mposes_s"] = round(count / float(np.median(times)) / 1e3, 3)
            row["sweep_mposes_s"] = round(count / whole / 1e6, 3)
            yield row
