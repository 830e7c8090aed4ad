"""Gradients of signed distances of things that overlap in many worlds, beside differences of peers' distances."""

import contextlib
import io
import runpy
import time
from pathlib import Path

import numpy as np

import warp_abtree as ab

from ..baselines.fcl import FclSlopes
from ..baselines.warp_mesh import WarpMeshSlopes
from ..shapes import pose_matrices
from ..timing import host_clock, medians, one_core, time_call, time_rounds

SAMPLE = Path(__file__).parents[2] / "scenes" / "07_place_without_overlap.py"
WORLDS = 64


def run(device, quick=False):
    """Yield a row: `DistanceQuery.run` with its gradients on the host, and peers' distances with differences.

    One core each, timed by what its thread ran, but for a GPU. Peers are python-fcl, and Warp's own mesh queries, on
    the device.

    Meshes, placement and margin are those of the sample at its start. Peers are asked seven times where a pair is
    nearer than the margin, else once. Columns: overlapping are pairs that intersect, near those nearer than the margin;
    ratio is a peer's time over that here. differ counts, of the pairs that are apart, those whose distance is off by
    more than 1e-9, of float32 1e-4; agree is the share of near ones whose slopes along translations are within 1e-3, of
    float32 1e-2 (turns of things that stand upright have other slopes to either side).
    """
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

    found, clock = query.run(), host_clock(device)
    row = {"worlds": worlds, "pairs": len(pairs), "faces": sum(m.face_count for m in models)}
    row |= {"overlapping": int(found.any.sum()), "near": int((found.distance < margin).sum())}
    with one_core(device):
        times = time_rounds({"ours": time_call(lambda: query.run().gradient, device, clock)}, 3 if quick else 9)
    row |= {"ours_ms": medians(times)["ours"]}
    matrices, meshes = pose_matrices(poses), [m.mesh_at(m.lod_max)[:2] for m in models] * worlds
    with contextlib.suppress(ImportError):
        row |= compare("fcl", FclSlopes(meshes, matrices), pairs, margin, query, (1e-9, 1e-3), time.thread_time)
        row["ratio"] = round(row["fcl_ms"] / row["ours_ms"], 1)
    others = WarpMeshSlopes(meshes, matrices, device)
    with one_core(device):
        row |= compare("warp", others, pairs, margin, query, (1e-4, 1e-2), clock)
    row["warp_ratio"] = round(row["warp_ms"] / row["ours_ms"], 1)
    yield row


def compare(name, other, pairs, margin, query, errors, clock) -> dict:
    """Return a peer's columns, with errors of distances and slopes that are none."""
    answers: list = []
    ask = time_call(lambda: answers.append(other.slopes(pairs, margin)), query.device, clock)
    times = sorted(ask() for _ in range(3))
    (distances, slopes), found = answers[-1], query.run()
    near = (found.distance > 0) & (found.distance < margin)
    same = np.abs(slopes - found.gradient[:, 1])[:, :3].max(1) < errors[1]
    differ = int((np.abs(distances - found.distance)[near] > errors[0]).sum())
    differ += int((distances[np.isinf(found.distance)] < margin).sum())
    agree = round(float(same[near].mean()), 3)
    return {f"{name}_ms": times[1], f"{name}_differ": differ, f"{name}_agree": agree}
