"""Gradients of signed distances of things that overlap in many worlds, beside differences of python-fcl's."""

import contextlib
import io
import runpy
import time
from pathlib import Path

import numpy as np
import warp as wp

import warp_abtree as ab

from ..timing import medians, one_core, time_call, time_rounds

SAMPLE = Path(__file__).parents[2] / "scenes" / "07_place_without_overlap.py"
WORLDS = 64


def run(device, quick=False):
    """Yield a row: `DistanceQuery.run` with its gradients on the host, and python-fcl's distances with differences.

    One core each, timed by what its thread ran, but for a GPU.

    Meshes, placement and margin are those of the sample at its start. FCL is asked seven times where a pair is nearer
    than the margin, else once. Columns: overlapping are pairs that intersect, near those nearer than the margin;
    ratio is FCL's time over that here. differ counts, of the pairs that are apart, those whose distance is off by more
    than 1e-9; agree is the share of near ones whose slopes along translations are within 1e-3 (turns of things that
    stand upright have other slopes to either side).
    """
    device = wp.get_device(device)
    with contextlib.redirect_stdout(io.StringIO()):
        sample = runpy.run_path(str(SAMPLE))
    models, size, margin = sample["models"], sample["size"], sample["margin"]
    worlds = 2 if quick else WORLDS
    places = np.random.default_rng(0).uniform(-1, 1, (worlds * size, 3))
    poses = np.hstack([places, np.tile([0.0, 0, 0, 1], (len(places), 1))])
    scene = ab.Scene(device)
    scene.add_many(models * worlds, poses, solids=True)
    pairs = (np.stack(np.triu_indices(size, 1), 1) + size * np.arange(worlds)[:, None, None]).reshape(-1, 2)
    query = ab.DistanceQuery(scene, pairs, signed=True, beyond=margin)

    def ask():
        return query.run().gradient

    found, clock = query.run(), time.thread_time if device.is_cpu else time.perf_counter
    row = {"device": device.name, "worlds": worlds, "pairs": len(pairs), "faces": sum(m.face_count for m in models)}
    row |= {"overlapping": int(found.any.sum()), "near": int((found.distance < margin).sum())}
    with one_core() if device.is_cpu else contextlib.nullcontext():
        times = time_rounds({"ours": time_call(ask, device, clock)}, 3 if quick else 9)
    row |= {"ours_ms": medians(times)["ours"]}
    with contextlib.suppress(ImportError):
        row |= compare_fcl([model.mesh_at(model.lod_max)[:2] for model in models] * worlds, poses, pairs, margin, query)
        row["ratio"] = round(row["fcl_ms"] / row["ours_ms"], 1)
    yield row


def compare_fcl(meshes, poses, pairs, margin, query):
    """Return python-fcl's columns."""
    from ..baselines.fcl import FclSlopes

    matrices, answers = np.tile(np.eye(4), (len(poses), 1, 1)), []
    matrices[:, :3, 3] = poses[:, :3]
    other = FclSlopes(meshes, matrices)
    ask = time_call(lambda: answers.append(other.slopes(pairs, margin)), "cpu", time.thread_time)
    times = sorted(ask() for _ in range(3))
    (distances, slopes), found = answers[0], query.run()
    near = (found.distance > 0) & (found.distance < margin)
    same = np.abs(slopes - found.gradient[:, 1])[:, :3].max(1) < 1e-3
    differ = np.abs(distances - found.distance)[near] > 1e-9
    differ = int(differ.sum() + (distances[np.isinf(found.distance)] < margin).sum())
    return {"fcl_ms": times[1], "fcl_differ": differ, "fcl_agree": round(float(same[near].mean()), 3)}
