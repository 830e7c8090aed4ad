"""Experiments of the paper on queries: an AB-Tree at a LOD beside a static tree built for it, and time against LOD."""

from itertools import pairwise

import numpy as np

import warp_abtree as ab

from .html import COLOURS, MARKERS, STYLES
from .paper_setup import PosedPairs, paper_models
from .parts import Claim, Column, Figure, Part, Table, pick

SHARES = (1.0, 0.5, 0.3, 0.2, 0.1, 0.05, 0.03, 0.02, 0.01)
QUICK_SHARES = (1.0, 0.1, 0.01)
DEPTH = 0.1  # how far B is pushed into A, as a part of A's longest side
NOISE = 0.05  # by how much a time may seem to rise
NO_LOSS = 1.1  # most that "no performance loss" allows, noise of the clock included


def run_static(context):
    """Yield one row a model and LOD: the same poses asked of an AB-Tree at that LOD and of a tree built for it."""
    models = paper_models(context, largest=False)
    shares = context.size(SHARES, QUICK_SHARES)
    for i, model in enumerate(models):
        count = context.size(1024 if context.device.is_cuda else 64, 8)
        posed = PosedPairs(model, count, context.device, share=True, steps=context.size(32, 12))
        posed.push(DEPTH)
        lods = {model.lod_for(fraction=share) if share < 1 else model.lod_max for share in shares}
        for j, lod in enumerate(sorted(lods, reverse=True)):
            context.progress(model.name, i * len(shares) + j, len(models) * len(shares))
            yield compare_static(context, model, lod, posed)


def compare_static(context, model, lod, posed):
    """Return the row of one LOD; both trees must find the same face pairs."""
    count = len(posed.pairs)
    posed.scene.set_lods([lod] * posed.scene.object_count)
    ours = ab.Query(posed.scene, "faces", pairs=posed.pairs)
    found = ours.run()
    vertices, faces, face_ids = model.mesh_at(lod)
    # A model whose base is the whole mesh: nothing is collapsed, its tree is built over these faces alone.
    fixed = ab.Model.from_arrays(vertices, faces, base_faces=len(faces))
    other = posed.like(fixed, context.device)
    static = ab.Query(other, "faces", pairs=posed.pairs)
    same = static.run()
    named = same.faces.copy()
    named[:, 1:] = face_ids[same.faces[:, 1:]]
    if {tuple(row) for row in named.tolist()} != {tuple(row) for row in found.faces.tolist()}:
        raise RuntimeError(f"{model.name} at LOD {lod}: the static tree finds other face pairs")
    any_of_ours = ab.Query(posed.scene, "any", pairs=posed.pairs)
    any_of_static = ab.Query(other, "any", pairs=posed.pairs)
    any_of_ours.run(), any_of_static.run()
    # Two at a time, so that each finds the caches as the other left them.
    times = context.time_graphs({"ours": ours.launch, "static": static.launch})
    times |= context.time_graphs({"any_ours": any_of_ours.launch, "any_static": any_of_static.launch})
    row = {"model": model.name, "faces": len(faces), "share": len(faces) / model.face_count, "pairs": count}
    row["hits"] = len(found.faces)
    for who, result in (("ours", found), ("static", same)):
        row[f"{who}_us"] = 1e3 * times[who] / count
        row[f"any_{who}_us"] = 1e3 * times[f"any_{who}"] / count
        row[f"{who}_nodes"] = float(result.node_tests.mean())
        row[f"{who}_triangles"] = float(result.triangle_tests.mean())
    row["ratio"] = row["ours_us"] / row["static_us"]
    row["any_ratio"] = row["any_ours_us"] / row["any_static_us"]
    row["node_ratio"] = row["ours_nodes"] / row["static_nodes"]
    return row


def judge_loss(rows):
    times, nodes = [row["ratio"] for row in rows], [row["node_ratio"] for row in rows]
    worst = max(rows, key=lambda row: row["ratio"])
    found = (
        f"Time {min(times):.2f} to {max(times):.2f} times a static tree's, median {np.median(times):.2f}, box tests "
        f"{min(nodes):.2f} to {max(nodes):.2f} times; worst at {worst['faces']:,} faces of {worst['model']}. Called no "
        f"loss: at most {NO_LOSS} in every row."
    )
    return max(times) <= NO_LOSS, found


def judge_falls(rows):
    said, rises, fewer = [], [], True
    for name in dict.fromkeys(row["model"] for row in rows):
        mine = sorted(pick(rows, model=name), key=lambda row: row["faces"])
        for coarse, fine in pairwise(mine):
            rises.append(coarse["ours_us"] / fine["ours_us"] - 1)
            fewer &= all(coarse[key] <= fine[key] for key in ("ours_nodes", "ours_triangles"))
        low, high = mine[0], mine[-1]
        said.append(
            f"{name} at {low['share']:.1%} of the faces: {high['ours_us'] / low['ours_us']:.1f} times as fast, "
            f"{high['ours_nodes'] / low['ours_nodes']:.1f} times fewer box tests, "
            f"{high['ours_triangles'] / low['ours_triangles']:.1f} times fewer face tests"
        )
    risen = [rise for rise in rises if rise > 0]
    said.append(
        f"of {len(rises)} steps to a coarser level time rises in {len(risen)}, by {max([0.0, *risen]):.1%} at most "
        f"(called noise up to {NOISE:.0%})"
    )
    return fewer and max(rises) <= NOISE, "; ".join(said) + "."


def draw_lods(rows, figure):
    axes = figure.subplots(1, 2)
    for i, name in enumerate(dict.fromkeys(row["model"] for row in rows)):
        mine = pick(rows, model=name)
        x = [row["faces"] for row in mine]
        look = {"color": COLOURS[i], "marker": MARKERS[i]}
        axes[0].loglog(x, [row["ours_us"] for row in mine], STYLES[0], **look, label=f"{name}, AB-Tree")
        axes[0].loglog(x, [row["static_us"] for row in mine], STYLES[2], **look, mfc="none", label=f"{name}, static")
        axes[1].loglog(x, [row["ours_nodes"] for row in mine], STYLES[0], **look, label=f"{name}, box tests")
        axes[1].loglog(
            x, [row["ours_triangles"] for row in mine], STYLES[1], **look, mfc="none", label=f"{name}, face tests"
        )
    axes[0].set(xlabel="active faces of each object", ylabel="all face pairs [us a pair of objects]")
    axes[1].set(xlabel="active faces of each object", ylabel="tests a pair of objects")
    for one in axes:
        one.legend()


def draw_ratio(rows, figure):
    axes = figure.subplots()
    for i, name in enumerate(dict.fromkeys(row["model"] for row in rows)):
        mine = pick(rows, model=name)
        x = [100 * row["share"] for row in mine]
        look = {"color": COLOURS[i], "marker": MARKERS[i]}
        axes.semilogx(x, [row["ratio"] for row in mine], STYLES[0], **look, label=f"{name}, time")
        axes.semilogx(x, [row["node_ratio"] for row in mine], STYLES[2], **look, mfc="none", label=f"{name}, box tests")
    axes.axhline(1, color="#444444", linewidth=1)
    axes.set(xlabel="active faces [% of the original]", ylabel="AB-Tree / static tree", ylim=(0, None))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.legend(ncols=2)


STATIC = Part(
    "static",
    "Queries at a level of detail, and no loss against static meshes",
    run_static,
    about=f"Pairs of one model in random rotations, pushed into each other by {DEPTH:.0%} of the longest side, both at "
    "the same level of detail. The static tree is built over the mesh of that level alone, by the same code, and asked "
    "at the same poses; the face pairs that both find must be the same ones. Captured launches in turn, 64 pairs on "
    "one core of a CPU, 1,024 on a GPU. Poses stay, so that at coarse levels some pairs come apart.",
    tables=(
        Table(
            "static",
            "An AB-Tree at a level of detail beside a static tree",
            (
                Column("model", "model"),
                Column("faces", "active faces", ",d"),
                Column("share", "of the original", ".1%"),
                Column("hits", "face pairs", ",d"),
                Column("ours_nodes", "box tests a pair", ",.0f"),
                Column("static_nodes", "static", ",.0f"),
                Column("ours_triangles", "face tests a pair", ",.0f"),
                Column("static_triangles", "static", ",.0f"),
                Column("ours_us", "all face pairs [us a pair]", ",.2f"),
                Column("static_us", "static [us a pair]", ",.2f"),
                Column("ratio", "ratio", ".2f"),
                Column("any_ratio", "ratio, yes or no", ".2f"),
            ),
        ),
    ),
    figures=(
        Figure("lods", "Time and tests against the level of detail", draw_lods, size=(11, 4.6)),
        Figure("static", "An AB-Tree beside a static tree built for the level of detail", draw_ratio),
    ),
    claims=(
        Claim("No performance loss against static levels of detail", "paper, section 5.2", judge_loss),
        Claim("A coarser mesh takes fewer box tests and face tests, and less time", "paper, section 5.2", judge_falls),
    ),
)
