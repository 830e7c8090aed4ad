"""One core against one core: ours beside python-fcl and trimesh, where installed, on posed pairs.

A workload is one model against another at 200 poses, half of them intersecting. Answers are compared before anything is
timed. Times are those that the thread ran. Ours is timed from the launch to the sorted result on the host; a baseline
over a loop of its own calls, objects made before, until the library has its contacts; no face numbers are read from
them.
"""

import numpy as np

import warp_abtree as ab

from ..baselines.fcl import Fcl, Trimesh
from ..meshes import real_meshes
from ..shapes import centre_and_radius, knot, pose_matrices, random_directions, scene_of_poses
from ..timing import one_core, ratio_of, summarise, time_on_host, to_host
from ..verify import judge_disputed

REAL = {
    "cow-cow": ("cow", "cow"),
    "bunny-bunny": ("stanford-bunny", "stanford-bunny"),
    "env-rob": ("fcl-env", "fcl-rob"),
}
FULL = {"faces": 5000, "poses": 200, "repeats": 5}
QUICK = {"faces": 300, "poses": 6, "repeats": 1}
BASELINES = (Fcl, Trimesh)


def run(device, quick=False):
    """Yield one row a workload and baseline (column peer): differences, queries a second of both, and ratios (ours over
    the peer)."""
    sizes = QUICK if quick else FULL
    knots = ab.Model.from_arrays(*knot(sizes["faces"]), name="knot")
    for name, models in {"knot-knot": (knots, knots), **real_meshes(REAL)}.items():
        with one_core() as core:
            for row in measure(models, device, sizes["poses"], sizes["repeats"]):
                yield {"workload": name, "core": core} | row


def random_matrices(rng, model_a, model_b, count):
    """Return float64 (count, 4, 4): any rotation, B's centre in A's box grown by B's radius."""
    (centre_a, _), (centre_b, radius_b) = map(centre_and_radius, (model_a, model_b))
    reach = np.ptp(model_a.mesh_at(model_a.lod_max)[0], axis=0) / 2 + radius_b
    matrices = pose_matrices(np.concatenate([np.zeros((count, 3)), random_directions(rng, count, 4)], 1))
    matrices[:, :3, 3] = centre_a + reach * rng.uniform(-1, 1, (count, 3)) - matrices[:, :3, :3] @ centre_b
    return matrices


def half_in_contact(models, count):
    """Return matrices of B, half of which make it intersect A."""
    rng, kept = np.random.default_rng(0), {True: [], False: []}
    while min(map(len, kept.values())) < (count + 1) // 2:
        matrices = random_matrices(rng, *models, count)
        for matrix, intersects in zip(matrices, ab.sweep(*models, matrices, device="cpu"), strict=True):
            kept[bool(intersects)].append(matrix)
    return rng.permutation([*kept[True][: (count + 1) // 2], *kept[False][: count // 2]])


def measure(models, device, count, repeats):
    """Yield one row a baseline; raise a RuntimeError where our outputs differ, or the oracle sides with a baseline."""
    a = models[0].mesh_at(models[0].lod_max)[:2]
    meshes = a, a if models[1] is models[0] else models[1].mesh_at(models[1].lod_max)[:2]
    matrices = half_in_contact(models, count)
    scene, pairs = scene_of_poses(device, *models, matrices)
    queries = {output: ab.Query(scene, output, pairs=pairs) for output in ("any", "faces")}
    answers = {output: query.run() for output, query in queries.items()}
    any_hit, faces = answers["any"].any, answers["faces"].faces
    if not np.array_equal(any_hit, answers["faces"].count > 0):
        raise RuntimeError("outputs 'any' and 'faces' of ours differ")
    about = {"faces": " x ".join(str(len(mesh[1])) for mesh in meshes), "poses": count}
    about |= {"meet": any_hit.sum(), "hits": len(faces)}
    made, rows = {}, {}
    for kind in BASELINES:
        try:
            made[kind.name] = kind(*meshes, matrices)
            rows[kind.name] = compare(made[kind.name], any_hit, faces, meshes, matrices)
        except ImportError as error:
            rows[kind.name] = {"skipped": str(error)}
    for output, query in queries.items():
        launches = {"ours": to_host(query)} | {name: getattr(one, output) for name, one in made.items()}
        times = time_on_host(launches, device, repeats)
        if not np.array_equal(query.result().any, any_hit):
            raise RuntimeError(f"the timed answer of {output!r} differs from the checked one")
        for name in made:
            shown = {f"ours_{output}": times["ours"], f"peer_{output}": times[name]}
            rows[name] |= summarise(shown) | {f"{output}_ratio": ratio_of(times[name], times["ours"])}
            rows[name] |= {f"{key}_per_s": round(1e3 * count / np.median(ms)) for key, ms in shown.items()}
    for name, row in rows.items():
        yield about | {"peer": name} | row


def compare(baseline, found_any, found_faces, meshes, matrices):
    """Return what a baseline misses and invents beside our answers, which the oracle must not find wrong."""
    answer = np.array(baseline.any(), bool)
    ours = {tuple(row) for row in found_faces.tolist()}
    theirs = {(pose, *pair) for pose, one in enumerate(baseline.faces()) for pair in baseline.face_pairs(one)}
    judged = judge_disputed(list(theirs), list(ours), meshes, lambda pose: (np.eye(4), matrices[pose]), baseline.name)
    row = {"any_missed": (found_any & ~answer).sum(), "any_invented": (answer & ~found_any).sum()}
    row |= {"faces_missed": len(ours - theirs), "faces_invented": len(theirs - ours)}
    return row | {"ours_wrong": "not judged" if judged is None else 0}
