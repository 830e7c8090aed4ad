"""Queries at a level of detail beside a static tree built for that level, and time against the level of detail."""

import warp_abtree as ab

from ...shapes import scene_of_objects
from .meshes import PosedPairs, paper_models

FRACTIONS = (1.0, 0.5, 0.3, 0.2, 0.1, 0.05, 0.03, 0.02, 0.01)
QUICK_FRACTIONS = (1.0, 0.1, 0.01)
DEPTH = 0.1  # how far B is pushed into A, as a fraction of A's longest side


def run(context):
    """Yield one row a model and LOD: the same poses asked of an AB-Tree at that LOD and of a tree built for it.

    The static tree is built over the mesh of that level alone, by the same code; the face pairs that both find must be
    the same ones. Poses stay, so that at coarse levels some pairs come apart.
    """
    fractions = context.size(FRACTIONS, QUICK_FRACTIONS)
    for model in paper_models(context, largest=False):
        context.progress(model.name)
        count = context.size(1024 if context.device.is_cuda else 64, 8)
        posed = PosedPairs(model, count, context.device, share=True, steps=context.size(32, 12))
        posed.place(DEPTH)
        lods = {model.lod_for(fraction=fraction) if fraction < 1 else model.lod_max for fraction in fractions}
        for lod in sorted(lods, reverse=True):
            yield compare_static(context, model, lod, posed)


def compare_static(context, model, lod, posed):
    """Return the row of one LOD, where both trees must find the same face pairs."""
    count = len(posed.pairs)
    posed.scene.set_lods([lod] * posed.scene.object_count)
    vertices, faces, face_ids = model.mesh_at(lod)
    # A model whose base is the whole mesh: nothing is collapsed, its tree is built over these faces alone.
    fixed = ab.Model.from_arrays(vertices, faces, base_faces=len(faces))
    scenes = {"ours": posed.scene, "static": scene_of_objects(context.device, fixed, posed.poses)}
    queries = {who: ab.Query(scene, "faces", pairs=posed.pairs) for who, scene in scenes.items()}
    found = {who: query.run() for who, query in queries.items()}
    named = found["static"].faces.copy()
    named[:, 1:] = face_ids[named[:, 1:]]
    if {tuple(row) for row in named.tolist()} != {tuple(row) for row in found["ours"].faces.tolist()}:
        raise RuntimeError(f"{model.name} at LOD {lod}: the static tree finds other face pairs")
    any_queries = {f"any_{who}": ab.Query(scene, "any", pairs=posed.pairs) for who, scene in scenes.items()}
    for query in any_queries.values():
        query.run()
    # Two at a time, so that each finds the caches as the other left them.
    times = context.time_graphs({who: query.launch for who, query in queries.items()})
    times |= context.time_graphs({who: query.launch for who, query in any_queries.items()})
    row = {"model": model.name, "faces": len(faces), "share": len(faces) / model.face_count, "pairs": count}
    row["hits"] = len(found["ours"].faces)
    for who, result in found.items():
        row[f"{who}_us"] = 1e3 * times[who] / count
        row[f"any_{who}_us"] = 1e3 * times[f"any_{who}"] / count
        row |= {f"{who}_nodes": result.node_tests.mean(), f"{who}_triangles": result.triangle_tests.mean()}
    row["ratio"] = row["ours_us"] / row["static_us"]
    row["any_ratio"] = row["any_ours_us"] / row["any_static_us"]
    return row | {"node_ratio": row["ours_nodes"] / row["static_nodes"]}
