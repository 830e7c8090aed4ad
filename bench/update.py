"""Time of ACTIVE-UPDATE against k, beside a full refit of the same state and a tree built from scratch; many states.

The library chooses between both kinds of refit by `Regime.full_refit`; here it is set from outside: each is measured
on the same states, in turn. Their bits are compared before anything is timed.
"""

import copy
import math
import time

import numpy as np
import warp as wp

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.model import tree
from warp_abtree.state.lod_update import full_refit_fraction

from .memory import held_mib
from .peer import BvhPeer
from .roofline import find_peaks, update_roofline, used_memory
from .shapes import knot_model
from .timing import WARM_UP, fit_slope, make_runs, summarise, time_both, time_in_turn

# Nothing public forces a kind of refit, hands out the batch of an update, or builds a tree alone.

# Shares of the splits between the finest LOD and the other.
SHARES = (1e-5, 1e-4, 3e-4, 1e-3, 3e-3, 0.01, 0.03, 0.06, 0.1, 0.15, 0.2, 0.3, 0.5, 0.9)
FULL = {
    "faces": (4000, 16000, 64000, 250_000, 1_000_000),
    "shares": SHARES,
    "states": (1, 16, 256, 4096),
    "state_faces": 500,
    "repeats": 7,
}
QUICK = {"faces": (200, 600), "shares": (0.01, 0.1, 0.9), "states": (1, 12), "state_faces": 200, "repeats": 2}
LARGEST_CPU = 64000
STATES_PER_MODEL = 8
SETTLE = 2  # times there and back, the last of which counts
REGIMES = {"update": False, "full": True}

FIGURES = (
    {
        "file": "update_time.svg",
        "panels": (
            {
                "title": "ACTIVE-UPDATE of one state",
                "where": {"case": "one state"},
                "x": "k",
                "xlabel": "k, faces that change",
                "y": {"update_ms": "update", "full_ms": "full refit"},
                "ylabel": "time of an update [ms]",
                "by": ("faces", "faces"),
            },
            {
                "title": "many states of a small mesh",
                "where": {"case": "many states"},
                "x": "states",
                "xlabel": "states in one update",
                "y": {"update_ms": "update", "full_ms": "full refit", "wall_ms": "set_lods, as called"},
                "ylabel": "time of an update [ms]",
                "by": None,
            },
        ),
    },
)


# --- what the library does, forced and overheard ---------------------------------------------------------------------


def forced(full):
    """Return a context in which states are refitted whole (True), in part (False), or as the library chooses (None)."""
    return testing.force_refits(full)


def set_lods(scene, lods, share):
    """Set LODs by one kind of refit.

    Returns:
        Stats, the faces in the slices between the LODs, and a launch of the same update, to be run from the same LODs.
    """
    with forced(share):
        stats = scene.set_lods(lods)
    return stats, int(stats.slice_length.sum()), testing.repeat_update(stats)


def read_bits(scene):
    """Return all boxes, links, statuses and corners, one row a state, in the order of model and LOD. Waits."""
    states = scene.batch().states
    order = np.lexsort(([slot.lod for slot in states.slots], [slot.model for slot in states.slots]))
    pool, count = states.pool, len(states.slots)
    node_end, face_end = states.node_total, states.face_total
    arrays = [pool.node_box[: 2 * node_end], pool.node_status[:node_end], pool.face_corner[:face_end]]
    return [array.numpy().view(np.int32).reshape(count, -1)[order] for array in arrays]


def bound_nodes(k, faces):
    """Return the bound on nodes refitted, equation (1), faces rounded up to a power of two."""
    return k * (math.ceil(math.log2(faces)) - math.log2(k) + 2) - 1 if k else 0


def check_update(scene, there, back, faces):
    """Move to other LODs and back by both kinds of refit and compare all bits.

    Returns:
        k and nodes refitted of each state by the partial update, faces in its slices, and by kind of refit the launches
        there and back.

    Raises:
        RuntimeError: Bits or k differ, the bound of equation (1) is passed, or states have changed places.
    """
    states = scene.batch().states
    begin = [slot.lod for slot in states.slots]
    start = read_bits(scene)
    launches, found = {}, {}
    for name, share in REGIMES.items():
        stats, entries, forth = set_lods(scene, there, share)
        bits = read_bits(scene)
        _, _, home = set_lods(scene, back, share)
        if [slot.lod for slot in states.slots] != begin:
            raise RuntimeError("states do not return to where they were")
        if not all(np.array_equal(a, b) for a, b in zip(start, read_bits(scene), strict=True)):
            raise RuntimeError(f"{name}: the way back leaves other bits than were there before")
        launches[name], found[name] = (forth, home), (stats, stats.k.copy(), stats.nodes_refitted.copy(), bits, entries)
    stats, k, nodes, bits, entries = found["update"]
    if not np.array_equal(k[np.argsort(stats.state)], found["full"][1][np.argsort(found["full"][0].state)]):
        raise RuntimeError(f"a partial update changes {k.sum()} faces, a full refit {found['full'][1].sum()}")
    if not all(np.array_equal(a, b) for a, b in zip(bits, found["full"][3], strict=True)):
        raise RuntimeError("a partial update and a full refit leave different bits")
    if any(nodes[i] > bound_nodes(int(k[i]), faces) for i in range(len(k))):
        raise RuntimeError("more nodes refitted than equation (1) allows")
    return k, nodes, entries, launches


# --- times -----------------------------------------------------------------------------------------------------------


def time_set_lods(scene, lods, share, device):
    """Return the time [ms] of `set_lods` by the wall clock and between events."""
    with forced(share):
        return time_both(lambda: scene.set_lods(lods), device)


def time_update(scene, there, back, launches, device, repeats):
    """Return columns of times [ms], and the medians by name.

    update, full: device time of refinement, marking and refit, there and back: graph replays on CUDA. wall: whole calls
    of `set_lods` as the library chooses, planning and uploads included; update_wall and full_wall as forced; stream
    beside them: the same between events on CUDA. In turn, but each time there and back twice, of which the second
    counts: what one kind of refit leaves in the caches is of no use to the other.
    """
    runs = make_runs(
        {(name, way): launch for name, ways in launches.items() for way, launch in enumerate(ways)}, device
    )
    calls = {"": None, "update_": REGIMES["update"], "full_": REGIMES["full"]}
    times = {name: [] for name in [*REGIMES, *(call + clock for call in calls for clock in ("wall", "stream"))]}
    for turn in range(WARM_UP + repeats):
        for name in REGIMES:
            taken = [[runs[name, way]() for way in (0, 1)] for _ in range(SETTLE)]
            times[name] += taken[-1] if turn >= WARM_UP else []
    scene.batch().states.upload_slots()
    for turn in range(WARM_UP + repeats):
        for call, share in calls.items():
            taken = [time_set_lods(scene, lods, share, device) for _ in range(SETTLE) for lods in (there, back)]
            for i, clock in enumerate(("wall", "stream")):
                times[call + clock] += [both[i] for both in taken[-2:]] if turn >= WARM_UP else []
    row = {}
    for name, values in times.items():
        if device.is_cuda or not name.endswith("stream"):
            row |= summarise(name, values)
    row["ratio"] = round(row["full_ms"] / row["update_ms"], 2)
    return row


def find_crossover(rows, column):
    """Return the value of a column where an update starts to cost as much as a full refit, None if it never does."""
    x = [row[column] for row in rows]
    excess = [math.log(row["update_ms"] / row["full_ms"]) for row in rows]
    for i in range(len(rows) - 1, 0, -1):
        if excess[i - 1] < 0 <= excess[i]:
            part = -excess[i - 1] / (excess[i] - excess[i - 1])
            return round(math.exp(math.log(x[i - 1]) * (1 - part) + math.log(x[i]) * part))
    return x[0] if excess[0] >= 0 else None


def run(device, quick=False, largest=None, models=None):
    """Yield one row a share of a mesh, one a mesh with its crossover, and one a number of states moved at once.

    Nodes and bytes are those of the partial update, counted; memory is that of the scene, before there is a peer.

    entries are the faces of the slice between the LODs, repeats included, compared with `Regime.full_refit`;
    full tells whether the library would refit the whole tree. bvh_build boxes the faces at the LOD and builds a wp.Bvh
    over them; host_build is ACTIVE-BUILD over the finest mesh. crossover_* are where the update costs as much as a full
    refit: the least measured if it always does, None if it never does.
    """
    device = wp.get_device(device)
    sizes = QUICK if quick else FULL
    peaks = find_peaks(device)
    limit = largest or (LARGEST_CPU if device.is_cpu else max(sizes["faces"]))
    for face_target in sizes["faces"]:
        if face_target <= limit:
            yield from run_mesh(device, knot_model(face_target, models), sizes, peaks)
    for count in sizes["states"]:
        yield run_states(device, knot_model(sizes["state_faces"], models), count, sizes["repeats"], peaks)


def run_mesh(device, model, sizes, peaks):
    """Yield the rows of one mesh."""
    scene = ab.Scene(device=device)
    scene.add(model)
    finest, rows = model.lod_max, []
    scene.batch()
    memory = {"arrays_mib": held_mib(scene)} | used_memory(device)
    steps = sorted({max(1, round(share * model.lod_max)) for share in sizes["shares"]})
    for step in steps:
        k, nodes, entries, launches = check_update(scene, [finest - step], [finest], model.face_count)
        vertices, faces, _ = model.mesh_at(finest - step)
        peer = BvhPeer(vertices, faces, np.zeros((0, 7)), 0, device, None)
        row = {"device": device.name, "case": "one state", "faces": model.face_count, "splits": step}
        row |= {"k": int(k[0]), "share": float(f"{k[0] / model.face_count:.4g}"), "entries": entries}
        row |= {"nodes_refitted": int(nodes[0]), "bound": int(bound_nodes(int(k[0]), model.face_count))}
        row["full"] = entries > full_refit_fraction(device) * model.face_count  # what the library chooses
        row |= time_update(scene, [finest - step], [finest], launches, device, sizes["repeats"])
        # Not in turn with the others, whose tree it would drive out of the caches.
        row |= summarise("bvh_build", time_in_turn({"build": peer.rebuild}, device, sizes["repeats"])["build"])
        row |= memory | update_roofline(row["k"], row["nodes_refitted"], entries, row["update_ms"], peaks)
        rows.append(row)
        yield row
    yield {
        "device": device.name,
        "case": "crossover",
        "faces": model.face_count,
        "crossover_k": (crossover := find_crossover(rows, "k")),
        "crossover_share": crossover and round(crossover / model.face_count, 4),
        "crossover_entries": find_crossover(rows, "entries"),
        "full_share": full_refit_fraction(device),
        "slope": fit_slope([row["k"] for row in rows], [row["update_ms"] for row in rows]),
        "host_build_ms": time_host_build(model),
    }


def time_host_build(model, repeats=3):
    """Return the median time [ms] of ACTIVE-BUILD over the finest mesh, on the host."""
    vertices, faces, _ = model.mesh_at(model.lod_max)
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        tree.active_build(vertices, faces)
        times.append(1e3 * (time.perf_counter() - begin))
    return round(float(np.median(times)), 2)


def run_states(device, model, count, repeats, peaks):
    """Return the row of many states of a model, each at a LOD of its own, moved by a few splits in one call."""
    step = model.lod_max // STATES_PER_MODEL
    scene = ab.Scene(device=device)
    back = []
    for i in range(count):
        if i % STATES_PER_MODEL == 0:
            clone = copy.copy(model)  # another model to the scene: no state is shared
        back.append(model.lod_max - step * (i % STATES_PER_MODEL))
        scene.add(clone, lod=back[-1])
    there = [lod - max(1, step // 4) for lod in back]
    k, nodes, entries, launches = check_update(scene, there, back, model.face_count)
    if len(k) != count:
        raise RuntimeError(f"{len(k)} states moved in place of {count}")
    row = {"device": device.name, "case": "many states", "faces": model.face_count, "states": count}
    row |= {"k": int(k.sum()), "entries": entries, "nodes_refitted": int(nodes.sum())}
    row["bound"] = int(sum(bound_nodes(int(x), model.face_count) for x in k))
    row |= time_update(scene, there, back, launches, device, repeats)
    row["us_a_state"] = round(1e3 * row["update_ms"] / count, 3)
    row |= {"arrays_mib": held_mib(scene)} | used_memory(device)
    return row | update_roofline(row["k"], row["nodes_refitted"], entries, row["update_ms"], peaks)
