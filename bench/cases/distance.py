"""Least distances: real meshes at gaps, a nut free on its bolt, and knots at random poses; python-fcl beside them.

Gaps are fractions of the mesh's size, poses otherwise random. Times are of a pose: of all poses at once, where each
search starts anew (fresh) or from the faces of the launch before (again), and of one pair alone, launched to the
result on the host. On the CPU all on one core, beside python-fcl, whose answers must be ours but for rounding.

The part `gap` is contacts with a gap: `bench.gap_contacts`.
"""

import time

import numpy as np
import warp as wp

import warp_abtree as ab

from .. import gap_contacts
from ..baselines.fcl import Fcl
from ..meshes import ModelFolder, knot_model, mesh_file
from ..shapes import longest_side, pose_matrices, random_poses, scene_of_poses
from ..timing import medians, no_garbage_collection, one_core, time_in_turn
from .assembly import place_nut

FULL = {"poses": 32, "counts": (1, 1024, 65536), "knot": 5000, "repeats": 7}
CPU = FULL | {"counts": (1, 1024)}
QUICK = {"poses": 3, "counts": (3,), "knot": 300, "repeats": 1}
PARTS = ("nearest", "gap")
GAPS = 0.3, 0.01  # of the size, first and last
IDENTITY = (0, 0, 0, 0, 0, 0, 1)
MESHES = ("cow", "rocker-arm", "stanford-bunny")
NUT = ("factory-bolt-m20", "factory-nut-m20")
LAUNCHES_BEFORE = 20  # of the pair alone, as in a loop that goes on: slabs are made of what is asked often
STEPS = 25  # of the bisection that places a pose at a gap


def run(device, quick=False, only=PARTS):
    """Yield a row a workload: times [ms] and what the searches took; of baselines, where they are at hand."""
    if "nearest" in only:
        yield from measure_all(wp.get_device(device), quick)
    if "gap" in only:
        yield from gap_contacts.run(device, quick)


def measure_all(device, quick):
    """Yield the rows of distances."""
    sizes = QUICK if quick else CPU if device.is_cpu else FULL
    folder = ModelFolder(None)
    at_hand = [name for name in MESHES if mesh_file(name)]
    for name in at_hand[:1] if quick else at_hand:
        model = folder.load([name])
        yield measure(name, [model, model], place_at_gaps(model, sizes["poses"]), device, sizes["repeats"])
    if all(map(mesh_file, NUT)) and not quick:
        models = [folder.load([name]) for name in NUT]
        matrices = place_nut(models, sizes["poses"])["free"]
        yield measure("nut on bolt, free", models, matrices, device, sizes["repeats"])
    knots = knot_model(sizes["knot"])
    for count in sizes["counts"]:
        matrices = pose_matrices(random_poses(longest_side(knots), count))
        yield measure(f"knot, {count} poses", [knots, knots], matrices, device, sizes["repeats"])


def place_at_gaps(model, count):
    """Return random poses of B, moved away from A until as far apart as gaps that lie evenly in their logarithm."""
    size, rng = longest_side(model), np.random.default_rng(0)
    matrices = pose_matrices(random_poses(0.0, count))
    away = rng.normal(size=(count, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    vertices = model.mesh_at(model.lod_max)[0]
    middle = (vertices.max(0) + vertices.min(0)) / 2
    start = middle - np.einsum("nij,j->ni", matrices[:, :3, :3], middle)
    low, high, gaps = np.zeros(count), np.full(count, 3 * size), size * np.geomspace(*GAPS, count)
    for _ in range(STEPS):
        far = (low + high) / 2
        matrices[:, :3, 3] = start + far[:, None] * away
        wide = ab.sweep(model, model, matrices, output="distance", device="cpu")["distance"] > gaps
        low, high = np.where(wide, low, far), np.where(wide, far, high)
    matrices[:, :3, 3] = start + high[:, None] * away
    return matrices


def measure(name, models, matrices, device, repeats):
    """Return the row of one workload.

    Raises:
        RuntimeError: A baseline's distance is another, by more than float64's rounding of the sizes.
    """
    scene, pairs = scene_of_poses(device, *models, [IDENTITY] * len(matrices))
    scene.set_poses(np.concatenate([np.eye(4)[None], matrices]))
    query, fresh = ab.DistanceQuery(scene, pairs), ab.DistanceQuery(scene, pairs)
    middle = slice(len(pairs) // 2, len(pairs) // 2 + 1)
    one = ab.DistanceQuery(scene, pairs[middle])
    found = fresh.run()
    query.run()
    for _ in range(LAUNCHES_BEFORE):
        one.launch()
    row = {"device": device.name, "workload": name, "faces": " x ".join(str(model.face_count) for model in models)}
    row |= {"poses": len(pairs), "meet": int(found.any.sum()), "median_gap": float(np.median(found.distance))}
    row |= {"node_tests": round(found.node_tests.mean(), 1), "face_tests": round(found.triangle_tests.mean(), 1)}

    def launch_fresh():
        fresh.forget()
        fresh.launch()

    launches = {"fresh": launch_fresh, "again": query.launch, "one": lambda: (one.forget(), one.launch())}
    with one_core():
        if device.is_cpu:
            try:
                fcl = make_fcl(models, matrices, found, row)
                launches |= {"fcl": fcl.distances, "fcl_one": lambda: fcl.distances(middle)}
            except ImportError as error:
                row["fcl_skipped"] = str(error)
        with no_garbage_collection():
            times = medians(time_in_turn(launches, device, repeats, time.thread_time))
    per = {key: time if key.endswith("one") else time / len(pairs) for key, time in times.items()}
    row |= {f"{key}_ms": float(f"{value:.4g}") for key, value in per.items()}
    for key, base in (("fresh", "fcl"), ("again", "fcl"), ("one", "fcl_one")):
        if base in per:
            row[f"{key}_fcl_ratio"] = round(per[base] / per[key], 2)
    return row


def make_fcl(models, matrices, found, row):
    """Return python-fcl, after comparing its distances with ours."""
    meshes = [model.mesh_at(model.lod_max)[:2] for model in models]
    fcl = Fcl(*meshes, matrices)
    apart = ~found.any
    error = np.abs(fcl.distances() - found.distance)[apart].max(initial=0.0)
    size = max(longest_side(model) for model in models)
    if error > 1e-12 * size:
        raise RuntimeError(f"python-fcl's distances differ by {error / size} of the size")
    row["fcl_differs"] = float(f"{error / size:.2g}")
    return fcl
