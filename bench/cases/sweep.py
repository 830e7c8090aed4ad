"""Yes or no for one pair of models at many random poses: the launch by itself, a wp.Bvh baseline, and `sweep`.

The launch is that of a query over posed objects. `sweep` is timed as called, from poses to answers on the host: poses
in float64 and float32 on the host, and in float32 on the device.
"""

from functools import partial

import numpy as np
import warp as wp

import warp_abtree as ab

from ..baselines.wp_bvh import BvhPosed
from ..memory import memory_columns, used_memory
from ..meshes import real_meshes
from ..shapes import knot, longest_side, random_poses, scene_of_poses
from ..timing import ratio_of, summarise, time_call, time_in_turn, time_rounds

FULL = {"faces": 5000, "counts": (1024, 65536), "sweep_counts": (1024, 65536, 2**21), "repeats": 11}
CPU = FULL | {"counts": (1024, 16384), "sweep_counts": (1024, 65536), "repeats": 5}
QUICK = {"faces": 300, "counts": (16,), "sweep_counts": (16, 40), "repeats": 1}


def run(device, quick=False):
    """Yield one row a model and number of poses: the launch beside wp.Bvh, with memory, then `sweep`.

    meet is the fraction of poses that intersect; million poses a second from medians. Memory is that of scene and
    query, before there is a baseline, whose answers are counted against ours; those of every `sweep` must be ours.
    """
    sizes = QUICK if quick else CPU if device.is_cpu else FULL
    knots = ab.Model.from_arrays(*knot(sizes["faces"]))
    real = real_meshes({"cow 5,804": ("cow",)})
    for name, (model,) in {f"knot {knots.face_count:,}": (knots,), **real}.items():
        for case, run_case, counts in (("launch", run_launch, "counts"), ("sweep", run_sweep, "sweep_counts")):
            for count in sizes[counts]:
                poses = random_poses(longest_side(model), count)
                about = {"model": name, "case": case, "poses": count}
                yield about | run_case(device, model, poses, sizes["repeats"])


def run_launch(device, model, poses, repeats):
    """Return the columns of launches over posed objects."""
    scene, pairs = scene_of_poses(device, model, model, poses)
    query = ab.Query(scene, "any", pairs=pairs)
    result = query.run()
    row = {"meet": result.any.mean()} | memory_columns(scene, query)
    mesh = model.mesh_at(model.lod_max)[:2]
    both = np.zeros((2 * len(poses), 7), np.float32)
    both[::2, 6], both[1::2] = 1, poses
    baseline = BvhPosed(*mesh, both, None, device)
    times = time_in_turn({"launch": query.launch, "peer": baseline.launch}, device, repeats)
    query.launch()
    if not np.array_equal(query.result().any, result.any):
        raise RuntimeError("the timed query's answer differs from the checked one")
    baseline.launch()
    found = baseline.result()
    row |= {"peer_missed": (result.any & ~found).sum(), "peer_invented": (found & ~result.any).sum()}
    row |= summarise(times) | {"ratio": ratio_of(times["peer"], times["launch"])}
    return row | {"launch_mposes_s": len(poses) / row["launch_ms"] / 1e3}


def run_sweep(device, model, poses, repeats):
    """Return the columns of `sweep`, in turn with poses of each kind."""
    single = poses.astype(np.float32)
    kinds = {"sweep": poses, "sweep32": single, "sweep_on_device": wp.array(single, dtype=wp.float32, device=device)}
    ask = partial(ab.sweep, model, model, device=device)
    answers = {kind: ask(rows) for kind, rows in kinds.items()}
    check_sweep(device, model, single, answers["sweep32"])
    if not np.array_equal(answers["sweep32"], answers["sweep_on_device"]):
        raise RuntimeError("poses on the host and on the device are answered differently")
    runs = {kind: time_call(partial(ask, rows), device) for kind, rows in kinds.items()}
    row = {"meet": answers["sweep32"].mean()} | summarise(time_rounds(runs, min(repeats, 5)))
    rates = {f"{kind}_mposes_s": len(poses) / row[f"{kind}_ms"] / 1e3 for kind in kinds}
    return row | rates | used_memory(device)


def check_sweep(device, model, poses, found):
    """Ask some poses of a sweep as objects of a scene: the answers must be equal."""
    some = np.unique(np.linspace(0, len(poses) - 1, 1024).astype(int))
    scene, pairs = scene_of_poses(device, model, model, poses[some])
    if not np.array_equal(scene.intersect(pairs).any, found[some]):
        raise RuntimeError("the sweep and the query differ")
