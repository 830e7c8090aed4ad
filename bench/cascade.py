"""Do the original meshes intersect: coarse levels of detail asked first, beside the originals at once.

One model against another in random rotations and directions, B a given distance further out than where it last touches
A on its way out, so at most so far away. Shares settled and times of `ab.Cascade` at 1, 5 and 20 % of the faces, each
alone and one after the other, and of `ab.Query` at the finest LODs: launches alone. On the CPU one core.
"""

import os
from pathlib import Path

import numpy as np
import warp as wp

import warp_abtree as ab

from .peers import one_core
from .roofline import used_memory
from .shapes import knot
from .timing import time_in_turn

SHARES = (0.01, 0.05, 0.2)
REAL = {
    "cow": ("cow", "cow"),
    "fandisk": ("fandisk", "fandisk"),
    "homer": ("homer", "homer"),
    "rocker-arm": ("rocker-arm", "rocker-arm"),
    "bunny": ("stanford-bunny", "stanford-bunny"),
    "env-rob": ("fcl-env", "fcl-rob"),
}
# Of A's longest side; below 0 the meshes overlap.
GAPS = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001, 0.0, -0.02)
FULL = {"knots": (5000, 60000), "gaps": GAPS, "pairs": {"cpu": 200, "cuda": 8192}, "steps": 32, "repeats": 5}
QUICK = {"knots": (300,), "gaps": (0.1, 0.0, -0.1), "pairs": {"cpu": 8, "cuda": 8}, "steps": 8, "repeats": 1}


def workloads(knots):
    """Yield (name, model of A, model of B): knots, and what the folder in ABTREE_MESHES has of the real meshes."""
    for face_target in knots:
        model = ab.Model.from_arrays(*knot(face_target))
        yield "knot", model, model
    folder = Path(os.environ.get("ABTREE_MESHES", ""))
    for name, stems in REAL.items():
        files = [folder / f"{stem}.obj.gz" for stem in stems]
        if all(file.is_file() for file in files):
            models = {file: ab.Model.load(file) for file in files}
            yield name, *(models[file] for file in files)


def centre_and_radius(model):
    points = model.mesh_at(model.lod_max)[0]
    centre = (points.min(0) + points.max(0)) / 2
    return centre, np.linalg.norm(points - centre, axis=1).max()


class Approach:
    """Poses of B around A, object 0 of a scene, each along a direction of its own."""

    def __init__(self, scene, model_a, model_b, count, steps, seed=0):
        rng = np.random.default_rng(seed)
        (self.centre_a, radius_a), (self.centre_b, radius_b) = map(centre_and_radius, (model_a, model_b))
        away = rng.normal(size=(count, 3))
        self.away = away / np.linalg.norm(away, axis=1, keepdims=True)
        x, y, z, w = (lambda q: q / np.linalg.norm(q, axis=0))(rng.normal(size=(4, count)))
        self.matrices = np.tile(np.eye(4), (count + 1, 1, 1))
        self.matrices[1:, 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], 1)
        self.matrices[1:, 1, :3] = np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], 1)
        self.matrices[1:, 2, :3] = np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], 1)
        self.scene = scene
        self.pairs = np.stack([np.zeros(count, np.int32), np.arange(1, count + 1, dtype=np.int32)], 1)
        self._find_contact(radius_a + radius_b, steps)

    def _find_contact(self, reach, steps):
        """Find where B is last in contact on its way out, by steps and then by bisection, and first is not."""
        query = ab.Query(self.scene, "any", pairs=self.pairs)

        def meets(along):
            self.place(along)
            return query.run().any

        low = np.zeros(len(self.pairs))
        for along in np.linspace(0, reach, steps):
            low = np.where(meets(np.full(len(low), along)), along, low)
        high = low + reach / (steps - 1)
        for _ in range(50):
            middle = (low + high) / 2
            met = meets(middle)
            low, high = np.where(met, middle, low), np.where(met, high, middle)
        self.free = high

    def place(self, along):
        """Pose every B with its centre a distance [model units] from A's."""
        self.matrices[1:, :3, 3] = (
            self.centre_a + along[:, None] * self.away - self.matrices[1:, :3, :3] @ self.centre_b
        )
        self.scene.set_poses(self.matrices)


def run(device, quick=False):
    """Yield one row a workload and gap: shares settled, box pairs compared, times a pair [us], ratios and memory."""
    device = wp.get_device(device)
    sizes = QUICK if quick else FULL
    with one_core() as core:
        for name, model_a, model_b in workloads(sizes["knots"]):
            about = {"device": device.name, "core": core, "workload": name}
            about["faces"] = f"{model_a.face_count} x {model_b.face_count}"
            yield from run_workload(about, model_a, model_b, device, sizes)


def run_workload(about, model_a, model_b, device, sizes):
    count = sizes["pairs"]["cuda" if device.is_cuda else "cpu"]
    scene = ab.Scene(device)
    scene.add(model_a)
    for _ in range(count):
        scene.add(model_b)
    approach = Approach(scene, model_a, model_b, count, sizes["steps"])
    pairs = approach.pairs
    size = np.ptp(model_a.mesh_at(model_a.lod_max)[0], axis=0).max()
    queries = {"originals": ab.Query(scene, "any", pairs=pairs)}
    queries["faces_originals"] = ab.Query(scene, "faces", pairs=pairs)
    for share in SHARES:
        queries[f"cascade_{100 * share:g}"] = ab.Cascade(scene, "any", pairs, (share,))
    queries["cascade_all"] = ab.Cascade(scene, "any", pairs, SHARES)
    queries["faces_cascade_20"] = ab.Cascade(scene, "faces", pairs, SHARES[-1:])
    for gap in sizes["gaps"]:
        approach.place(approach.free + gap * size)
        found = {who: query.run() for who, query in queries.items()}
        check_answers(found)
        times = time_in_turn({who: query.launch for who, query in queries.items()}, device, sizes["repeats"])
        row = about | {"pairs": count, "gap": gap, "meet": round(float(found["originals"].any.mean()), 3)}
        for share in SHARES:
            row[f"settled_{100 * share:g}"] = round(float(found[f"cascade_{100 * share:g}"].apart.mean()), 3)
        row["node_tests"] = round(float(found["originals"].node_tests.mean()), 1)
        for share in SHARES:
            row[f"proof_node_tests_{100 * share:g}"] = round(
                float(found[f"cascade_{100 * share:g}"].proof_node_tests.mean()), 1
            )
        for who, values in times.items():
            row[f"{who}_us"] = round(1e3 * float(np.median(values)) / count, 3)
            row[f"{who}_p95_us"] = round(1e3 * float(np.percentile(values, 95)) / count, 3)
        for who in queries:
            base = "faces_originals" if who.startswith("faces") else "originals"
            if who != base:
                row[f"{who}_speed"] = round(row[f"{base}_us"] / row[f"{who}_us"], 2)
        row["node_tests_per_s"] = float(f"{1e6 * row['node_tests'] / row['originals_us']:.4g}")
        yield row | used_memory(device)


def check_answers(found):
    """Compare what all queries found.

    Raises:
        RuntimeError: A cascade differs from the originals.
    """
    for who, result in found.items():
        if not np.array_equal(result.any, found["originals"].any):
            raise RuntimeError(f"{who} and the originals differ in which pairs meet")
    if not np.array_equal(found["faces_cascade_20"].faces, found["faces_originals"].faces):
        raise RuntimeError("the cascade and the originals differ in the faces that meet")
