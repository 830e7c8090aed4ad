"""Least distances: real meshes at gaps, a nut free on its bolt, and knots at random poses; python-fcl beside them.

Gaps are fractions of the mesh's size, poses otherwise random. Times are of a pose: of all poses at once, where each
search starts anew (fresh) or from the faces of the launch before (again), and of one pair alone, searched anew, by
launches from Python (one) and as a captured graph (one_graph, on the CPU; on CUDA all are); on the CPU also of one pair
that is brought from pose to pose, each a call of `Scene.set_poses` and `DistanceQuery.run` (calls). On the CPU all on
one core, beside python-fcl, whose answers must be ours but for rounding.

The part `gap` is contacts with a gap: `bench.gap_contacts`.
"""

import time
from functools import partial

import numpy as np
import warp as wp

import warp_abtree as ab
from warp_abtree import testing

from .. import gap_contacts
from ..baselines.fcl import Fcl
from ..meshes import ModelFolder, knot_model, mesh_file
from ..shapes import longest_side, place_at_gaps, pose_matrices, random_poses, scene_of_poses
from ..timing import make_replay, medians, no_garbage_collection, one_core, time_in_turn
from .assembly import place_nut

FULL = {"poses": 32, "counts": (1, 1024, 65536), "knot": 5000, "repeats": 7}
CPU = FULL | {"counts": (1, 1024)}
QUICK = {"poses": 3, "counts": (3,), "knot": 300, "repeats": 1}
PARTS = ("nearest", "gap")
MESHES = ("cow", "rocker-arm", "stanford-bunny")
NUT = ("factory-bolt-m20", "factory-nut-m20")
BASES = ("fresh", "fcl"), ("again", "fcl"), ("calls", "fcl"), ("one", "fcl_one"), ("one_graph", "fcl_one")
LAUNCHES_BEFORE = 20  # of the pair alone, as in a loop that goes on: slabs are made of what is asked often


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


def measure(name, models, matrices, device, repeats):
    """Return the row of one workload.

    Raises:
        RuntimeError: A baseline's distance is another, by more than float64's rounding of the sizes.
    """
    scene, pairs = scene_of_poses(device, *models, matrices)
    query, fresh = ab.DistanceQuery(scene, pairs), ab.DistanceQuery(scene, pairs)
    middle = slice(len(pairs) // 2, len(pairs) // 2 + 1)
    one = ab.DistanceQuery(scene, pairs[middle])
    found = fresh.run()
    query.run()
    for _ in range(LAUNCHES_BEFORE):
        one.launch()
    row = {"device": device.name, "workload": name, "faces": " x ".join(str(model.face_count) for model in models)}
    row |= {"poses": len(pairs), "meet": found.any.sum(), "median_gap": np.median(found.distance)}
    row |= {"node_tests": found.node_tests.mean(), "face_tests": found.triangle_tests.mean()}
    launch_fresh, launch_one = (partial(launch_anew, query) for query in (fresh, one))
    with one_core(), testing.regime(cpu_threads=1):
        # Either comes after a whole batch: what it needs is as far from the core.
        launches = {"fresh": launch_fresh}
        if device.is_cpu:
            launches["one_graph"] = make_replay(launch_one, device, captured=True)
        launches |= {"again": query.launch, "one": launch_one}
        if device.is_cpu:
            launches["calls"] = make_calls(models, matrices, device)
            try:
                fcl = make_fcl(models, matrices, found, row)
                launches |= {"fcl": fcl.distances, "fcl_one": lambda: fcl.distances(middle)}
            except ImportError as error:
                row["fcl_skipped"] = str(error)
        with no_garbage_collection():
            times = medians(time_in_turn(launches, device, repeats, time.thread_time))
    per = {key: time if "one" in key else time / len(pairs) for key, time in times.items()}
    row |= {f"{key}_ms": value for key, value in per.items()}
    return row | {f"{key}_fcl_ratio": round(per[base] / per[key], 2) for key, base in BASES if base in per}


def launch_anew(query):
    """Launch a query whose searches start anew."""
    query.forget()
    query.launch()


def make_calls(models, matrices, device):
    """Return a callable that brings one pair from pose to pose, and reads its distance at each."""
    scene, pairs = scene_of_poses(device, *models, matrices[:1])
    query = ab.DistanceQuery(scene, pairs)
    poses = [np.stack([np.eye(4), matrix]) for matrix in matrices]

    def call_each():
        for both in poses:
            scene.set_poses(both)
            query.run()

    call_each()
    return call_each


def make_fcl(models, matrices, found, row):
    """Return python-fcl, after comparing its distances with ours."""
    meshes = [model.mesh_at(model.lod_max)[:2] for model in models]
    fcl = Fcl(*meshes, matrices)
    apart = ~found.any
    error = np.abs(fcl.distances() - found.distance)[apart].max(initial=0.0)
    size = max(longest_side(model) for model in models)
    if error > 1e-12 * size:
        raise RuntimeError(f"python-fcl's distances differ by {error / size} of the size")
    row["fcl_differs"] = error / size
    return fcl
