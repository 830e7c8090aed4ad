"""Experiments of the paper on the update: figure 6, the crossover, and the update's share of the query time."""

import math

import numpy as np

import warp_abtree as ab

from .html import COLOURS, MARKERS
from .paper_setup import PosedPairs, hear_batch, paper_models, refit_launch
from .parts import Claim, Column, Figure, Part, Table, pick
from .update import REGIMES, bound_nodes, check_update

# Shares of the splits between the finest LOD and the other; the last is the base mesh, where k = n.
SHARES = (1e-5, 1e-4, 3e-4, 0.001, 0.003, 0.006, 0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5, 0.75, 1.0)
QUICK_SHARES = (1e-5, 0.003, 0.03, 0.1, 0.3, 1.0)
CLOSE_TO_N = 0.5  # "except for the cases when k is very close to n"
AGREES = 0.95  # least correlation that is called agreement


def run_figure_6(context):
    """Yield one row a model and k, and one a model and k of random faces, only counted."""
    models = paper_models(context)
    for i, model in enumerate(models):
        scene = ab.Scene(context.device)
        scene.add(model)
        finest = model.lod_max
        shares = context.size(SHARES, QUICK_SHARES)
        moves = [(finest, finest - step) for step in sorted({max(1, round(share * finest)) for share in shares})]
        # The split that touches the fewest faces: k as near to 1 as the mesh has it.
        least = int(np.argmin(np.diff(model.progressive.split_start)))
        for done, (home, there) in enumerate([(least + 1, least), *moves]):
            context.progress(f"{model.name}", i * len(moves) + done, len(models) * (len(moves) + 1))
            yield time_move(context, scene, model, home, there)
        leaf_node, rng = model.tree.leaf_node, np.random.default_rng(0)
        for k in np.unique(np.geomspace(1, model.face_count, 25).round().astype(int)):
            leaves = leaf_node[rng.choice(model.face_count, k, replace=False)]
            row = {"case": "random faces", "model": model.name, "faces": model.face_count, "k": int(k)}
            yield row | {"nodes": count_ancestors(leaves), "bound": bound_nodes(int(k), model.face_count)}


def count_ancestors(leaves) -> int:
    """Return how many nodes a bottom-up marking of these leaves marks, themselves among them."""
    marked, nodes = np.empty(0, int), np.asarray(leaves)
    while len(nodes):
        # Leaves stand on two levels, so a node may come up twice.
        marked = np.union1d(marked, nodes)
        nodes = np.unique(nodes >> 1)
        nodes = nodes[nodes > 0]
    return len(marked)


def time_move(context, scene, model, home, there):
    """Return the row of one LOD change, both kinds of refit checked against each other first."""
    scene.set_lods([home])
    k, nodes, entries, launches = check_update(scene, [there], [home], model.face_count)
    part = refit_launch(scene, hear_batch(scene, [there], REGIMES["update"]))
    scene.set_lods([home])
    whole = refit_launch(scene, hear_batch(scene, [there], REGIMES["full"]))
    # In turn, at the same LOD: a refit repeated alone is one that the processor knows by heart.
    times = context.time_graphs({"refit": part, "full": whole})
    scene.set_lods([home])
    there_launch, back_launch = launches["update"]
    moved = context.time_graphs({"there": there_launch, "between": whole, "back": back_launch, "after": whole})
    scene.batch().states.upload_slots()
    return {
        "case": "move",
        "from_finest": home == model.lod_max,
        "model": model.name,
        "faces": model.face_count,
        "splits": home - there,
        "k": int(k[0]),
        "share": k[0] / model.face_count,
        "entries": entries,
        "nodes": int(nodes[0]),
        "bound": bound_nodes(int(k[0]), model.face_count),
        "refit_ms": times["refit"],
        "full_ms": times["full"],
        "update_ms": (moved["there"] + moved["back"]) / 2,
    }


def fit_figure_6(rows):
    """Return a row a model: correlation with equation (1), its one scale, the greatest deviations, the crossover."""
    found = []
    for name in dict.fromkeys(row["model"] for row in rows):
        moves = sorted(pick(rows, model=name, case="move"), key=lambda row: row["k"])
        near = [row for row in moves if row["share"] <= CLOSE_TO_N]
        bound, time, nodes = (np.array([row[key] for row in near], float) for key in ("bound", "refit_ms", "nodes"))
        scale = float(bound @ time / (bound @ bound))
        logs = np.log([row["refit_ms"] / row["full_ms"] for row in moves])
        found.append(
            {
                "model": name,
                "faces": moves[0]["faces"],
                "points": len(moves),
                "k_min": moves[0]["k"],
                "correlation": float(np.corrcoef(bound, time)[0, 1]),
                "correlation_all": correlate(moves, "bound"),
                "correlation_nodes": float(np.corrcoef(nodes, time)[0, 1]),
                "correlation_counted": float(np.corrcoef(bound, nodes)[0, 1]),
                "ns_a_node": 1e6 * scale,
                "nodes_of_bound_min": min(row["nodes"] / row["bound"] for row in moves),
                "nodes_of_bound_max": max(row["nodes"] / row["bound"] for row in moves),
                "crossover": find_crossover([row["share"] for row in moves], logs),
            }
        )
    return found


def correlate(rows, key):
    return float(np.corrcoef([row[key] for row in rows], [row["refit_ms"] for row in rows])[0, 1])


def find_crossover(shares, logs):
    """Return the k/n from which on a full refit costs less: interpolated, 0 if always, None if never."""
    above = np.flatnonzero(np.asarray(logs) < 0)
    if not len(above):
        return 0.0
    i = int(above[-1])
    if i == len(logs) - 1:
        return None
    part = -logs[i] / (logs[i + 1] - logs[i])
    return float(math.exp(math.log(shares[i]) * (1 - part) + math.log(shares[i + 1]) * part))


def thin(rows):
    """Leave two rows of three away; those with the least and the greatest k stay."""
    kept = []
    for name in dict.fromkeys(row["model"] for row in rows):
        mine = sorted(pick(rows, model=name), key=lambda row: (row["k"], row["splits"]))
        kept += mine[:-1:3] + mine[-1:]
    return kept


def judge_agreement(rows):
    fits = fit_figure_6(rows)
    found = "; ".join(f"{fit['model']} {fit['correlation']:.3f}" for fit in fits)
    return all(fit["correlation"] >= AGREES for fit in fits), f"Correlation up to k = n/2, at least {AGREES}: {found}."


def judge_bound(rows):
    worst = max(row["nodes"] / row["bound"] for row in rows)
    held = all(row["nodes"] <= row["bound"] for row in rows)
    return held, f"At most {worst:.1%} of equation (1), over {len(rows)} counts."


def draw_figure_6(rows, figure):
    names = list(dict.fromkeys(row["model"] for row in rows))
    axes = figure.subplots(2, len(names), squeeze=False)
    fits = {fit["model"]: fit for fit in fit_figure_6(rows)}
    for column, name in enumerate(names):
        moves = sorted(pick(rows, model=name, case="move"), key=lambda row: row["k"])
        chance = pick(rows, model=name, case="random faces")
        k = [row["k"] for row in moves]
        scale = fits[name]["ns_a_node"] * 1e-6
        top = axes[0][column]
        top.plot(k, [row["refit_ms"] for row in moves], MARKERS[0], color=COLOURS[0], label="refit, measured")
        top.plot(k, [scale * row["bound"] for row in moves], "-", color=COLOURS[1], label="equation (1), scaled once")
        whole = pick(moves, from_finest=True)
        top.plot(
            [row["k"] for row in whole], [row["full_ms"] for row in whole], "--", color=COLOURS[6], label="full refit"
        )
        top.set(title=f"{name}: r = {fits[name]['correlation']:.3f}", xlabel="k [faces]", ylim=(0, None))
        top.locator_params(axis="x", nbins=4)
        low = axes[1][column]
        low.loglog(k, [row["nodes"] for row in moves], MARKERS[0], color=COLOURS[0], label="counted, LOD change")
        low.loglog(
            [row["k"] for row in chance], [row["nodes"] for row in chance], ":", color=COLOURS[2],
            label="counted, random faces",
        )  # fmt: skip
        low.loglog([row["k"] for row in chance], [row["bound"] for row in chance], "-", color=COLOURS[1])
        low.plot([], [], "-", color=COLOURS[1], label="equation (1)")
        low.set(xlabel="k [faces]")
    axes[0][0].set_ylabel("time [ms]")
    axes[1][0].set_ylabel("nodes refitted")
    axes[0][0].legend()
    axes[1][0].legend()


FIGURE_6 = Part(
    "figure6",
    "Figure 6: the update against k",
    run_figure_6,
    about="A model goes from its finest level of detail to a coarser one; k faces change. Marking and refit are timed "
    "alone, as the paper's figure 6 has them, as captured launches (one core on the CPU), beside a refit of the whole "
    "tree. Boxes are compared bit by bit between both kinds of refit, and with those of the way back, before "
    "anything is timed. Nodes are counted by the marking itself; the dotted line counts k faces drawn at random.",
    tables=(
        Table(
            "figure6_fit",
            "Agreement with equation (1), and where a full refit costs less",
            (
                Column("model", "model"),
                Column("faces", "faces n", ",d"),
                Column("k_min", "least k", ",d"),
                Column("correlation", "time and equation (1), k up to n/2", ".3f"),
                Column("correlation_all", "time and equation (1), all k", ".3f"),
                Column("correlation_counted", "nodes counted and equation (1), k up to n/2", ".3f"),
                Column("correlation_nodes", "time and nodes counted, k up to n/2", ".3f"),
                Column("ns_a_node", "scale [ns]", ".1f"),
                Column("nodes_of_bound_min", "least share of equation (1) counted", ".0%"),
                Column("nodes_of_bound_max", "greatest", ".0%"),
                Column("crossover", "full refit is cheaper from k/n", ".2f"),
            ),
            select=fit_figure_6,
            note="Correlations are Pearson's. The last column is 0 where a full refit never costs more, - where it "
            "always does.",
        ),
        Table(
            "figure6_points",
            "Figure 6 in numbers",
            (
                Column("model", "model"),
                Column("splits", "splits", ",d"),
                Column("k", "k", ",d"),
                Column("share", "k/n", ".2%"),
                Column("nodes", "nodes refitted", ",d"),
                Column("bound", "equation (1)", ",.0f"),
                Column("refit_ms", "refit [ms]", ".4f"),
                Column("update_ms", "with mesh refinement [ms]", ".4f"),
                Column("full_ms", "full refit [ms]", ".4f"),
            ),
            where={"case": "move"},
            select=thin,
        ),
    ),
    figures=(
        Figure(
            "figure6",
            "Refit against k",
            draw_figure_6,
            size=(11, 6.5),
            note="Above: time, and equation (1) times one factor a model, fitted up to k = n/2. Below: nodes refitted "
            "and the bound itself, both axes logarithmic.",
        ),
    ),
    claims=(
        Claim(
            "The refit's time is nearly proportional to equation (1), except for k close to n",
            "paper, section 5.2, figure 6",
            judge_agreement,
        ),
        Claim("An update never refits more nodes than equation (1)", "paper, section 3.2.3", judge_bound),
    ),
)


# --- the update's share of the query time ----------------------------------------------------------------------------

TENTH = 0.1  # k of all faces, at most
PAPER_SHARE = 0.15
# Name, and how far B is pushed into A as a part of A's longest side.
CONFIGURATIONS = (("touching", 0.001), ("light", 0.03), ("deep", 0.2))


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
    """Yield one row a model, configuration and number of object pairs."""
    models = paper_models(context, largest=False)
    most = context.size(32, 4)
    for i, model in enumerate(models):
        lod = find_tenth(model)
        for j, (count, states) in enumerate([(1, 1), (most, most), (most, 1)]):
            context.progress(f"{model.name}, {count} pairs", 3 * i + j, 3 * len(models))
            yield from time_shares(context, model, lod, count, states)


def time_shares(context, model, lod, count, states):
    posed = PosedPairs(model, count, context.device, firsts=states, steps=context.size(32, 12))
    scene = posed.scene
    home = [model.lod_max] * scene.object_count
    there = [lod] * states + home[states:]
    k, _, _, launches = check_update(scene, there, home, model.face_count)
    if not (k < TENTH * model.face_count).all():
        raise RuntimeError(f"k is {k.max()} of {model.face_count}")
    moved = context.time_graphs(dict(zip(("there", "back"), launches["update"], strict=True)))
    scene.batch().states.upload_slots()
    scene.set_lods(there)
    update = (moved["there"] + moved["back"]) / 2
    for name, depth in CONFIGURATIONS:
        posed.push(depth)
        row = {"model": model.name, "faces": model.face_count, "configuration": name, "pairs": count}
        row["states"] = states
        row |= {"k": int(k.max()), "k_share": k.max() / model.face_count, "update_ms": update}
        for output in ("faces", "any"):
            query = ab.Query(scene, output, pairs=posed.pairs)
            result = query.run()
            row[f"{output}_ms"] = context.time_graphs({"query": query.launch})["query"]
            if output == "faces":
                row["hits"] = len(result.faces)
        row["ratio"] = update / row["faces_ms"]
        row["ratio_any"] = update / row["any_ms"]
        yield row


def judge_share(rows):
    held = [row for row in rows if row["ratio"] < PAPER_SHARE]
    ratios = [row["ratio"] for row in rows]
    found = f"{len(held)} of {len(rows)} cases; the update takes {min(ratios):.1%} to {max(ratios):.0%} of a query."
    by = ", ".join(
        f"{name} {min(r):.1%} to {max(r):.0%}"
        for name, _ in CONFIGURATIONS
        if (r := [row["ratio"] for row in pick(rows, configuration=name)])
    )
    return len(held) == len(rows), f"{found} By configuration: {by}."


def draw_share(rows, figure):
    axes = figure.subplots()
    names = [name for name, _ in CONFIGURATIONS]
    kinds = list(dict.fromkeys((row["model"], row["pairs"], row["states"]) for row in rows))
    for i, (model, pairs, states) in enumerate(kinds):
        found = [pick(rows, model=model, pairs=pairs, states=states, configuration=name)[0] for name in names]
        label = f"{model}, {pairs} {'pair' if pairs == 1 else 'pairs'}{', one state' if states < pairs else ''}"
        places = np.arange(len(names)) + (i - (len(kinds) - 1) / 2) * 0.85 / len(kinds)
        colour, hatch = COLOURS[i // 3], ("", "//", "..")[i % 3]
        heights = [100 * row["ratio"] for row in found]
        axes.bar(places, heights, 0.8 / len(kinds), color=colour, hatch=hatch, edgecolor="white", label=label)
    axes.axhline(100 * PAPER_SHARE, color="#444444", linestyle="--")
    axes.text(len(names) - 0.5, 100 * PAPER_SHARE, "the paper's\n15 %", ha="left", va="center", backgroundcolor="white")
    axes.set_xlim(-0.5, len(names) - 0.2)
    axes.set(yscale="log", ylabel="update / query of all face pairs [%]")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("")
    axes.set_xticks(range(len(names)), names)
    figure.legend(loc="outside lower center", ncols=3)


SHARE = Part(
    "share",
    "The update's share of the query time",
    run_share,
    about="Pairs of one model in random rotations: just touching, pushed into each other by 3 % and by 20 % of the "
    "longest side. The first object of every pair, with a tree state of its own, moves between the finest level of "
    "detail and the coarsest one for which k stays below 10 % of the faces; then all intersecting face pairs are "
    "asked. Where "
    "32 pairs share one state, as objects of one model at one level of detail do here, one update serves all. Mesh "
    "refinement, marking and refit of all objects in one launch sequence, beside one launch of the "
    "query; both are captured (one core on the CPU).",
    tables=(
        Table(
            "share",
            "Update with k just below 10 % of the faces, beside a query",
            (
                Column("model", "model"),
                Column("pairs", "pairs", ",d"),
                Column("states", "states updated", ",d"),
                Column("configuration", "configuration"),
                Column("k_share", "k/n", ".1%"),
                Column("hits", "face pairs", ",d"),
                Column("update_ms", "update [ms]", ".3f"),
                Column("faces_ms", "query, all face pairs [ms]", ".3f"),
                Column("ratio", "update / query", ".1%"),
                Column("any_ms", "query, yes or no [ms]", ".3f"),
                Column("ratio_any", "update / yes-or-no query", ".0%"),
            ),
        ),
    ),
    figures=(Figure("share", "Update time as a share of the query time", draw_share, size=(8, 5)),),
    claims=(
        Claim(
            "With k below 10 % of the faces the update takes less than 15 % of the query time",
            "paper, section 5.2",
            judge_share,
        ),
    ),
)
