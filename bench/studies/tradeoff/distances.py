"""Distances: cost and error of a coarse LOD, beside a tolerance at the finest LODs, and python-fcl on the LODs.

Poses lie along the motions, `GAPS` before the first contact. Each search starts anew. A LOD proves that the originals
are no nearer than its distance less both certified errors, a tolerance that they are no nearer than its bracket's lower
end: `proved` is how far below the distance that is, on average.
"""

import numpy as np

from ...baselines.fcl import Fcl
from ...shapes import pose_matrices
from .workload import relate, time_rows

GAPS = (0.3, 0.1, 0.03, 0.01)  # of the size, from the first contact
FRACTIONS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1)
QUICK_FRACTIONS = (0.02, 0.1, 1)
RELATIVE = (0.5, 0.2, 0.1, 0.05, 0.02, 0.01)
OURS, OURS_FCL, TOLERANCE = "our LODs", "our LODs, python-fcl", "tolerance at the finest LODs"


def describe(workload, method, found, truth, proved, share, where):
    """Return a row of distances, setting and time aside."""
    error = np.abs(found - truth[: len(found)]) / workload.size
    row = {"case": "distance", "workload": workload.name, "method": method, "where": where, "share": share}
    return row | {"proved": proved / workload.size, "distance_mean": error.mean(), "distance_max": error.max()}


def run(context, workload):
    """Return rows of LODs and of tolerances at the finest, and of python-fcl on the LODs, with their times."""
    posed = min(context.size(24, 6), len(workload.low))
    which = np.tile(np.arange(posed), len(GAPS))
    along = workload.low[which] + np.repeat(GAPS, posed) * workload.size
    poses, once = workload.repeated(workload.motions.poses(along, which)), len(which)
    where = "CPU core" if context.device.is_cpu else "GPU"
    levels = {value: workload.lods(fraction=value) for value in context.size(FRACTIONS, QUICK_FRACTIONS)}
    truth = workload.query(levels[1], poses, "distance").run().distance
    rows, queries = {}, {}
    for value, lods in levels.items():
        key = OURS, f"{value:.3g} of the faces"
        queries[key] = query = workload.query(lods, poses, "distance")
        shown = workload.bound(lods), workload.fraction(lods), where
        rows[key] = describe(workload, OURS, query.run().distance, truth, *shown)
    for value in context.size(RELATIVE, RELATIVE[::2]):
        key = TOLERANCE, f"{value:.0%} of the distance"
        queries[key] = query = workload.query(levels[1], poses, "distance", relative=value)
        found = query.run()
        proved = (truth - found.bracket[:, 0]).mean()
        rows[key] = describe(workload, TOLERANCE, found.distance, truth, proved, 1.0, where)
    anew = {key: lambda query=query: (query.forget(), query.launch()) for key, query in queries.items()}
    time_rows(context, rows, anew, len(poses))
    if context.library("fcl") is not None:
        theirs = {}
        for value, lods in levels.items():
            key = OURS_FCL, f"{value:.3g} of the faces"
            meshes = [model.mesh_at(lod)[:2] for model, lod in zip((workload.a, workload.b), lods, strict=True)]
            fcl = Fcl(*meshes, pose_matrices(poses[:once]))
            shown = workload.bound(lods), workload.fraction(lods), "CPU core"
            rows[key] = describe(workload, OURS_FCL, np.maximum(fcl.distances(), 0.0), truth, *shown)
            theirs[key] = fcl.distances
        time_rows(context, rows, theirs, once, on_core=True)
    return relate(rows, (OURS, "1 of the faces"))
