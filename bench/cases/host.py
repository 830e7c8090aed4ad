"""Time to read results: `Scene.intersect` beside its launches, by output and size."""

import gc

import numpy as np
import warp as wp

import warp_abtree as ab

from ..shapes import knot, pair_poses, scene_of_pairs
from ..timing import make_runs, medians, time_call, time_rounds

FULL = {"faces": 5000, "pairs": (1, 64, 1024, 8192), "distances": (0.9, 0.2), "repeats": 11}
QUICK = {"faces": 300, "pairs": (1, 4), "distances": (0.2,), "repeats": 2}
CPU_PAIRS = {1024: 512, 8192: None}  # what the CPU takes in their place: more pairs take minutes
OUTPUTS = ("any", "count", "faces", "contacts")
BYTES_PER_MS = 20e6  # of a transfer from a GPU to page-locked memory
COUNTERS = ("node_tests", "triangle_tests", "float64_tests", "exact_tests")
VECTORS = ("p0", "p1", "normal_a", "normal_b", "normal")


def run(device, quick=False):
    """Yield one row a number of pairs, distance of their centres, and output; times [ms], medians.

    Columns: launches of a `Query` with room for the hits (replays of a graph on CUDA); intersect is
    `Scene.intersect` as a loop calls it, which holds the result before until the next is there; result is
    `Query.result` of what was launched; on_device is intersect with `device=True`. bytes are those of the arrays asked
    for, with what the result says of each pair; goal_ms is launches and their transfer at 20 GB/s, ratio intersect over
    it. Results are compared with each array read by itself, rows sorted on the host.
    """
    device = wp.get_device(device)
    sizes = QUICK if quick else FULL
    model = ab.Model.from_arrays(*knot(sizes["faces"]), name="knot")
    for count in sizes["pairs"]:
        count = CPU_PAIRS.get(count, count) if device.is_cpu else count
        for distance in sizes["distances"]:
            if count is not None:
                yield from time_outputs(device, model, count, distance, sizes["repeats"])


def time_outputs(device, model, count, distance, repeats):
    """Yield the rows of one batch of pairs."""
    gc.collect()
    scene, pairs = scene_of_pairs(device, model, pair_poses(count, distance))
    for output in OUTPUTS:
        found = scene.intersect(pairs, output)
        capacity = max(1, int(found.count.sum())) if output in ("faces", "contacts") else None
        if output == "contacts":
            query = ab.ContactQuery(scene, pairs, capacity)
        else:
            query = ab.Query(scene, output, pairs=pairs, capacity=capacity)
        query.grow()
        compare(unpacked(query, pairs), found, scene.intersect(pairs, output, device=True))
        runs = make_runs({"launches": query.launch}, device)
        runs["intersect"] = time_call(Keeper(lambda output=output: scene.intersect(pairs, output)), device)
        runs["result"] = time_call(query.result, device)
        runs["on_device"] = time_call(lambda output=output: scene.intersect(pairs, output, device=True), device)
        times = medians(time_rounds(runs, repeats))
        size = sum(array.nbytes for array in host_arrays(found))
        goal = times["launches"] + size / BYTES_PER_MS
        row = {"device": device.name, "pairs": count, "distance": distance, "output": output}
        row |= {"hits": capacity, "bytes": size} | {f"{name}_ms": round(value, 4) for name, value in times.items()}
        yield row | {"goal_ms": round(goal, 4), "ratio": round(times["intersect"] / goal, 2)}


class Keeper:
    """Calls something and keeps what it returned until the next call has returned, as a loop's variable does."""

    def __init__(self, call):
        self.call, self.kept = call, None

    def __call__(self):
        self.kept = self.call()


def host_arrays(result):
    """Return the arrays that were read for a result; pairs were given."""
    names = ("any", "count", "faces", "contacts", "pair_contacts", *COUNTERS)
    return [getattr(result, name) for name in names if getattr(result, name) is not None]


def compare(read, found, kept):
    """Raise where arrays read one by one, a result, and one on the device differ."""
    for name, expected in read.items():
        if found.count is None and name in COUNTERS:
            continue  # the tests of `any` end where a warp has found a hit
        there = getattr(kept, name)
        fields = [(there[field].numpy(), expected[field]) for field in there] if isinstance(there, dict) else []
        fields = fields or [(there.numpy(), expected)]
        same = all(np.array_equal(one.reshape(other.shape), other, equal_nan=True) for one, other in fields)
        if getattr(found, name).tobytes() != expected.tobytes() or not same:
            raise RuntimeError(f"{name} differs from what the device's arrays hold")


def unpacked(query, pairs):
    """Query pairs as before there was packing: read each array whole, sort and assemble rows on the host."""
    query.set_pairs(pairs)
    query.launch()
    hits, p = query.hits, len(pairs)
    int(hits.count.numpy().sum())
    read = {"any": hits.any_hit.numpy()[:p] != 0} | {name: getattr(hits, name).numpy()[:p].copy() for name in COUNTERS}
    if query.output == "any":
        return read
    read["count"] = hits.count.numpy()[:p].copy()
    rows = int(read["count"].sum())
    if query.output == "faces" and not isinstance(query, ab.ContactQuery):
        read["faces"] = sort_rows(hits.face.numpy()[:rows].reshape(-1, 3))
    elif query.output == "faces":
        read |= assemble(query, read["count"], rows)
    return read


def sort_rows(rows):
    """Return rows of (pair, face, face) in order, each packed into one number."""
    key = (rows[:, 0].astype(np.int64) << 40) | (rows[:, 1].astype(np.int64) << 20) | rows[:, 2]
    key.sort()
    return np.stack([key >> 40, (key >> 20) & (2**20 - 1), key & (2**20 - 1)], 1).astype(np.int32)


def assemble(query, count, rows):
    """Return faces, contacts and their summaries, each field read by itself."""
    real = np.float64
    vectors = [(name, real, (3,)) for name in VECTORS]
    contacts = np.zeros(rows, [("pair", np.int32), ("faces", np.int32, (2,)), *vectors, ("coplanar", bool)])
    means = np.zeros(len(count), [("count", np.int64), ("point", real, (3,)), ("normal", real, (3,)), ("travel", real)])
    means["count"] = count
    for name in ("point", "normal", "travel"):
        means[name] = getattr(query.pair_contacts, name)[: len(count)].numpy()
    faces = np.empty((0, 3), np.int32)
    if rows:
        faces = query.faces[:rows].numpy().copy()
        for name in (*VECTORS, "coplanar"):
            contacts[name] = getattr(query.contacts, name)[:rows].numpy()
    contacts["pair"], contacts["faces"] = faces[:, 0], faces[:, 1:]
    return {"faces": faces, "contacts": contacts, "pair_contacts": means}
