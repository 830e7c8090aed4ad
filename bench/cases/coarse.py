"""Queries at coarse LODs, each output, beside the tuned wp.Bvh over the same coarse meshes: what the dial saves."""

import numpy as np

import warp_abtree as ab

from ..baselines.wp_bvh import BvhPosed
from ..shapes import KNOT_PAIRS, knot_batches, scene_of_pairs
from ..timing import ratio_of, summarise, time_in_turn

QUICK = {"faces": 300, "pairs": (2,), "distances": (0.2,), "repeats": 3}
FRACTIONS = (1.0, 0.1, 0.01)  # of the faces


def run(device, quick=False):
    """Yield one row a number of pairs, distance and LOD: times of launches of each output and of the baseline.

    faces are those active at the LOD; ratios are the baseline's times over ours, contact_ratio contacts over faces;
    hit_ns is the time of all face pairs for each that is found.
    """
    sizes = QUICK if quick else KNOT_PAIRS
    for about, model, poses in knot_batches(device, sizes):
        for fraction in FRACTIONS:
            yield about | {"fraction": fraction} | run_batch(device, model, fraction, poses, sizes["repeats"])


def run_batch(device, model, fraction, poses, repeats):
    """Return the columns of one batch of pairs at one LOD."""
    lod = model.lod_max if fraction == 1 else model.lod_for(fraction=fraction)
    mesh = model.mesh_at(lod)[:2]
    scene, pairs = scene_of_pairs(device, model, poses)
    scene.set_lods(np.full(scene.object_count, lod))
    queries = {output: ab.Query(scene, output, pairs=pairs) for output in ("faces", "any")}
    queries["contacts"] = ab.ContactQuery(scene, pairs)
    found = {output: query.run() for output, query in queries.items()}
    hits = len(found["faces"].faces)
    if not np.array_equal(found["any"].any, found["faces"].count > 0) or len(found["contacts"].contacts) != hits:
        raise RuntimeError("the outputs disagree")
    launches = {output: query.launch for output, query in queries.items()}
    baseline = BvhPosed(*mesh, poses, 2 * hits + 1024, device)
    launches["peer_faces"] = baseline.launch
    launches["peer_any"] = BvhPosed(*mesh, poses, None, device, baseline.constructor).launch
    times = time_in_turn(launches, device, repeats)
    row = {"faces": len(mesh[1]), "hits": hits, "node_tests": found["faces"].node_tests.sum()}
    row |= {"peer": f"wp.Bvh {baseline.constructor}"} | summarise(times)
    row |= {f"{output}_ratio": ratio_of(times[f"peer_{output}"], times[output]) for output in ("faces", "any")}
    row["hit_ns"] = 1e6 * row["faces_ms"] / max(hits, 1)
    return row | {"contact_ratio": ratio_of(times["contacts"], times["faces"])}
