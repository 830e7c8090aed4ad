"""First contacts: public queries, random motions checked, and times against python-fcl's continuous collision.

* queries: contacts missed and reported beyond the truth of `ccd_queries`, where its files are at hand; beside
  Tight-Inclusion's, where ipctk is installed.
* checked: random motions of two meshes; late and missed by exact tests at many times, early by one after the tolerance.
* times [ms] of a motion: meshes that pass each other (across), from far away, in a planner's short steps; and a nut
  that turns on its bolt, which moves on a screw. On the CPU all on one core.
"""

import time
from collections import Counter

import numpy as np

import warp_abtree as ab
from warp_abtree import testing

from ..baselines.fcl import Fcl
from ..cases.assembly import PITCH, place_nut, turned
from ..meshes import NUT, ModelFolder, knot_model, mesh_file
from ..shapes import longest_side, pose_matrices, random_directions, scene_of_poses
from ..timing import medians, no_garbage_collection, one_core, time_in_turn
from . import ccd_queries

FULL = {"count": 65536, "checked": 1_000_000, "samples": 32, "repeats": 5, "turn": 10.0, "fcl": 0}
CPU = FULL | {"count": 256, "checked": 20_000, "fcl": 8}
HALF_REVOLUTION = 2.0**-16  # real part of a turn, under which there is none
QUICK = {"count": 3, "checked": 20, "samples": 4, "repeats": 1, "turn": 0.01, "fcl": 1}
TOLERANCE = 1e-6


def run(device, count=None, quick=False):
    """Yield the rows; count is that of the checked motions."""
    sizes = dict(QUICK if quick else CPU if device.is_cpu else FULL)
    sizes["checked"] = count or sizes["checked"]
    yield check_queries(device, ccd_queries.ipctk and device.is_cpu and not quick)
    folder = ModelFolder(None)
    at_hand = mesh_file("cow") and not quick
    name, model = ("cow", folder.load(["cow"])) if at_hand else ("knot", knot_model(300))
    yield check_motions(name, model, device, sizes)
    ways = {"across": (1.2, 1.2), "from far": (4.0, 4.0), "steps": (1.2, None)}
    for way, (first, last) in ways.items():
        poses = random_motions(model, sizes["count"], first, last)
        yield measure(f"{name}, {way}", [model, model], poses, device, sizes)
    if all(map(mesh_file, NUT)) and not quick and device.is_cpu:  # one motion keeps one warp of a GPU busy for long
        models = [folder.load([part]) for part in NUT]
        first = place_nut(models, 1)["free"]
        angle = np.deg2rad(sizes["turn"])
        last = turned(angle, z=first[0, 2, 3] + PITCH * angle / (2 * np.pi))[None]
        yield measure(f"nut, {sizes['turn']:g} degrees", models, (first, last), device, sizes)


def random_motions(model, count, first, last, seed=0):
    """Return poses (count, 7) of B at both ends, its origin so many sizes from A's; steps of a tenth for None."""
    rng, size = np.random.default_rng(seed), longest_side(model)
    turn = rng.normal(size=(2, count, 4))
    ends = size * random_directions(rng, 2, count, 3) * np.array([first, last or first])[:, None, None]
    if last is None:
        ends[1] = ends[0] + 0.1 * size * random_directions(rng, count, 3)
        turn[1] = turn[0] + 0.1 * np.linalg.norm(turn[0], axis=1, keepdims=True) * random_directions(rng, count, 4)
    turn /= np.linalg.norm(turn, axis=2, keepdims=True)
    # Half a revolution has no shortest way: of a million some come near it, and do not turn.
    half = np.abs((turn[0] * turn[1]).sum(1)) < HALF_REVOLUTION
    turn[1, half] = turn[0, half]
    return tuple(np.concatenate(rows, 1) for rows in zip(ends, turn))


def check_queries(device, baseline):
    """Return how public queries are answered, and by the baseline if asked, each in so many us a query."""
    counts, seconds = Counter(), Counter()
    for number, path in enumerate(sorted(ccd_queries.FOLDER.glob("*.csv.gz"))):
        starts, ends, truth = ccd_queries.read_queries(path)
        if number == 0:
            testing.advance_corners(starts, ends, TOLERANCE, device)  # compiles
        began = time.perf_counter()
        _, clear, undecided = testing.advance_corners(starts, ends, TOLERANCE, device)
        seconds["us"] += time.perf_counter() - began
        counts.update(asked=len(truth), contacts=truth.sum(), undecided=undecided.sum())
        counts.update(missed=(truth & clear).sum(), beyond=(~truth & ~clear).sum())
        if baseline:
            kind = path.name.split(".")[1]
            points = list(ccd_queries.POINTS[kind])
            began = time.perf_counter()
            hit = np.array(ccd_queries.find_collisions(kind, starts[:, points], ends[:, points]))
            seconds["tight_inclusion_us"] += time.perf_counter() - began
            counts.update(tight_inclusion_missed=(truth & ~hit).sum(), tight_inclusion_beyond=(~truth & hit).sum())
    if not counts["asked"]:
        return {"case": "queries", "skipped": "no files: set ABTREE_CCD to their folder"}
    taken = {name: 1e6 * value / counts["asked"] for name, value in seconds.items()}
    return {"case": "queries"} | counts | taken


def between(first, last, times):
    """Return poses (n, 7) at times (n,), each of its own motion: the origin straight, the shortest turn."""
    turns = first[:, 3:], last[:, 3:] * np.sign((first[:, 3:] * last[:, 3:]).sum(1))[:, None]
    cosine = (turns[0] * turns[1]).sum(1)
    angle = np.arctan2(np.linalg.norm(turns[1] - cosine[:, None] * turns[0], axis=1), cosine)[:, None]
    t = times[:, None]
    with np.errstate(invalid="ignore"):
        turn = (np.sin((1 - t) * angle) * turns[0] + np.sin(t * angle) * turns[1]) / np.sin(angle)
    turn = np.where(angle > 0, turn, turns[0])
    return np.concatenate([(1 - t) * first[:, :3] + t * last[:, :3], turn], 1)


def check_motions(name, model, device, sizes):
    """Return how many of random motions are late, missed, or early by more than the tolerance, by exact tests."""
    first, last = random_motions(model, sizes["checked"], 1.0, 1.0, seed=1)
    rows = ab.sweep(model, model, first, end_poses=last, output="first_contact", device=device)
    late = missed = 0
    for part in np.linspace(0, 1, sizes["samples"]):
        hit = ab.sweep(model, model, between(first, last, part * rows["time"]), device=device)
        late += (hit & ~rows["clear"] & (rows["time"] > 0)).sum()
        missed += (hit & rows["clear"]).sum()
    touching = ~rows["clear"] & ~rows["undecided"] & (rows["time"] > 0)
    later = np.minimum(rows["time"] + TOLERANCE, 1)
    meets = ab.sweep(model, model, between(first, last, later), device=device)
    row = {"case": f"checked, {name}", "asked": len(rows), "clear": rows["clear"].sum()}
    row |= {"at_start": (rows["time"] == 0).sum(), "undecided": rows["undecided"].sum()}
    return row | {"late": late, "missed": missed, "early": (touching & ~meets).sum()}


def measure(name, models, poses, device, sizes):
    """Return times of a motion [ms], of all at once."""
    first, last = (rows if rows.ndim == 3 else pose_matrices(rows) for rows in poses)
    scene, pairs = scene_of_poses(device, *models, first)
    query = ab.FirstContactQuery(scene, np.concatenate([np.eye(4)[None], last]), pairs, tolerance=TOLERANCE)
    found = query.run()
    row = {"case": name, "motions": len(pairs)}
    row |= {"clear": found.clear.sum(), "at_start": (found.time == 0).sum(), "undecided": found.undecided.sum()}
    row |= {"node_tests": found.node_tests.mean(), "face_tests": found.triangle_tests.mean()}
    with one_core(), no_garbage_collection():
        times = medians(time_in_turn({"ours": query.launch}, device, sizes["repeats"], time.thread_time))
        row["ms"] = times["ours"] / len(pairs)
        if device.is_cpu:
            try:
                some = slice(0, sizes["fcl"])
                fcl = Fcl(*[model.mesh_at(model.lod_max)[:2] for model in models], first[some])
                start = time.thread_time()
                answers = fcl.first_contacts(last[some])
                row["fcl_ms"] = 1e3 * (time.thread_time() - start) / len(answers)
                row["fcl_late"] = (answers > found.time[some] + 1e-3).sum()
                row["fcl_early"] = (answers < found.time[some] - 1e-3).sum()
                row["fcl_ratio"] = round(row["fcl_ms"] / row["ms"], 2)
            except ImportError as error:
                row["fcl_skipped"] = str(error)
    return row
