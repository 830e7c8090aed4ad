"""Figure 6: the update against k, with the crossover, and the update's share of the query time."""

import numpy as np

import warp_abtree as ab
from warp_abtree.testing import upload_lods

from ...cases.update import bound_nodes, check_update
from ...tables import pick
from ...timing import crossover
from .meshes import PosedPairs, paper_models

# Fractions of the splits between the finest LOD and the other; the last is the base mesh, where k = n.
FRACTIONS = (1e-5, 1e-4, 3e-4, 0.001, 0.003, 0.006, 0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5, 0.75, 1.0)
QUICK_FRACTIONS = (1e-5, 0.003, 0.03, 0.1, 0.3, 1.0)
CLOSE_TO_N = 0.5  # "except for the cases when k is very close to n"
TENTH = 0.1  # k of all faces, at most
BATCH_FACES = 10_000  # of a model of which a GPU has a thousand states
# Name, and how far B is pushed into A as a fraction of A's longest side.
CONFIGURATIONS = (("touching", 0.001), ("light", 0.03), ("deep", 0.2))


def run_figure_6(context):
    """Yield one row a model and k.

    A model goes from its finest level of detail to a coarser one; k faces change. For figure 6 updates are repeated at
    the LOD that they reach, where refinement finds nothing to do, as captured launches (one core on the CPU), beside
    those of the whole tree. Nodes are counted by the marking itself.
    """
    for model in paper_models(context):
        context.progress(model.name)
        scene = ab.Scene(context.device)
        scene.add(model)
        finest = model.lod_max
        steps = {max(1, round(fraction * finest)) for fraction in context.size(FRACTIONS, QUICK_FRACTIONS)}
        # The split that touches the fewest faces: k as near to 1 as the mesh has it.
        least = int(np.argmin(np.diff(model.progressive.split_start)))
        for home, there in [(least + 1, least), *((finest, finest - step) for step in sorted(steps))]:
            yield time_move(context, scene, model, home, there)


def time_move(context, scene, model, home, there):
    """Return the row of one LOD change, both kinds of refit checked against each other first."""
    scene.set_lods([home])
    k, nodes, entries, launches = check_update(scene, [there], [home], model.face_count)
    scene.set_lods([there])
    # In turn, at the same LOD: a refit repeated alone is one that the processor knows by heart.
    times = context.time_graphs({kind: forth for kind, (forth, _) in launches.items()})
    scene.set_lods([home])
    (forth, back), (between, after) = launches["update"], launches["full"]
    moved = context.time_graphs({"there": forth, "between": between, "back": back, "after": after})
    upload_lods(scene)
    row = {"case": "move", "from_finest": home == model.lod_max, "model": model.name, "faces": model.face_count}
    row |= {"splits": home - there, "k": k[0], "share": k[0] / model.face_count, "entries": entries}
    row |= {"nodes": nodes[0], "bound": bound_nodes(int(k[0]), model.face_count)}
    times = {"refit_ms": times["update"], "full_ms": times["full"], "update_ms": (moved["there"] + moved["back"]) / 2}
    return row | times


def by_model(rows):
    """Return the rows of moves of each model, in the order of k."""
    moves = sorted(pick(rows, case="move"), key=lambda row: (row["k"], row["splits"]))
    return {name: pick(moves, model=name) for name in dict.fromkeys(row["model"] for row in rows)}


def correlate(rows, one, other):
    return float(np.corrcoef([row[one] for row in rows], [row[other] for row in rows])[0, 1])


def near_moves(moves):
    """Return the moves up to k = n/2."""
    return [row for row in moves if row["share"] <= CLOSE_TO_N]


def fit_scale(moves) -> float:
    """Return the time a node of equation (1) [ms], fitted up to k = n/2."""
    bound, time = (np.array([row[key] for row in near_moves(moves)], float) for key in ("bound", "refit_ms"))
    return float(bound @ time / (bound @ bound))


def fit_figure_6(rows):
    """Return a row a model: correlation with equation (1), its one scale, the greatest deviations, the crossover."""
    found = []
    for name, moves in by_model(rows).items():
        near, used = near_moves(moves), [row["nodes"] / row["bound"] for row in moves]
        logs = np.log([row["refit_ms"] / row["full_ms"] for row in moves])
        row = {"model": name, "faces": moves[0]["faces"], "k_min": moves[0]["k"], "ns_a_node": 1e6 * fit_scale(moves)}
        row["correlation"], row["correlation_all"] = (correlate(some, "bound", "refit_ms") for some in (near, moves))
        row |= {"correlation_nodes": correlate(near, "nodes", "refit_ms")}
        row |= {"correlation_counted": correlate(near, "bound", "nodes")}
        row |= {"nodes_of_bound_min": min(used), "nodes_of_bound_max": max(used)}
        found.append(row | {"crossover": crossover([row["share"] for row in moves], logs, 0.0)})
    return found


def fitted_moves(rows):
    """Return the rows of moves from the finest LOD, each with the time of equation (1), scaled once a model."""
    moves = [(fit_scale(moves), row) for moves in by_model(rows).values() for row in moves]
    return pick([row | {"fitted_ms": scale * row["bound"]} for scale, row in moves], from_finest=True)


def thin(rows):
    """Leave two rows of three away; those with the least and the greatest k stay."""
    return [row for moves in by_model(rows).values() for row in moves[:-1:3] + moves[-1:]]


def find_tenth(model) -> int:
    """Return the coarsest LOD whose way from the finest changes less than a tenth of the faces."""
    slices, starts = model.progressive.split_face, model.progressive.split_start
    low, high = 1, model.lod_max
    while low < high:
        middle = (low + high + 1) // 2
        changed = len(np.unique(slices[starts[model.lod_max - middle] :]))
        low, high = (middle, high) if changed < TENTH * model.face_count else (low, middle - 1)
    return model.lod_max - low


def run_share(context):
    """Yield one row a model, configuration and number of object pairs.

    Pairs of one model in random rotations: just touching, pushed into each other by 3 % and by 20 % of the longest
    side. The first object of every pair, with a tree state of its own, moves between the finest level of detail and the
    coarsest one for which k stays below 10 % of the faces; then all intersecting face pairs are asked. Where pairs
    share one state, one update serves all. A GPU has batches of 1,024 of the smaller models, too.
    """
    most, batch = context.size(32, 4), context.size(1024, 8)
    for model in paper_models(context, largest=False):
        context.progress(model.name)
        counts = [(1, 1), (most, most), (most, 1)]
        if context.device.is_cuda and model.face_count <= BATCH_FACES:
            counts += [(batch, batch), (batch, 1)]
        for count, states in counts:
            yield from time_shares(context, model, find_tenth(model), count, states)


def time_shares(context, model, lod, count, states):
    """Yield the rows of a number of pairs and states, one a configuration."""
    posed = PosedPairs(model, count, context.device, first_count=states, steps=context.size(32, 12))
    scene = posed.scene
    home = [model.lod_max] * scene.object_count
    there = [lod] * states + home[states:]
    k, _, _, launches = check_update(scene, there, home, model.face_count)
    if not (k < TENTH * model.face_count).all():
        raise RuntimeError(f"k is {k.max()} of {model.face_count}")
    moved = context.time_graphs(dict(zip(("there", "back"), launches["update"], strict=True)))
    upload_lods(scene)
    scene.set_lods(there)
    about = {"model": model.name, "faces": model.face_count, "pairs": count, "states": states, "k": int(k.max())}
    about |= {"k_share": k.max() / model.face_count, "update_ms": (moved["there"] + moved["back"]) / 2}
    for name, depth in CONFIGURATIONS:
        posed.place(depth)
        queries = {f"{output}_ms": ab.Query(scene, output, pairs=posed.pairs) for output in ("faces", "any")}
        row = about | {"configuration": name, "hits": len(queries["faces_ms"].run().faces)}
        queries["any_ms"].run()
        for output, query in queries.items():
            row |= context.time_graphs({output: query.launch})
        yield row | {"ratio": row["update_ms"] / row["faces_ms"], "ratio_any": row["update_ms"] / row["any_ms"]}
