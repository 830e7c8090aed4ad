"""Yes or no for one pair of models at many random poses: the launch by itself, a wp.Bvh peer, and `sweep`.

The launch is that of a query over posed objects. `sweep` is timed as called, from poses to answers on the host: poses
in float64 and float32 on the host, and in float32 on the device.
"""

import gc
import os
from pathlib import Path

import numpy as np
import warp as wp

import warp_abtree as ab

from .memory import held_mib
from .peer import AnyPeer, find_constructor
from .roofline import find_peaks, roofline, used_memory
from .shapes import knot
from .timing import summarise, time_in_turn, time_rounds, time_wall

FULL = {"faces": 5000, "counts": (1024, 65536), "sweep_counts": (1024, 65536, 2**21), "repeats": 11}
CPU = {"faces": 5000, "counts": (1024, 16384), "sweep_counts": (1024, 65536), "repeats": 5}
QUICK = {"faces": 300, "counts": (16,), "sweep_counts": (16, 40), "repeats": 1}


def models(sizes):
    """Yield the knot, and the cow if the folder in ABTREE_MESHES has it."""
    model = ab.Model.from_arrays(*knot(sizes["faces"]))
    yield f"knot {model.face_count:,}", model
    cow = Path(os.environ.get("ABTREE_MESHES", "")) / "cow.obj.gz"
    if cow.is_file():
        yield "cow 5,804", ab.Model.load(cow)


def random_poses(count, size, seed=0):
    """Return float64 (count, 7): any rotation, positions in a cube whose side is twice a size."""
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(count, 4))
    return np.concatenate([size * rng.uniform(-1, 1, (count, 3)), q / np.linalg.norm(q, axis=1, keepdims=True)], 1)


def run(device, quick=False):
    """Yield one row a model and number of poses: the launch beside the peer, with memory and roofline, then `sweep`.

    meet is the share of poses that meet; million poses a second from medians. Memory is that of scene and query, before
    there is a peer. The peer's answers are counted against ours, those of every `sweep` must be ours.
    """
    device = wp.get_device(device)
    sizes = QUICK if quick else CPU if device.is_cpu else FULL
    peaks = find_peaks(device)
    for name, model in models(sizes):
        for count in sizes["counts"]:
            yield {"device": device.name, "model": name} | run_launch(device, model, count, sizes["repeats"], peaks)
        for count in sizes["sweep_counts"]:
            yield {"device": device.name, "model": name} | run_sweep(device, model, count, sizes["repeats"])


def model_size(model):
    return np.ptp(model.mesh_at(model.lod_max)[0], axis=0).max()


def mposes(count, milliseconds):
    """Return million poses a second."""
    return float(f"{count / milliseconds / 1e3:.4g}")


def run_launch(device, model, count, repeats, peaks):
    """Return the columns of launches over posed objects."""
    gc.collect()  # scenes and their queries hold each other
    poses = random_poses(count, model_size(model))
    scene = ab.Scene(device)
    scene.add(model)
    for pose in poses:
        scene.add(model, pose)
    query = ab.Query(scene, "any", pairs=[(0, i + 1) for i in range(count)])
    result = query.run()
    row = {"case": "launch", "poses": count, "meet": round(float(result.any.mean()), 4)}
    memory = {"arrays_mib": held_mib(scene, query)} | used_memory(device)
    vertices, faces, _ = model.mesh_at(model.lod_max)
    both = np.zeros((2 * count, 7), np.float32)
    both[::2, 6], both[1::2] = 1, poses
    constructor = find_constructor(vertices, faces, both[: 2 * min(64, count)], device)
    peer = AnyPeer(vertices, faces, both, device, constructor)
    times = time_in_turn({"launch": query.launch, "peer": peer.launch}, device, repeats)
    query.launch()
    if not np.array_equal(query.result().any, result.any):
        raise RuntimeError("the timed query's answer differs from the checked one")
    peer.launch()
    found = peer.result()
    row |= {"peer_missed": int((result.any & ~found).sum()), "peer_invented": int((found & ~result.any).sum())}
    for who, values in times.items():
        row |= summarise(who, values)
    row["launch_mposes_s"] = mposes(count, row["launch_ms"])
    row["ratio"] = round(row["peer_ms"] / row["launch_ms"], 2)
    return row | memory | roofline(result, row["launch_ms"], peaks)


def run_sweep(device, model, count, repeats):
    """Return the columns of `sweep`, in turn with poses of each kind."""
    gc.collect()
    poses = random_poses(count, model_size(model))
    single = poses.astype(np.float32)
    kinds = {"sweep": poses, "sweep32": single, "sweep_on_device": wp.array(single, dtype=wp.float32, device=device)}
    answers = {kind: ab.sweep(model, model, rows, device=device) for kind, rows in kinds.items()}
    check_sweep(device, model, single, answers["sweep32"])
    if not np.array_equal(answers["sweep32"], answers["sweep_on_device"]):
        raise RuntimeError("poses on the host and on the device are answered differently")
    runs = {
        kind: time_wall(lambda rows=rows: ab.sweep(model, model, rows, device=device), device)
        for kind, rows in kinds.items()
    }
    row = {"case": "sweep", "poses": count, "meet": round(float(answers["sweep32"].mean()), 4)}
    for kind, values in time_rounds(runs, min(repeats, 5)).items():
        row |= summarise(kind, values)
        row[f"{kind}_mposes_s"] = mposes(count, row[f"{kind}_ms"])
    return row | used_memory(device)


def check_sweep(device, model, poses, found, checked=1024):
    """Ask some poses of a sweep as objects of a scene.

    Raises:
        RuntimeError: The answers differ.
    """
    some = np.unique(np.linspace(0, len(poses) - 1, checked).astype(int))
    scene = ab.Scene(device)
    scene.add(model)
    for i in some:
        scene.add(model, poses[i])
    if not np.array_equal(scene.intersect([(0, i + 1) for i in range(len(some))]).any, found[some]):
        raise RuntimeError("the sweep and the query differ")
