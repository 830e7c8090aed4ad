"""Competitors: other ways to trade accuracy for speed, each a point of time against error beside our LODs.

All answer yes or no for the same poses, and are taken along the same motions to where they first say yes. A query is
timed over all poses, apart to deep; python-fcl in a loop of its own calls on one core, its objects made before; ours as
one batch, on the CPU on one core as well; Newton as one batch on the GPU. Hulls are asked as solids and as surfaces,
which on a way in from outside is the same.
"""

import time
from importlib import metadata

import numpy as np
import trimesh
import warp as wp

from ...baselines.fcl import Fcl
from ...baselines.newton import Newton
from ...shapes import pose_matrices
from .workload import find_front, judge_answers, judge_contact, time_rows

FRACTIONS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1)
QUICK_FRACTIONS = (0.02, 0.1, 0.5, 1)
SDF_RESOLUTIONS = (32, 64, 128)
NEWTON_POSES = 1024  # at a time: its time a pose hardly falls beyond, and a body is to be set up for each
FAR = 1e3  # sizes away
OURS, OURS_FCL = "our LODs", "our LODs, python-fcl"
HULL, NEWTON_SDF = "convex hull, python-fcl", "Newton, SDF"


class NewtonPoses(Newton):
    """Newton's narrow phase over one mesh, brought to unit size; a number of poses at a time."""

    def __init__(self, workload, room, hits, device, sdf):
        vertices, faces, _ = workload.a.mesh_at(workload.a.lod_max)
        self.scale, self.room = 1 / workload.size, room
        super().__init__(vertices * self.scale, faces, self.pair_rows([]), hits, device, sdf)

    def pair_rows(self, poses):
        """Return the poses of all pairs, float32 (2 room, 7): A at the origin, B at poses, the rest of the Bs away."""
        rows = np.zeros((2 * self.room, 7), np.float32)
        rows[:, 6], rows[1::2, 0] = 1, FAR
        rows[1 : 2 * len(poses) : 2] = np.reshape(poses, (-1, 7))
        rows[1 : 2 * len(poses) : 2, :3] *= self.scale
        return rows

    def intersects(self, poses):
        """Return whether it has a contact at each pose, bool (n,)."""
        found = []
        for start in range(0, len(poses), self.room):
            part = poses[start : start + self.room]
            self.place(self.pair_rows(part))
            self.launch()
            found.append(self.result()[0][: len(part)])
        return np.concatenate(found)


def measure(workload, method, setting, intersects, **more):
    """Return the row of a point, time aside."""
    row = {"case": "point", "workload": workload.name, "method": method, "setting": setting} | more
    answers = judge_answers(intersects(workload.poses), workload.truth)
    return row | answers | judge_contact(workload.first_contact(intersects))


def our_points(context, workload):
    """Yield the points of our LODs."""
    poses = workload.repeated()
    for value in context.size(FRACTIONS, QUICK_FRACTIONS):
        lods = workload.lods(fraction=value)
        about = {"share": workload.fraction(lods), "where": "GPU" if context.device.is_cuda else "CPU core"}
        row = measure(workload, OURS, f"{value:.3g} of the faces", workload.ask_at(lods), **about)
        query = workload.query(lods, poses, "any")
        query.run()
        yield row, query.launch


def fcl_point(workload, method, setting, meshes, convex=False, **more):
    """Return a point of python-fcl on other meshes of A and B."""
    query = Fcl(meshes[0], meshes[-1], convex=convex)

    def intersects(poses):
        query.place(pose_matrices(poses))
        return np.array(query.any(), bool)

    row = measure(workload, method, setting, intersects, where="CPU core", **more)
    face_count = workload.a.face_count + workload.b.face_count
    row["share"] = (len(meshes[0][1]) + len(meshes[-1][1])) / face_count
    query.place(pose_matrices(workload.poses))
    return row, query.any


def fcl_points(context, workload):
    """Yield the points of python-fcl on our LODs and on convex hulls, made by trimesh (Qhull)."""
    if context.library("fcl") is None:
        return
    models = [workload.a] if workload.a is workload.b else [workload.a, workload.b]
    for value in context.size(FRACTIONS, QUICK_FRACTIONS):
        ours = [model.mesh_at(model.lod_for(fraction=value))[:2] for model in models]
        yield fcl_point(workload, OURS_FCL, f"{value:.3g} of the faces", ours)
    begin = time.perf_counter()
    whole = [trimesh.Trimesh(*model.mesh_at(model.lod_max)[:2], process=False) for model in models]
    hulls = [(np.asarray(hull.vertices, float), hull.faces.astype(np.int32)) for hull in (w.convex_hull for w in whole)]
    made = {"build_s": time.perf_counter() - begin}
    yield fcl_point(workload, HULL, "GJK", hulls, convex=True, **made)
    yield fcl_point(workload, HULL, "BVHModel", hulls, **made)


def newton_points(context, workload):
    """Yield the points of Newton's signed distance fields at three resolutions, timed already."""
    if not context.device.is_cuda:
        context.note("Newton is skipped: its signed distance fields need CUDA.")
        return
    if workload.a is not workload.b:
        context.note(f"Newton is skipped for {workload.name}: the pipeline it is asked through holds one mesh.")
        return
    if context.library("newton") is None:
        return
    poses = workload.repeated(least=NEWTON_POSES)
    hits = workload.query(workload.finest, poses, "count").run().count.sum()
    for sdf in SDF_RESOLUTIONS:
        setting = f"{sdf} voxels"
        try:
            begin = time.perf_counter()
            query = NewtonPoses(workload, len(poses), hits, context.device, sdf)
            wp.synchronize_device(context.device)
            seconds = time.perf_counter() - begin
            row = measure(workload, NEWTON_SDF, setting, query.intersects, share=1.0, build_s=seconds, where="GPU")
            query.place(query.pair_rows(poses))
            row["us"] = 1e3 * context.time_launches({"run": query.launch}, 5)["run"] / len(poses)
            query.check()
            yield row, None
        except Exception as error:  # another package's failure must not cost the rest of a run
            context.note(f"{NEWTON_SDF} {setting} is skipped for {workload.name}: {type(error).__name__}: {error}")


def run(context, workload):
    """Return one row a method and setting, with its time and whether no other one beats it in time and error.

    Times are taken in turn. Launches are of all poses; on a GPU ours are of the tiled ones. Rows without a launch are
    timed already.
    """
    versions = {package.name: package.version for package in metadata.distributions()}
    names = "python-fcl", "trimesh", "newton"
    context.note(f"Versions: {', '.join(f'{name} {versions.get(name)}' for name in names)}.")
    found = []
    for points in (our_points, newton_points, fcl_points):
        for row, launch in points(context, workload):
            context.progress(f"{workload.name}: {row['method']}, {row['setting']}")
            found.append((row, launch))
    rows = [row for row, _ in found]
    for on_gpu in (False, True):
        mine = {k: launch for k, (row, launch) in enumerate(found) if launch and (row["where"] == "GPU") == on_gpu}
        time_rows(context, rows, mine, len(workload.repeated() if on_gpu else workload.poses), on_core=not on_gpu)
    fronts = find_front([row["us"] for row in rows], [row["contact_mean"] for row in rows])
    return [row | {"front": front} for row, front in zip(rows, fronts, strict=True)]
