"""Distances: cost and error of a coarse LOD, beside a tolerance at the finest LODs, and python-fcl on the LODs.

Poses lie along the motions, `GAPS` before the first contact. Each search starts anew. A LOD proves that the originals
are no nearer than its distance less both certified errors, a tolerance that they are no nearer than its bracket's lower
end: `proved` is how far below the distance that is, on average.
"""

import numpy as np

import warp_abtree as ab

from ...baselines.fcl import Fcl
from ...shapes import pose_matrices
from ..motions import POSES_AT_A_TIME
from .workload import workloads

GAPS = (0.3, 0.1, 0.03, 0.01)  # of the size, from the first contact
FRACTIONS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1)
QUICK_FRACTIONS = (0.02, 0.1, 1)
RELATIVE = (0.5, 0.2, 0.1, 0.05, 0.02, 0.01)
OURS, OURS_FCL, TOLERANCE = "our LODs", "our LODs, python-fcl", "tolerance at the finest LODs"


class Distances:
    """A workload's poses apart, on CUDA several times over, and queries about them at LODs.

    Attributes:
        poses, truth: All poses, and their distances at the finest LODs.
        once: How many of the first are not repeated.
    """

    def __init__(self, context, workload):
        self.context, self.workload = context, workload
        posed = min(context.size(24, 6), len(workload.low))
        which = np.tile(np.arange(posed), len(GAPS))
        along = workload.low[which] + np.repeat(GAPS, posed) * workload.size
        poses, self.once = workload.motions.poses(along, which), len(which)
        self.poses = np.tile(poses, (-(-POSES_AT_A_TIME // self.once) if context.device.is_cuda else 1, 1))
        self._scenes = {}
        self.truth = self.ask((workload.a.lod_max, workload.b.lod_max)).run().distance

    def ask(self, lods, **options):
        """Return a query of all poses at LODs."""
        if lods not in self._scenes:
            self._scenes[lods] = self.workload.scene(lods, len(self.poses))
            self._scenes[lods].place(self.poses)
        scene = self._scenes[lods]
        return ab.DistanceQuery(scene.scene, scene.pairs[: len(self.poses)], **options)

    def lods(self, fraction):
        """Return LODs of a fraction of the faces, 1 for the finest."""
        return self.workload.lods(fraction=fraction)

    def time(self, queries: dict) -> dict:
        """Return the time of a pose [us] of each query, in turn; each search starts anew."""
        anew = {name: lambda query=query: (query.forget(), query.launch()) for name, query in queries.items()}
        return {name: 1e3 * time / len(self.poses) for name, time in self.context.time_launches(anew).items()}

    def row(self, method, setting, found, proved, share, on_core):
        """Return a row of distances, time aside."""
        error = np.abs(found - self.truth[: len(found)]) / self.workload.size
        row = {"case": "distance", "workload": self.workload.name, "method": method, "setting": setting}
        row |= {"where": "CPU core" if on_core else "GPU", "share": share, "proved": float(proved / self.workload.size)}
        return row | {"distance_mean": float(error.mean()), "distance_max": float(error.max())}


def measure_levels(distances):
    """Return rows of LODs and of tolerances at the finest, with their times."""
    context, workload = distances.context, distances.workload
    on_core, rows, queries = context.device.is_cpu, {}, {}
    for value in context.size(FRACTIONS, QUICK_FRACTIONS):
        lods, setting = distances.lods(value), f"{value:.3g} of the faces"
        queries[OURS, setting] = query = distances.ask(lods)
        shared = workload.bound(lods), workload.fraction(lods)
        rows[OURS, setting] = distances.row(OURS, setting, query.run().distance, *shared, on_core)
    for value in context.size(RELATIVE, RELATIVE[::2]):
        setting = f"{value:.0%} of the distance"
        queries[TOLERANCE, setting] = query = distances.ask(distances.lods(1), relative=value)
        found = query.run()
        proved = (distances.truth - found.bracket[:, 0]).mean()
        rows[TOLERANCE, setting] = distances.row(TOLERANCE, setting, found.distance, proved, 1.0, on_core)
    for key, us in distances.time(queries).items():
        rows[key]["us"] = us
    rows |= measure_fcl(distances)
    whole = rows[OURS, "1 of the faces"]["us"]
    return [row | {"cost": row["us"] / whole} for row in rows.values()]


def measure_fcl(distances) -> dict:
    """Return rows of python-fcl on our LODs, with their times."""
    context, workload, rows, queries = distances.context, distances.workload, {}, {}
    if context.library("fcl") is None:
        return rows
    matrices = pose_matrices(distances.poses[: distances.once])
    for value in context.size(FRACTIONS, QUICK_FRACTIONS):
        lods, setting = distances.lods(value), f"{value:.3g} of the faces"
        meshes = [model.mesh_at(lod)[:2] for model, lod in zip((workload.a, workload.b), lods, strict=True)]
        fcl = Fcl(*meshes, matrices)
        found = np.maximum(fcl.distances(), 0.0)
        shared = workload.bound(lods), workload.fraction(lods)
        rows[OURS_FCL, setting] = distances.row(OURS_FCL, setting, found, *shared, True)
        queries[OURS_FCL, setting] = fcl.distances
    for key, time in context.time_launches(queries, on_core=True).items():
        rows[key]["us"] = 1e3 * time / distances.once
    return rows


def run(context):
    """Yield one row a workload, method and setting."""
    for workload in workloads(context):
        yield from measure_levels(Distances(context, workload))
