"""Part `rivals`: other ways to trade accuracy for speed, each a point of time against error beside our LODs.

All answer yes or no for the same poses, and are taken along the same motions to where they first say yes. The truth is
the exact answer on the finest meshes. A query is timed over all poses, apart to deep; python-fcl in a loop of its own
calls on one core, its objects made before; ours as one batch, on the CPU on one core as well; Newton as one batch on
the GPU. On a core, the CPU time of the thread counts. Hulls and pieces are solids to their makers; here their surfaces
are asked, which on a way in from outside is the same.
"""

import time
from importlib import metadata

import numpy as np
import warp as wp

import warp_abtree as ab

from .newton_peer import NewtonPeer
from .tradeoff_subject import Stage, find_front, judge_answers, judge_contact, subjects, time_launches

FRACTIONS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1)
QUICK_FRACTIONS = (0.02, 0.1, 0.5, 1)
COACD_THRESHOLDS = (0.2, 0.1)
DECOMPOSED_FACES = 10_000  # larger meshes are brought to so many faces first, by our LODs: many minutes otherwise
VHACD_HULLS = (8, 64)
SDF_RESOLUTIONS = (32, 64, 128)
NEWTON_POSES = 1024  # at a time: its time a pose hardly falls beyond, and a body is to be set up for each
BASE_FACES = 10
OURS, OURS_WITHIN, OURS_FCL = "our LODs", "our LODs, within both errors", "our LODs, python-fcl"
SIMPLIFIED, HULL, COACD, VHACD = "fast-simplification, python-fcl", "convex hull, python-fcl", "CoACD", "V-HACD"
NEWTON_SDF = "Newton, SDF"


class FclMeets:
    """python-fcl over two shapes: BVHModels of OBBs and RSSes, or convex solids by GJK."""

    def __init__(self, fcl, a, b, convex=False):
        self.fcl = fcl
        make = self._make_convex if convex else self._make_tree
        tree_a = make(*a)
        self.tree_b = tree_a if b is a else make(*b)
        self.a = fcl.CollisionObject(tree_a, fcl.Transform())
        self.request = fcl.CollisionRequest()

    def _make_tree(self, vertices, faces):
        tree = self.fcl.BVHModel()
        tree.beginModel(len(vertices), len(faces))
        tree.addSubModel(vertices, faces)
        tree.endModel()
        return tree

    def _make_convex(self, vertices, faces):
        corners = np.concatenate([np.full((len(faces), 1), 3), faces], 1).flatten()
        return self.fcl.Convex(vertices, len(faces), corners)

    def prepare(self, poses):
        """Return a call that asks all poses (n, 7) and returns a list of answers."""
        fcl = self.fcl
        turned = [fcl.Transform(pose[[6, 3, 4, 5]], pose[:3]) for pose in poses]
        objects = [fcl.CollisionObject(self.tree_b, transform) for transform in turned]

        def run():
            return [fcl.collide(self.a, b, self.request, fcl.CollisionResult()) > 0 for b in objects]

        return run

    def meets(self, poses):
        """Return whether A and B meet at each pose, bool (n,)."""
        return np.array(self.prepare(poses)(), bool)


class NewtonMeets:
    """Newton's mesh-mesh narrow phase over one mesh, brought to unit size; a number of poses at a time.

    Raises:
        RuntimeError: It lost contacts for lack of room.
    """

    def __init__(self, vertices, faces, size, far, room, hits, device, sdf):
        self.scale, self.room = 1 / size, room
        self.rows = np.zeros((2 * room, 7), np.float32)
        self.rows[:, 6] = 1
        self.far = far
        self._fill(np.tile(far, (room, 1)))
        self.peer = NewtonPeer(vertices * self.scale, faces, self.rows, hits, device, sdf)

    def _fill(self, poses):
        self.rows[1::2] = self.far
        self.rows[1 : 2 * len(poses) : 2] = poses
        self.rows[1::2, :3] *= self.scale

    def place(self, poses):
        self._fill(poses)
        self.peer.state.body_q.assign(self.rows)

    def meets(self, poses):
        """Return whether it has a contact at each pose, bool (n,)."""
        found = []
        for start in range(0, len(poses), self.room):
            part = poses[start : start + self.room]
            self.place(part)
            self.peer.launch()
            self.peer.check()
            count = int(self.peer.contacts.rigid_contact_count.numpy()[0])
            hit = np.zeros(self.room, bool)
            hit[self.peer.contacts.rigid_contact_shape0.numpy()[:count] // 2] = True
            found.append(hit[: len(part)])
        return np.concatenate(found)


# --- shapes ----------------------------------------------------------------------------------------------------------


def simplify(library, vertices, faces, fraction):
    """Return a mesh simplified by fast-simplification; its threshold is absolute, so it is brought to unit size.

    Asked for fewer faces than our base meshes have, it may leave none.
    """
    if fraction == 1:
        return vertices, faces
    fraction, scale = max(fraction, BASE_FACES / len(faces)), np.ptp(vertices, axis=0).max()
    points, kept = library.simplify(vertices / scale, faces.astype(np.int32), target_reduction=1 - fraction)
    return points.astype(float) * scale, kept.astype(np.int32)


def convex_hull(vertices, faces):
    """Return the hull of a mesh, by trimesh (Qhull)."""
    import trimesh

    hull = trimesh.Trimesh(vertices, faces, process=False).convex_hull
    return np.asarray(hull.vertices, float), np.asarray(hull.faces, np.int32)


def run_coacd(coacd, vertices, faces, threshold):
    """Return CoACD's pieces, [(vertices, faces)]."""
    coacd.set_log_level("error")
    return coacd.run_coacd(coacd.Mesh(vertices, faces), threshold=threshold, seed=0)


def run_vhacd(vhacdx, vertices, faces, hulls):
    """Return V-HACD's pieces, [(vertices, faces)]."""
    packed = np.column_stack([np.full(len(faces), 3), faces]).astype(np.uint32).ravel()
    pieces = vhacdx.compute_vhacd(vertices, packed, maxConvexHulls=hulls, resolution=400_000, asyncACD=False)
    return [(points, np.asarray(corners).reshape(-1, 3)) for points, corners in pieces]


def merge(pieces):
    """Return pieces as one mesh."""
    start = np.cumsum([0] + [len(vertices) for vertices, _ in pieces])
    faces = [np.asarray(corners, np.int32) + first for (_, corners), first in zip(pieces, start, strict=False)]
    return np.concatenate([np.asarray(vertices, float) for vertices, _ in pieces]), np.concatenate(faces)


def decompose(context, model, module, make, setting):
    """Return a model's pieces as one mesh, their number, the seconds it took and the library's version.

    All of it is kept beside the models. None where there is neither the library nor what it made before.
    """
    file = context.models_folder / f"{module}-{setting}-{model.name}.npz".replace(":", "-")
    if file.is_file():
        with np.load(file) as kept:
            mesh = kept["vertices"], kept["faces"]
            return mesh, int(kept["pieces"]), float(kept["seconds"]), str(kept["version"])
    library = context.peer(module)
    if library is None:
        return None
    lod = model.lod_for(fraction=min(1.0, DECOMPOSED_FACES / model.face_count))
    if lod < model.lod_max:
        context.note(f"{model.name} was brought to {DECOMPOSED_FACES:,} faces before its decompositions.")
    vertices, faces, _ = model.mesh_at(lod)
    scale, begin = np.ptp(vertices, axis=0).max(), time.perf_counter()
    pieces = make(library, vertices / scale, faces, setting)
    seconds = time.perf_counter() - begin
    points, corners = merge(pieces)
    file.parent.mkdir(parents=True, exist_ok=True)
    about = {"pieces": len(pieces), "seconds": seconds, "version": f"{module} {find_version(module)}"}
    np.savez_compressed(file, vertices=points * scale, faces=corners, **about)
    return (points * scale, corners), *about.values()


# --- points ----------------------------------------------------------------------------------------------------------


def judge(subject, method, setting, meets, **more):
    """Return the row of a point, time aside."""
    row = {"case": "point", "subject": subject.name, "method": method, "setting": setting} | more
    return row | judge_answers(meets(subject.poses), subject.truth) | judge_contact(subject.first_contact(meets))


def our_points(context, subject):
    """Yield the points of our LODs, and of "not proved farther apart than both errors" at the same LODs."""
    poses = subject.tiled()
    where = "GPU" if context.device.is_cuda else "CPU core"
    for value in context.size(FRACTIONS, QUICK_FRACTIONS):
        lods, setting = subject.lods(fraction=value), f"{value:.3g} of the faces"
        bound, about = subject.bound(lods), {"share": subject.share(lods), "where": where}
        stage = Stage(subject, lods, max(len(poses), subject.stage.room))
        found = [judge(subject, OURS, setting, stage.meets, **about)]
        if bound > 0:
            found.append(judge(subject, OURS_WITHIN, setting, lambda at, s=stage, d=bound: s.near(at, d), **about))
        stage.place(poses)
        pairs = stage.pairs[: len(poses)]
        for row, within in zip(found, (None, bound), strict=False):
            query = ab.Query(stage.scene, "any", pairs=pairs, within=within)
            query.run()
            yield row, query.launch if within is None else query.prove_apart


def fcl_points(context, subject, fcl):
    """Yield the points of python-fcl on meshes simplified by others and by us, on hulls and on decompositions."""
    models = [subject.a] if subject.a is subject.b else [subject.a, subject.b]
    faces = subject.a.face_count + subject.b.face_count

    def point(method, setting, meshes, convex=False, **more):
        query = FclMeets(fcl, meshes[0], meshes[-1], convex)
        row = judge(subject, method, setting, query.meets, where="CPU core", **more)
        row["share"] = (len(meshes[0][1]) + len(meshes[-1][1])) / faces
        return row, query.prepare(subject.poses)

    library = context.peer("fast_simplification")
    whole = [model.mesh_at(model.lod_max)[:2] for model in models]
    for value in context.size(FRACTIONS, QUICK_FRACTIONS):
        setting = f"{value:.3g} of the faces"
        yield point(OURS_FCL, setting, [model.mesh_at(model.lod_for(fraction=value))[:2] for model in models])
        simplified = [] if library is None else [simplify(library, *mesh, value) for mesh in whole]
        if simplified and all(len(mesh[1]) for mesh in simplified):
            yield point(SIMPLIFIED, setting, simplified)
        elif simplified:
            context.note(f"fast-simplification leaves no face of {subject.name} at {setting}.")
    begin = time.perf_counter()
    hulls = [convex_hull(*mesh) for mesh in whole]
    made = {
        "pieces": len(models),
        "build_s": time.perf_counter() - begin,
        "made_by": f"trimesh {find_version('trimesh')}",
    }
    yield point(HULL, "GJK", hulls, convex=True, **made)
    yield point(HULL, "BVHModel", hulls, **made)
    decompositions = [(COACD, "coacd", run_coacd, value, f"threshold {value:g}") for value in COACD_THRESHOLDS]
    decompositions += [(VHACD, "vhacdx", run_vhacd, value, f"{value} hulls") for value in VHACD_HULLS]
    for method, module, make, value, setting in context.size(decompositions, decompositions[2:3]):
        found = [decompose(context, model, module, make, value) for model in models]
        if None not in found:
            meshes, pieces, seconds, made_by = zip(*found, strict=True)
            yield point(method, setting, meshes, pieces=sum(pieces), build_s=sum(seconds), made_by=made_by[0])


def newton_points(context, subject):
    """Yield the points of Newton's signed distance fields at three resolutions."""
    if not context.device.is_cuda:
        context.note("Newton is skipped: its signed distance fields need CUDA.")
        return
    if subject.a is not subject.b:
        context.note(f"Newton is skipped for {subject.name}: the pipeline it is asked through holds one mesh.")
        return
    if context.peer("newton") is None:
        return
    poses = subject.tiled(NEWTON_POSES)
    vertices, faces, _ = subject.a.mesh_at(subject.a.lod_max)
    hits = int(subject.stage.ask(subject.poses, "count").count.sum()) * (len(poses) // len(subject.poses))
    for sdf in SDF_RESOLUTIONS:
        setting = f"{sdf} voxels"
        try:
            begin = time.perf_counter()
            query = NewtonMeets(
                vertices, faces, subject.size, subject.motions.far, len(poses), hits, context.device, sdf
            )
            wp.synchronize_device(context.device)
            seconds = time.perf_counter() - begin
            row = judge(subject, NEWTON_SDF, setting, query.meets, share=1.0, build_s=seconds)
            query.place(poses)
            row["us"] = 1e3 * time_launches(context, {"run": query.peer.launch}, 5)["run"] / len(poses)
            query.peer.check()
            yield row | {"where": "GPU"}, None
        except Exception as error:  # another package's failure must not cost the rest of a run
            context.note(f"{NEWTON_SDF} {setting} is skipped for {subject.name}: {type(error).__name__}: {error}")


def find_version(package):
    """Return the version of an installed package."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"


def versions():
    """Return the row that names the peers' versions; that of a decomposition stands in its own row."""
    names = "python-fcl", "fast-simplification", "trimesh", "newton"
    return {"case": "versions", "versions": ", ".join(f"{name} {find_version(name)}" for name in names)}


def run(context):
    """Yield one row a subject, method and setting."""
    yield versions()
    fcl = context.peer("fcl")
    for number, subject in enumerate(subjects(context)):
        makers = [our_points(context, subject), newton_points(context, subject)]
        makers += [fcl_points(context, subject, fcl)] if fcl is not None else []
        found = []
        for step, maker in enumerate(makers):
            for row, launch in maker:
                context.progress(f"{subject.name}: {row['method']}", 3 * number + step, 24)
                found.append((row, launch))
        yield from time_points(context, subject, found)


def time_points(context, subject, found):
    """Return the rows of (row, launch) with their times, taken in turn, and which are on the front.

    Launches are of all poses; on a GPU ours are of the tiled ones. Rows without a launch are timed already.
    """
    rows = [row for row, _ in found]
    for on_gpu in (False, True):
        mine = {k: launch for k, (row, launch) in enumerate(found) if launch and (row["where"] == "GPU") == on_gpu}
        times = time_launches(context, mine, on_core=not on_gpu) if mine else {}
        count = len(subject.tiled() if on_gpu else subject.poses)
        for k, milliseconds in times.items():
            rows[k]["us"] = 1e3 * milliseconds / count
    points = [(row["us"], np.inf if row["contact_mean"] is None else row["contact_mean"]) for row in rows]
    for row, front in zip(rows, find_front(points), strict=True):
        row["front"] = bool(front)
    return rows
