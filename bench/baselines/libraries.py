"""One core, library beside library: yes or no, all face pairs and distances of two meshes at 60 poses [us a pose].

Half of the poses of the first two questions intersect; distances are at poses that do not. All are asked pose by pose
but ours and py-parry3d, which take all poses in one call. Times are those that all threads of the process ran, which
share one core, in turn. Answers are compared first: face pairs on which a library differs from ours are judged by the
exact oracle of the tests. Libraries that are not installed (extra `peers`) are named in `skipped`.
"""

import time

import numpy as np

import warp_abtree as ab

from ..cases.baselines import half_in_contact
from ..meshes import real_meshes
from ..shapes import knot, scene_of_poses
from ..timing import one_core, time_on_host, to_host
from ..verify import judge_disputed
from .coal import Coal
from .fcl import Fcl
from .meshlib import MeshLib
from .parry import Parry
from .trueform import Trueform

REAL = {name: (name, name) for name in ("cow", "stanford-bunny", "fandisk")}
FULL = {"poses": 60, "repeats": 5, "judged": 400}
QUICK = {"poses": 6, "repeats": 1, "judged": 50}
KINDS = (Fcl, Coal, MeshLib, Trueform, Parry)
QUESTIONS = ("any", "faces", "distances")


def run(device, quick=False):
    """Yield a row a workload and library: times [us a pose], and its answers that are not ours."""
    sizes = QUICK if quick else FULL
    knots = ab.Model.from_arrays(*knot(300 if quick else 5000), name="knot")
    workloads = {"knot": (knots, knots), **({} if quick else real_meshes(REAL))}
    for name, models in workloads.items():
        with one_core() as core:
            for row in measure(models, device, **sizes):
                yield {"workload": name, "core": core} | row


def measure(models, device, poses, repeats, judged):
    """Yield one row a library; raise a RuntimeError where the oracle sides with a library against ours."""
    mesh = models[0].mesh_at(models[0].lod_max)[:2]
    matrices = half_in_contact(models, 2 * poses)
    scene, pairs = scene_of_poses(device, *models, matrices)
    meets = ab.Query(scene, "any", pairs=pairs).run().any
    chosen = np.concatenate([np.flatnonzero(meets)[: poses // 2], np.flatnonzero(~meets)[: poses - poses // 2]])
    places = {"any": chosen, "faces": chosen, "distances": np.flatnonzero(~meets)[:poses]}
    queries = {output: ab.Query(scene, output, pairs=pairs[chosen]) for output in ("any", "faces")}
    apart = ab.DistanceQuery(scene, pairs[places["distances"]])
    ours = {output: to_host(query) for output, query in queries.items()}
    ours["distances"] = lambda: (apart.forget(), apart.launch(), apart.result())[2]
    truth = queries["any"].run().any, queries["faces"].run().faces, apart.run().distance
    made, rows = {}, {"warp_abtree": {}}
    for kind in KINDS:
        try:
            made[kind.name] = {question: kind(mesh, mesh, matrices[places[question]]) for question in QUESTIONS}
            rows[kind.name] = compare(made[kind.name], truth, mesh, matrices[chosen], judged)
        except ImportError as error:
            rows[kind.name] = {"skipped": str(error)}
    for question in QUESTIONS:
        asked = {name: getattr(one[question], question, None) for name, one in made.items()}
        calls = {"warp_abtree": ours[question]} | {name: call for name, call in asked.items() if call is not None}
        for name, times in time_on_host(calls, device, repeats, time.process_time).items():
            rows[name][f"{question}_us"] = round(1e3 * float(np.median(times)) / poses, 2)
    about = {"faces": len(mesh[1]), "poses": poses, "hits": len(truth[1])}
    for name, row in rows.items():
        yield about | {"library": name} | row


def compare(made, truth, mesh, matrices, judged) -> dict:
    """Return in which answers a library differs from ours, where it answers."""
    found_any, found_faces, found_distance = truth
    row = {"any_differ": int((np.array(made["any"].any(), bool) != found_any).sum())}
    one, far = made["faces"], made["distances"]
    if hasattr(one, "faces"):
        ours = {tuple(entry) for entry in found_faces.tolist()}
        theirs = {(pose, *pair) for pose, answer in enumerate(one.faces()) for pair in one.face_pairs(answer)}
        judge_disputed(
            list(theirs), list(ours), (mesh, mesh), lambda pose: (np.eye(4), matrices[pose]), one.name, judged
        )
        row |= {"faces_missed": len(ours - theirs), "faces_invented": len(theirs - ours)}
    if hasattr(far, "distances"):
        row["distance_error"] = float(np.abs(far.distances() - found_distance).max() / np.ptp(mesh[0], axis=0).max())
    return row
