"""Time and memory of making models: progressive mesh, certified errors and tree, by the number of faces.

Beside it what others make of the same mesh, which is less: `fast_simplification`, where installed, collapses edges
without errors and keeps no positions; a wp.Bvh is one tree over one mesh.
"""

import gc
import tempfile
import time
from pathlib import Path

import numpy as np
import trimesh
import warp as wp

import warp_abtree as ab
from warp_abtree import testing

from ..baselines.wp_bvh import FaceBvh
from ..meshes import ModelFolder
from ..shapes import knot
from ..timing import fit_slope, summarise_all, time_call

FULL = {"faces": (200, 1000, 5000, 20_000, 60_000, 250_000, 1_000_000), "repeats": (5, 1), "samples": 2000}
QUICK = {"faces": (200, 600), "repeats": (2, 1), "samples": 100}
LARGE = 100_000  # faces from which on a build is timed once
CHECKED_FRACTIONS = (0.3, 0.05)  # of the faces: LODs whose certified errors are checked
BASE_FACES = 10
BASELINE = "fast_simplification"


def run(device, quick=False, largest=None, models=None):
    """Yield one row a mesh, and one of the slopes of its lines.

    Times are those that one thread of the host ran, in turn with the baselines'; of the device only bvh_build, a wp.Bvh
    over the boxes of the faces. all_cores is what a build takes from begin to end with all cores of the host.
    model_mib is what the arrays of a model hold. tightness is the least of certified error over what was measured at
    some points, at least 1 where the bound holds.
    """
    device = wp.get_device(device)
    sizes = QUICK if quick else FULL
    rows = []
    check_model(build(*knot(200), "")[0], 10)  # compiles what there is to compile
    with tempfile.TemporaryDirectory() as folder:
        for face_target in sizes["faces"]:
            if face_target <= (largest or face_target):
                rows.append(run_mesh(device, face_target, sizes, Path(models or folder)))
                yield rows[-1]
    row = {"case": "slope", "sizes": len(rows)}
    for name in ("build_ms", "collapse_ms", "error_ms", "tree_ms", "open_ms", "file_mib"):
        some = [r for r in rows if r.get(name)]
        row[f"{name}_slope"] = fit_slope([r["faces"] for r in some], [r[name] for r in some])
    yield row


@wp.kernel(enable_backward=False)
def distance_kernel(
    mesh: wp.uint64, points: wp.array(dtype=wp.vec3), reach: wp.float32, distance_out: wp.array(dtype=wp.float32)
):
    """Find the distance of each point to a mesh."""
    i = wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], reach)
    distance_out[i] = reach
    if query.result:
        distance_out[i] = wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - points[i])


def distances(points, vertices, faces, device="cpu"):
    """Return the distance of each point to a mesh, found in float32 about the mesh's middle."""
    middle, reach = (vertices.min(0) + vertices.max(0)) / 2, 2 * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    corners = wp.array((vertices - middle).astype(np.float32), dtype=wp.vec3, device=device)
    mesh = wp.Mesh(corners, wp.array(faces.astype(np.int32).ravel(), dtype=wp.int32, device=device))
    found = wp.zeros(len(points), dtype=wp.float32, device=device)
    queried = wp.array((points - middle).astype(np.float32), dtype=wp.vec3, device=device)
    wp.launch(distance_kernel, len(points), [mesh.id, queried, reach, found], device=device)
    return found.numpy().astype(np.float64)


def check_model(model, samples):
    """Return the least of certified error over measured distance: points of the original against coarser LODs.

    Raises:
        RuntimeError: A point lies farther from a LOD than its certified error, or a LOD lacks faces.
    """
    vertices, faces, _ = model.mesh_at(model.lod_max)
    points, _ = trimesh.sample.sample_surface(trimesh.Trimesh(vertices, faces, process=False), samples, seed=0)
    rounding = 1e-6 * np.ptp(vertices, axis=0).max()  # of float32
    least = np.inf
    for fraction in CHECKED_FRACTIONS:
        lod = model.lod_for(fraction=fraction)
        coarse_vertices, coarse_faces, _ = model.mesh_at(lod)
        if len(coarse_faces) != model.progressive.active_count(lod):
            raise RuntimeError(f"LOD {lod} has {len(coarse_faces)} faces, not {model.progressive.active_count(lod)}")
        farthest = float(distances(points, coarse_vertices, coarse_faces).max())
        if farthest > model.error_at(lod) + rounding:
            raise RuntimeError(f"a point lies {farthest} from LOD {lod}, beyond its error {model.error_at(lod)}")
        if farthest > rounding:
            least = min(least, model.error_at(lod) / farthest)
    return least


def build(vertices, faces, name):
    """Return a model and the times of its stages [ms] of this thread; collapse includes checking and welding."""
    begin, end = time.thread_time(), {}

    def progress(stage, done, total):
        end[stage] = time.thread_time()

    with testing.regime(cpu_threads=1):  # stages one after another
        model = ab.Model.from_arrays(vertices, faces, base_faces=BASE_FACES, progress=progress, name=name, cache=False)
    stop, collapse = time.thread_time(), end.get("collapse", begin)
    error = end.get("LOD bounds", collapse)
    stages = {"collapse": collapse - begin, "error": error - collapse, "tree": stop - error, "build": stop - begin}
    return model, {name: 1e3 * seconds for name, seconds in stages.items()}


def find_simplifier(vertices, faces):
    """Return a call that collapses edges to the base mesh and returns how many, and why there is none."""
    try:
        import fast_simplification
    except ImportError as error:
        return None, str(error)
    simplify, few = fast_simplification.simplify, {"target_count": BASE_FACES, "return_collapses": True}
    simplify(*knot(200), **few)  # loads what there is to load
    return lambda: len(simplify(vertices, faces, **few)[1]), None


def run_mesh(device, face_target, sizes, folder):
    """Return the row of one mesh."""
    gc.collect()
    vertices, faces = knot(face_target)
    name = f"knot:{face_target}"
    folder.mkdir(parents=True, exist_ok=True)
    path = ModelFolder(folder).file(name)
    model, first = build(vertices, faces, name)
    row = {"case": "build", "device": device.name, "faces": len(faces), "lod_max": model.lod_max}
    tightness = check_model(model, sizes["samples"])
    row["tightness"] = round(tightness, 2) if np.isfinite(tightness) else None
    model.save(path)
    simplify, skipped = find_simplifier(vertices, faces)
    bvh = FaceBvh(vertices, faces, device)
    runs = {"save": lambda: model.save(path), "open": lambda: ab.Model.open(path)}
    runs = {name: time_call(call, "cpu", time.thread_time) for name, call in runs.items()}
    runs["bvh_build"] = time_call(bvh.rebuild, device, time.thread_time if device.is_cpu else time.perf_counter)
    if simplify:
        runs[BASELINE] = time_call(simplify, "cpu", time.thread_time)
    times, repeats = {}, sizes["repeats"][len(faces) > LARGE]
    for _ in range(repeats):
        found = build(vertices, faces, name)[1] if repeats > 1 else first
        for key, value in (found | {key: run() for key, run in runs.items()}).items():
            times.setdefault(key, []).append(value)
    row |= summarise_all(times)
    row |= {f"{BASELINE}_reached": simplify()} if simplify else {f"{BASELINE}_skipped": skipped}
    begin = time.perf_counter()
    ab.Model.from_arrays(vertices, faces, base_faces=BASE_FACES, cache=False)
    row["all_cores_ms"] = round(1e3 * (time.perf_counter() - begin), 2)
    row["faces_per_s"] = round(1e3 * len(faces) / row["build_ms"])
    held = [*vars(model.progressive).values(), *vars(model.tree).values()]
    held = sum(value.nbytes for value in held if isinstance(value, np.ndarray))
    for key, value in {"model": held, "file": path.stat().st_size}.items():
        row[f"{key}_mib"] = round(value / 2**20, 2)
        row[f"{key}_bytes_a_face"] = round(value / len(faces), 1)
    return row
