"""One core against one core: ours beside python-fcl and trimesh, where installed, on posed pairs.

A workload is one model against another at 200 poses, half of them intersecting. Answers are compared before anything is
timed. Times are those that the thread ran. Ours is timed from the launch to the sorted result on the host; a baseline
over a loop of its own calls, objects made before, until the library has its contacts; no face numbers are read from
them. `measure` serves the case `libraries` too.
"""

import numpy as np

import warp_abtree as ab

from ..baselines.fcl import Fcl, Trimesh
from ..meshes import real_meshes
from ..shapes import centre_and_radius, knot, pose_matrices, random_directions, scene_of_poses
from ..timing import one_core, ratio_of, summarise, time_on_host, to_host
from ..verify import count_differences, judge_disputed

REAL = {
    "cow-cow": ("cow", "cow"),
    "bunny-bunny": ("stanford-bunny", "stanford-bunny"),
    "env-rob": ("fcl-env", "fcl-rob"),
}
FULL = {"faces": 5000, "poses": 200, "repeats": 5}
QUICK = {"faces": 300, "poses": 6, "repeats": 1}


def run(device, quick=False):
    """Yield one row a workload and baseline (column peer): differences, queries a second of both, and ratios (ours over
    the peer)."""
    sizes = QUICK if quick else FULL
    knots = ab.Model.from_arrays(*knot(sizes["faces"]), name="knot")
    for name, models in {"knot-knot": (knots, knots), **real_meshes(REAL)}.items():
        matrices = half_in_contact(models, sizes["poses"])
        places = dict.fromkeys(("any", "faces"), np.arange(len(matrices)))
        with one_core() as core:
            answers, rows, times = measure(models, device, (Fcl, Trimesh), matrices, places, sizes["repeats"])
        about = {"workload": name, "core": core, "faces": " x ".join(str(model.face_count) for model in models)}
        about |= {"poses": len(matrices), "meet": answers["any"].any.sum(), "hits": len(answers["faces"].faces)}
        for library, row in rows.items():
            for output, taken in times.items() if "skipped" not in row else ():
                shown = {f"ours_{output}": taken["ours"], f"peer_{output}": taken[library]}
                row |= summarise(shown) | {f"{output}_ratio": ratio_of(taken[library], taken["ours"])}
                row |= {f"{key}_per_s": round(1e3 * len(matrices) / np.median(ms)) for key, ms in shown.items()}
            yield about | {"peer": library} | row


def half_in_contact(models, count):
    """Return matrices of B, half of which make it intersect A: any rotation, its centre in A's box grown by its
    radius."""
    (centre_a, _), (centre_b, radius_b) = map(centre_and_radius, models)
    reach = np.ptp(models[0].mesh_at(models[0].lod_max)[0], axis=0) / 2 + radius_b
    rng, kept = np.random.default_rng(0), {True: [], False: []}
    while min(map(len, kept.values())) < (count + 1) // 2:
        matrices = pose_matrices(np.concatenate([np.zeros((count, 3)), random_directions(rng, count, 4)], 1))
        matrices[:, :3, 3] = centre_a + reach * rng.uniform(-1, 1, (count, 3)) - matrices[:, :3, :3] @ centre_b
        for matrix, intersects in zip(matrices, ab.sweep(*models, matrices, device="cpu"), strict=True):
            kept[bool(intersects)].append(matrix)
    return rng.permutation([*kept[True][: (count + 1) // 2], *kept[False][: count // 2]])


def measure(models, device, kinds, matrices, places, repeats, clock=None, judged=None):
    """Return our results by question, each library's row of differences, and times by question and library.

    Raise a RuntimeError where our outputs differ, or the oracle sides with a library.

    Args:
        kinds: Libraries, as those of `bench.baselines.fcl`.
        matrices: Poses of B, float64 (n, 4, 4).
        places: Which of them each question is asked at: "any" and "faces" at the same ones, and "distances".
        clock, judged: See `time_on_host` and, for most, `judge_disputed`.
    """
    a = models[0].mesh_at(models[0].lod_max)[:2]
    meshes = a, a if models[1] is models[0] else models[1].mesh_at(models[1].lod_max)[:2]
    face_ids = [model.mesh_at(model.lod_max)[2] for model in models]
    scene, pairs = scene_of_poses(device, *models, matrices)
    queries = {output: ab.Query(scene, output, pairs=pairs[places[output]]) for output in ("any", "faces")}
    answers, ours = {}, {output: to_host(query) for output, query in queries.items()}
    if "distances" in places:
        queries["distances"] = apart = ab.DistanceQuery(scene, pairs[places["distances"]])
        ours["distances"] = lambda: (apart.forget(), apart.launch(), apart.result())[2]
    answers |= {question: query.run() for question, query in queries.items()}
    if not np.array_equal(answers["any"].any, answers["faces"].count > 0):
        raise RuntimeError("outputs 'any' and 'faces' of ours differ")
    made, rows, times = {}, {}, {}
    for kind in kinds:
        try:
            made[kind.name] = {question: kind(*meshes, matrices[some]) for question, some in places.items()}
            rows[kind.name] = compare(made[kind.name], answers, meshes, face_ids, matrices[places["faces"]], judged)
        except ImportError as error:
            rows[kind.name] = {"skipped": str(error)}
    for question, call in ours.items():
        asked = {name: getattr(one[question], question, None) for name, one in made.items()}
        calls = {"ours": call} | {name: ask for name, ask in asked.items() if ask}
        times[question] = time_on_host(calls, device, repeats, clock)
        if not np.array_equal(queries[question].result().any, answers[question].any):
            raise RuntimeError(f"the timed answer of {question!r} differs from the checked one")
    return answers, rows, times


def compare(made, answers, meshes, face_ids, matrices, judged) -> dict:
    """Return what a library misses and invents beside our answers, where it answers; the oracle finds none wrong.

    A library numbers the faces of its meshes, which are the models' faces of some indices.
    """
    met, answer = answers["any"].any, np.array(made["any"].any(), bool)
    row = {"any_missed": (met & ~answer).sum(), "any_invented": (answer & ~met).sum()}
    one, far = made["faces"], made.get("distances")
    if hasattr(one, "faces"):
        found, poses = answers["faces"].faces.T, [(np.eye(4), matrix) for matrix in matrices]
        ours = np.stack([found[0], *(np.searchsorted(ids, faces) for ids, faces in zip(face_ids, found[1:]))], 1)
        theirs = list({(pose, *pair) for pose, found in enumerate(one.faces()) for pair in one.face_pairs(found)})
        wrong = judge_disputed(theirs, ours, meshes, poses.__getitem__, one.name, judged)
        row["faces_missed"], row["faces_invented"] = count_differences(theirs, ours)
        row["ours_wrong"] = "not judged" if wrong is None else 0
    if hasattr(far, "distances"):
        error = np.abs(far.distances() - answers["distances"].distance).max()
        row["distance_error"] = error / np.ptp(meshes[0][0], axis=0).max()
    return row
