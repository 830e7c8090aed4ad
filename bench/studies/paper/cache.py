"""Memory and time beside a cache of static levels of detail."""

import numpy as np

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.testing import active_build, upload_lods

from ...baselines.wp_bvh import FaceBvh
from ...cases.memory import count_bytes
from .meshes import paper_models

COUNTS = (10, 50, 200)
# What a static mesh needs at least in the formats of this package.
VERTEX_BYTES, FACE_BYTES, NODE_BYTES = 24, 12, 32


def run(context):
    """Yield one row a model and number of LODs, from base to original in equal ratios of the faces.

    The cache holds a mesh and a tree for each LOD, counted; ours are the bytes of the model's device arrays, which
    serve any LOD, and of tree states. The time is that of a change to the neighbouring level, both ways, mesh
    refinement included, mean of up to eight changes; a rebuild boxes the faces there and builds a wp.Bvh over them (its
    mesh being at hand); or ACTIVE-BUILD on the host.
    """
    for model in paper_models(context, largest=False):
        context.progress(model.name)
        model_mib, state_mib = (size / 2**20 for size in measure_bytes(model, context.device))
        for count in COUNTS:
            lods = ab.Ladder([model], count - 1, "ratio").lod[0]
            row = {"model": model.name, "faces": model.face_count, "lods": count, "ours_mib": model_mib + state_mib}
            row |= {"states_mib": model_mib + count * state_mib, "cache_mib": cache_bytes(model, lods) / 2**20}
            yield row | time_changes(context, model, lods)


def measure_bytes(model, device):
    """Return the bytes of a model's arrays and of one tree state."""
    scene = ab.Scene(device)
    scene.add(model)
    return tuple(map(count_bytes, scene.batch().pools[:2]))


def cache_bytes(model, lods) -> int:
    """Return what static meshes with trees at these LODs take at least."""
    total = 0
    for lod in lods:
        vertices, faces, _ = model.mesh_at(int(lod))
        total += VERTEX_BYTES * len(vertices) + FACE_BYTES * len(faces) + NODE_BYTES * (2 * len(faces) - 1)
    return total


def time_changes(context, model, lods):
    """Return columns of changes between neighbouring LODs of a ladder, some of them spread over it."""
    scene = ab.Scene(context.device)
    scene.add(model)
    rows = []
    for i in np.unique(np.linspace(0, len(lods) - 2, context.size(8, 3)).astype(int)):
        low, high = int(lods[i]), int(lods[i + 1])
        if low == high:
            continue
        scene.set_lods([high])
        # By the kind of refit that the library takes.
        launches = {"there": testing.repeat_update(scene.set_lods([low]))}
        back = scene.set_lods([high])
        fraction = back.k[0] / model.face_count
        times = context.time_graphs(launches | {"back": testing.repeat_update(back)})
        upload_lods(scene)
        vertices, faces, _ = model.mesh_at(low)
        rebuilt = context.time_alone({"bvh": FaceBvh(vertices, faces, context.device).rebuild})["bvh"]
        built = context.time_launches({"build": lambda v=vertices, f=faces: active_build(v, f)}, 1, on_core=True)
        row = {"k_share": fraction, "update_ms": (times["there"] + times["back"]) / 2}
        rows.append(row | {"bvh_ms": rebuilt, "build_ms": built["build"]})
    found = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    return found | {"changes": len(rows), "ratio": found["bvh_ms"] / found["update_ms"]}
