"""Least distances: real meshes at gaps, a nut free on its bolt, and knots at random poses; python-fcl beside them.

Gaps are fractions of the mesh's size, poses otherwise random. Times are of a pose: of all poses at once, where each
search starts anew (fresh) or from the faces of the launch before (again); on the CPU also of one pair that is brought
from pose to pose, each a call of `Scene.set_poses` and `DistanceQuery.run` (calls). On the CPU all on one core, beside
python-fcl, whose answers must be ours but for rounding.

The part `points` is signed distances of random points, a tenth of them within a hundredth of the size of the surface,
beside Warp's query of a mesh with signs by winding numbers, both a whole call. Meshes that are not closed are asked
without signs, Warp's query with its own and without. The part `gap` is contacts of knots with a gap and without.
"""

import time

import numpy as np
import trimesh
import warp as wp

import warp_abtree as ab

from .. import shapes, timing
from ..baselines.fcl import Fcl
from ..meshes import NUT, ModelFolder, knot_model, mesh_file
from .assembly import place_nut

FULL = {"poses": 32, "counts": (1, 1024, 65536), "knot": 5000, "repeats": 7}
CPU = FULL | {"counts": (1, 1024)}
QUICK = {"poses": 3, "counts": (3,), "knot": 300, "repeats": 1}
POINTS, POINT_MESHES = 100_000, ("cow", "homer", "stanford-bunny")
GAP_FULL = shapes.KNOT_PAIRS | {"pairs": (64, 1024, 8192)}
GAP_QUICK = {"faces": 300, "pairs": (4,), "distances": (0.2,), "repeats": 2}
GAPS = 0.0, 1e-4, 3e-4, 1e-3, 3e-3  # of the mesh's size
PARTS = ("nearest", "points", "gap")
ROUNDED = 1e-12  # of the size: distances in float64 differ by less
MESHES = ("cow", "rocker-arm", "stanford-bunny")


def run(device, quick=False, only=PARTS):
    """Yield a row a workload: times [ms] and what the searches took; of baselines, where they are at hand.

    Of the part `points` a row a mesh: times a point [us], and points that Warp's query puts on the wrong side. Of the
    part `gap` a row a number of pairs, distance of their centres, and gap: more is contacts over those without a gap,
    ratio the time over that without one.
    """
    sizes = QUICK if quick else CPU if device.is_cpu else FULL
    folder, most = ModelFolder(None), 1 if quick else None
    if "nearest" in only:
        for name in [name for name in MESHES if mesh_file(name)][:most]:
            model = folder.load([name])
            yield measure(name, [model, model], shapes.place_at_gaps(model, sizes["poses"]), device, sizes["repeats"])
        if all(map(mesh_file, NUT)) and not quick:
            models = [folder.load([name]) for name in NUT]
            matrices = place_nut(models, sizes["poses"])["free"]
            yield measure("nut on bolt, free", models, matrices, device, sizes["repeats"])
        knots = knot_model(sizes["knot"])
        for count in sizes["counts"]:
            matrices = shapes.pose_matrices(shapes.random_poses(shapes.longest_side(knots), count))
            yield measure(f"knot, {count} poses", [knots, knots], matrices, device, sizes["repeats"])
    if "points" in only:
        models = {name: folder.load([name]) for name in [name for name in POINT_MESHES if mesh_file(name)][:most]}
        models["torus"] = ab.Model.load(trimesh.creation.torus(1.0, 0.4, *((24, 12) if quick else (96, 48))))
        for name, model in models.items():
            for has_signs in (True,) if model.winding.is_closed else (False, True):
                yield measure_points(name, model, device, 300 if quick else POINTS, has_signs)
    if "gap" in only:
        sizes = GAP_QUICK if quick else GAP_FULL
        for about, model, poses in shapes.knot_batches(device, sizes):
            for row in time_gaps(device, model, poses, sizes["repeats"]):
                yield about | row


@wp.kernel(module="unique")
def ask_mesh_kernel(
    mesh: wp.uint64, has_inside: int, points: wp.array(dtype=wp.vec3), distance_out: wp.array(dtype=float)
):
    i = wp.tid()
    if has_inside != 0:
        found = wp.mesh_query_point_sign_winding_number(mesh, points[i], 1.0e9)
        foot = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
        distance_out[i] = found.sign * wp.length(points[i] - foot)
    else:
        near = wp.mesh_query_point_no_sign(mesh, points[i], 1.0e9)
        distance_out[i] = wp.length(points[i] - wp.mesh_eval_position(mesh, near.face, near.u, near.v))


def measure_points(name, model, device, count, has_signs):
    """Return the row of random points about one mesh, with signs where it is closed; the peer may have signs."""
    rng, (vertices, faces, _) = np.random.default_rng(0), model.mesh_at(model.lod_max)
    low, size, signed = vertices.min(0), np.ptp(vertices, axis=0), model.winding.is_closed
    points = low + size * rng.uniform(-0.1, 1.1, (count, 3))
    near = vertices[rng.integers(0, len(vertices), count // 10)]
    points[: len(near)] = near + rng.normal(size=near.shape) * 0.003 * size.max()
    corners, rows = (wp.array(part, dtype=wp.vec3, device=device) for part in (vertices, points))
    mesh = wp.Mesh(corners, wp.array(faces.ravel(), dtype=int, device=device), support_winding_number=has_signs)
    found = wp.empty(count, dtype=float, device=device)
    inputs = [mesh.id, int(has_signs), rows, found]
    asked = points if device.is_cpu else wp.array(points, dtype=wp.vec3d, device=device)
    calls = {
        "ours": lambda: ab.signed_distance(model, asked, device=device.alias, signed=signed),
        "host": lambda: ab.signed_distance(model, points, device=device.alias, signed=signed),
        "peer": lambda: wp.launch(ask_mesh_kernel, count, inputs, device=device),
    }
    with timing.one_core(device):
        runs = {who: timing.time_call(call, device, timing.host_clock(device)) for who, call in calls.items()}
        times = timing.time_rounds(runs, 5)
    truth = calls["host"]()
    row = {"workload": name, "faces": model.face_count, "points": count, "signed": signed}
    row |= {"peer_signed": has_signs, "inside": np.count_nonzero(truth < 0) if signed else None}
    if signed and has_signs:
        row["peer_wrong_sides"] = np.count_nonzero((truth < 0) != (found.numpy() < 0))
    row |= {f"{who}_us": 1e3 * float(np.median(times[who])) / count for who in calls}
    return row | {"point_ratio": timing.ratio_of(times["peer"], times["ours"])}


def measure(name, models, matrices, device, repeats):
    """Return the row of one workload; raise a RuntimeError where python-fcl's distances are others."""
    scene, pairs = shapes.scene_of_poses(device, *models, matrices)
    query, fresh = ab.DistanceQuery(scene, pairs), ab.DistanceQuery(scene, pairs)
    found = fresh.run()
    query.run()
    row = {"workload": name, "faces": " x ".join(str(model.face_count) for model in models)}
    row |= {"poses": len(pairs), "meet": found.any.sum(), "median_gap": np.median(found.distance)}
    row |= {"node_tests": found.node_tests.mean(), "face_tests": found.triangle_tests.mean()}
    launches = {"fresh": lambda: (fresh.forget(), fresh.launch()), "again": query.launch}
    with timing.one_core():
        if device.is_cpu:
            launches["calls"] = make_calls(models, matrices, device)
            try:
                fcl = Fcl(*(model.mesh_at(model.lod_max)[:2] for model in models), matrices)
                error = np.abs(fcl.distances() - found.distance)[~found.any].max(initial=0.0)
                row["fcl_differs"] = error / max(map(shapes.longest_side, models))
                if row["fcl_differs"] > ROUNDED:
                    raise RuntimeError(f"python-fcl's distances differ by {row['fcl_differs']} of the size")
                launches["fcl"] = fcl.distances
            except ImportError as error:
                row["fcl_skipped"] = str(error)
        with timing.no_garbage_collection():
            times = timing.medians(timing.time_in_turn(launches, device, repeats, time.thread_time))
    row |= {f"{key}_ms": value / len(pairs) for key, value in times.items()}
    ours = [key for key in times if key != "fcl"] if "fcl" in times else []
    return row | {f"{key}_fcl_ratio": round(times["fcl"] / times[key], 2) for key in ours}


def make_calls(models, matrices, device):
    """Return a callable that brings one pair from pose to pose, and reads its distance at each."""
    scene, pairs = shapes.scene_of_poses(device, *models, matrices[:1])
    query = ab.DistanceQuery(scene, pairs)
    poses = [np.stack([np.eye(4), matrix]) for matrix in matrices]

    def call_each():
        for both in poses:
            scene.set_poses(both)
            query.run()

    call_each()
    return call_each


def time_gaps(device, model, poses, repeats):
    """Yield the rows of one batch; raise a RuntimeError where what intersects is not the same with a gap."""
    scene, pairs = shapes.scene_of_pairs(device, model, poses)
    plain = scene.intersect(pairs, output="contacts")
    queries, found = {}, {}
    for gap in (None, *GAPS):
        asked = None if gap is None else gap * shapes.longest_side(model)
        result = scene.intersect(pairs, output="contacts", gap=asked)
        rows = result.contacts if gap is None else result.contacts[result.contacts["separation"] < 0]
        if rows["faces"].tobytes() != plain.contacts["faces"].tobytes():
            raise RuntimeError("with a gap other faces intersect")
        found[gap] = len(result.contacts)
        queries[gap] = ab.ContactQuery(scene, pairs, capacity=max(1, found[gap]), gap=asked)
        queries[gap].grow()
    with timing.one_core(), timing.no_garbage_collection():
        launches = {gap: query.launch for gap, query in queries.items()}
        times = timing.time_in_turn(launches, device, repeats, timing.host_clock(device))
    middle = timing.medians(times)
    for gap in GAPS:
        row = {"gap": gap, "contacts": found[gap]}
        row |= {"more": found[gap] / max(1, found[None]), "without_ms": middle[None], "with_ms": middle[gap]}
        yield row | {"ratio": timing.ratio_of(times[gap], times[None]), "meet": np.count_nonzero(plain.any)}
