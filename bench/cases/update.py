"""Time of ACTIVE-UPDATE against k, beside a full refit of the same state and a tree built from scratch; many states.

The library chooses between both kinds of refit; here each is forced, so that both are measured on the same states, in
turn. Their bits are compared before anything is timed.
"""

import copy
import math

import numpy as np

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.testing import full_refit_fraction, read_bits, state_lods, upload_lods

from ..baselines.wp_bvh import FaceBvh
from ..memory import memory_columns
from ..meshes import knot_model
from ..timing import make_runs, ratio_of, summarise, time_call, time_in_turn, time_rounds

# Fractions of the splits between the finest LOD and the other.
FRACTIONS = (1e-5, 1e-4, 3e-4, 1e-3, 3e-3, 0.01, 0.03, 0.06, 0.1, 0.15, 0.2, 0.3, 0.5, 0.9)
FULL = {"faces": (4000, 16000, 64000, 250_000, 1_000_000), "states": (1, 16, 256, 4096), "state_faces": 500}
FULL |= {"fractions": FRACTIONS, "repeats": 7}
CPU = FULL | {"faces": (4000, 16000, 64000)}
QUICK = {"faces": (200, 600), "fractions": (0.01, 0.1, 0.9), "states": (1, 12), "state_faces": 200, "repeats": 2}
STATES_PER_MODEL = 8
REFITS = {"update": False, "full": True}  # whether states are refitted whole


def run(device, quick=False, models=None):
    """Yield one row a fraction of a mesh, and one a number of states moved at once.

    Columns: nodes are those of the partial update, counted; entries are the faces of the slice between the LODs,
    repeats included; full tells whether the library would refit the whole tree. bvh_build boxes the faces at the LOD
    and builds a wp.Bvh over them.
    """
    sizes = QUICK if quick else CPU if device.is_cpu else FULL
    for face_target in sizes["faces"]:
        yield from run_mesh(device, knot_model(face_target, models), sizes)
    for count in sizes["states"]:
        yield run_states(device, knot_model(sizes["state_faces"], models), count, sizes["repeats"])


def bound_nodes(k, faces):
    """Return the bound on nodes refitted, equation (1), faces rounded up to a power of two."""
    return k * (math.ceil(math.log2(faces)) - math.log2(k) + 2) - 1 if k else 0


def check_update(scene, there, back, faces):
    """Move to other LODs and back by both kinds of refit and compare all bits; return k and nodes refitted of each
    state by the partial update, faces in its slices, and by kind of refit the launches that repeat both updates. Raise
    a RuntimeError where bits or k differ, the bound of equation (1) is passed, or states have changed places.
    """
    begin, start = state_lods(scene), read_bits(scene)
    launches, bits, counts = {}, {}, {}
    for kind in REFITS:
        with testing.force_refits(REFITS[kind]):
            forth = scene.set_lods(there)
            counts[kind] = forth.k[np.argsort(forth.state)]
            if not REFITS[kind]:
                k, nodes, entries = forth.k.copy(), forth.nodes_refitted.copy(), int(forth.slice_length.sum())
            forth = testing.repeat_update(forth)
            bits[kind] = read_bits(scene)
            home = testing.repeat_update(scene.set_lods(back))
        if state_lods(scene) != begin:
            raise RuntimeError("states do not return to where they were")
        if not all(map(np.array_equal, start, read_bits(scene))):
            raise RuntimeError(f"{kind}: the way back leaves other bits than were there before")
        launches[kind] = forth, home
    if not np.array_equal(counts["update"], counts["full"]):
        raise RuntimeError(f"a partial update changes {k.sum()} faces, a full refit {counts['full'].sum()}")
    if not all(map(np.array_equal, bits["update"], bits["full"])):
        raise RuntimeError("a partial update and a full refit leave different bits")
    if any(nodes[i] > bound_nodes(int(k[i]), faces) for i in range(len(k))):
        raise RuntimeError("more nodes refitted than equation (1) allows")
    return k, nodes, entries, launches


def measure_update(scene, there, back, faces, repeats):
    """Check and time moves to other LODs and back; return their columns, times in [ms].

    update, full: device time of refinement, marking and refit, there and back: graph replays on CUDA. wall: whole calls
    of `set_lods` as the library chooses, planning and uploads included. In turn, but each time there and back twice, of
    which the second counts: what one kind of refit leaves in the caches is of no use to the other.
    """
    device = scene.device
    k, nodes, entries, launches = check_update(scene, there, back, faces)
    bound = int(sum(bound_nodes(int(each), faces) for each in k))
    row = {"faces": faces, "states": len(k), "k": k.sum(), "entries": entries}
    row |= {"nodes_refitted": nodes.sum(), "bound": bound}
    ways = {(kind, way): launch for kind, both in launches.items() for way, launch in enumerate(both)}
    runs = make_runs(ways, device)
    turns = {(kind, trip, way): runs[kind, way] for kind in REFITS for trip in (0, 1) for way in (0, 1)}
    taken = time_rounds(turns, repeats)
    times = {kind: taken[kind, 1, 0] + taken[kind, 1, 1] for kind in REFITS}
    upload_lods(scene)
    calls = {"there": lambda: scene.set_lods(there), "back": lambda: scene.set_lods(back)}
    walls = time_rounds({way: time_call(call, device) for way, call in calls.items()}, repeats)
    row |= summarise(times | {"wall": walls["there"] + walls["back"]})
    return row | {"ratio": ratio_of(times["full"], times["update"])}


def run_mesh(device, model, sizes):
    """Yield the rows of one mesh, a fraction each."""
    scene = ab.Scene(device=device)
    scene.add(model)
    finest, repeats = model.lod_max, sizes["repeats"]
    memory = memory_columns(scene)
    for step in sorted({max(1, round(fraction * finest)) for fraction in sizes["fractions"]}):
        row = {"case": "one state", "splits": step}
        row |= measure_update(scene, [finest - step], [finest], model.face_count, repeats)
        row["full"] = row["entries"] > full_refit_fraction(device) * model.face_count  # what the library chooses
        baseline = FaceBvh(*model.mesh_at(finest - step)[:2], device)
        # Not in turn with the others, whose tree it would drive out of the caches.
        yield row | summarise(time_in_turn({"bvh_build": baseline.rebuild}, device, repeats)) | memory


def run_states(device, model, count, repeats):
    """Return the row of many states of a model, each at a LOD of its own, moved by a few splits in one call."""
    step = model.lod_max // STATES_PER_MODEL
    back = [model.lod_max - step * (i % STATES_PER_MODEL) for i in range(count)]
    # Other models to the scene, so that no state is shared.
    clones = [copy.copy(model) for _ in range(0, count, STATES_PER_MODEL)]
    scene = ab.Scene(device=device)
    for i, lod in enumerate(back):
        scene.add(clones[i // STATES_PER_MODEL], lod=lod)
    there = [lod - max(1, step // 4) for lod in back]
    row = {"case": "many states"} | measure_update(scene, there, back, model.face_count, repeats)
    if row["states"] != count:
        raise RuntimeError(f"{row['states']} states moved in place of {count}")
    return row | memory_columns(scene)
