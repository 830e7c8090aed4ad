"""All intersecting face pairs of many posed pairs of one knot, beside wp.Bvh and Newton, where installed."""

import time

import numpy as np

import warp_abtree as ab

from ..baselines.newton import make_newton
from ..baselines.wp_bvh import BvhPosed
from ..memory import memory_columns
from ..shapes import KNOT_PAIRS, knot_batches, scene_of_pairs
from ..timing import ratio_of, summarise, time_in_turn
from ..verify import count_differences, judge_disputed

QUICK = {"faces": 300, "pairs": (1, 4), "distances": (0.2,), "repeats": 3}
NEWTON_PAIRS_MAX = {"cuda": 1024, "cpu": 64}
COUNTERS = ("node_tests", "triangle_tests", "float64_tests", "exact_tests")
JUDGED = 300  # face pairs that the oracle decides


def run(device, quick=False):
    """Yield one row a case: what was asked and found, times of ours and of each baseline, and memory.

    Columns: first_s is the first run, which compiles and grows buffers. ours and peer (wp.Bvh) are launches. judged
    says how many face pairs on which the peer differs the exact oracle decided, ours_wrong in how many it sides with
    the peer. Memory is that of scene and query, before the baselines.
    """
    sizes = QUICK if quick else KNOT_PAIRS
    for about, model, poses in knot_batches(device, sizes):
        yield about | run_batch(device, model, poses, sizes["repeats"])


def run_batch(device, model, poses, repeats):
    """Return the row of one batch of pairs."""
    mesh = model.mesh_at(model.lod_max)[:2]
    scene, pairs = scene_of_pairs(device, model, poses)
    begin = time.perf_counter()
    whole = scene.intersect(pairs, output="faces")
    first = time.perf_counter() - begin
    query = ab.Query(scene, output="faces", pairs=pairs, capacity=max(1, len(whole.faces)))
    memory = memory_columns(scene, query)
    baseline = BvhPosed(*mesh, poses, 4 * len(whole.faces) + 1024, device)
    row = {"faces": len(mesh[1]), "hits": len(whole.faces)}
    row |= {name: getattr(whole, name).sum(dtype=np.int64) for name in COUNTERS}
    row |= {"first_s": first, "peer": f"wp.Bvh {baseline.constructor}"}
    newton, skipped = {}, {"newton": "more pairs take minutes"}
    if len(pairs) <= NEWTON_PAIRS_MAX["cuda" if device.is_cuda else "cpu"]:
        newton, skipped = make_newton(*mesh, poses, len(whole.faces), device)
    launches = {"ours": query.launch, "peer": baseline.launch} | {name: other.launch for name, other in newton.items()}
    times = time_in_turn(launches, device, repeats)
    again = query.result()
    again.check()
    if not np.array_equal(again.faces, whole.faces):
        raise RuntimeError("the timed query's answer differs from the checked one")
    row |= check_baseline(baseline.result(), whole.faces, model, poses) | summarise(times)
    row["ratio"] = ratio_of(times["peer"], times["ours"])
    for name, other in newton.items():
        row |= {f"{name}_{key}": value for key, value in other.compare(whole.any).items()}
        row[f"{name}_ratio"] = ratio_of(times[name], times["ours"])
    row |= {f"{name}_skipped": why for name, why in skipped.items()}
    return row | memory | {"node_tests_per_s": 1e3 * row["node_tests"] / row["ours_ms"]}


def check_baseline(found, ours, model, poses):
    """Return the columns of what the peer finds beside ours; raise a RuntimeError where the oracle finds ours wrong."""
    row = {"peer_hits": len(found)}
    row["peer_missed"], row["peer_invented"] = count_differences(found, ours)
    mesh = model.mesh_at(model.lod_max)[:2]
    judged = judge_disputed(found, ours, (mesh, mesh), poses.reshape(-1, 2, 7).__getitem__, "wp.Bvh", JUDGED)
    return row | {"judged": judged or 0, "ours_wrong": None if judged is None else 0}
