"""Time to read results: `Scene.intersect` beside its launches, by output and size."""

import numpy as np

import warp_abtree as ab

from ..shapes import KNOT_PAIRS, knot_batches, scene_of_pairs
from ..timing import make_runs, medians, time_call, time_rounds

QUICK = {"faces": 300, "pairs": (1, 4), "distances": (0.2,), "repeats": 2}
OUTPUTS = ("any", "count", "faces", "contacts")
BYTES_PER_MS = 20e6  # of a transfer from a GPU to page-locked memory
COUNTERS = ("node_tests", "triangle_tests", "float64_tests", "exact_tests")
ARRAYS = ("any", "count", "faces", "contacts", "pair_contacts", *COUNTERS)  # of a result; pairs were given


def run(device, quick=False):
    """Yield one row a number of pairs, distance of their centres, and output; times [ms], medians.

    Columns: launches of a `Query` with room for the hits (replays of a graph on CUDA); intersect is
    `Scene.intersect` as a loop calls it, which holds the result before until the next is there; result is
    `Query.result` of what was launched; on_device is intersect with `device=True`. bytes are those of the arrays asked
    for, with what the result says of each pair; goal_ms is launches and their transfer at 20 GB/s, ratio intersect over
    it.
    """
    sizes = QUICK if quick else KNOT_PAIRS
    for about, model, poses in knot_batches(device, sizes):
        scene, pairs = scene_of_pairs(device, model, poses)
        for output in OUTPUTS:
            yield about | {"output": output} | time_output(device, scene, pairs, output, sizes["repeats"])


def time_output(device, scene, pairs, output, repeats):
    """Return the columns of one batch of pairs and output."""
    found = scene.intersect(pairs, output)
    capacity = max(1, int(found.count.sum())) if output in ("faces", "contacts") else None
    if output == "contacts":
        query = ab.ContactQuery(scene, pairs, capacity)
    else:
        query = ab.Query(scene, output, pairs=pairs, capacity=capacity)
    compare(found, query.run(), scene.intersect(pairs, output, device=True))
    kept = [found]

    def intersect():
        kept[0] = scene.intersect(pairs, output)

    runs = make_runs({"launches": query.launch}, device)
    runs["intersect"] = time_call(intersect, device)
    runs["result"] = time_call(query.result, device)
    runs["on_device"] = time_call(lambda: scene.intersect(pairs, output, device=True), device)
    times = medians(time_rounds(runs, repeats))
    compare(found, query.result())
    size = sum(getattr(found, name).nbytes for name in ARRAYS if getattr(found, name) is not None)
    goal = times["launches"] + size / BYTES_PER_MS
    row = {"hits": capacity, "bytes": size} | {f"{name}_ms": value for name, value in times.items()}
    return row | {"goal_ms": goal, "ratio": round(times["intersect"] / goal, 2)}


def compare(found, again, on_device=None):
    """Raise a RuntimeError where a result and that of a query, or one on the device, differ."""
    for name in ARRAYS:
        expected = getattr(found, name)
        if expected is None or (found.count is None and name in COUNTERS):
            continue  # the tests of `any` end where a warp has found a hit
        there = {} if on_device is None else getattr(on_device, name)
        if not isinstance(there, dict):
            there, expected = {"": there}, {"": expected}
        same = all(
            np.array_equal(there[f].numpy().reshape(expected[f].shape), expected[f], equal_nan=True) for f in there
        )
        if not same or getattr(again, name).tobytes() != getattr(found, name).tobytes():
            raise RuntimeError(f"{name} differs between Scene.intersect, Query.run and arrays on the device")
