"""Time and memory of making models: progressive mesh, certified errors and tree, by the number of faces.

Beside it what others make of the same mesh, which is less: `fast_simplification`, where installed, collapses edges
without errors and keeps no positions; a wp.Bvh is one tree over one mesh.
"""

import gc
import tempfile
import time
from pathlib import Path

import numpy as np
import warp as wp

import warp_abtree as ab

from ..baselines.wp_bvh import FaceBvh
from ..shapes import knot
from ..surfaces import distances, sample_surface
from ..timing import fit_slope, summarise_all, time_call

FULL = {"faces": (200, 1000, 5000, 20_000, 60_000, 250_000, 1_000_000), "repeats": (5, 1), "samples": 2000}
QUICK = {"faces": (200, 600), "repeats": (2, 1), "samples": 100}
LARGE = 100_000  # faces from which on a build is timed once
PEAK_LEAST = 20_000  # a smaller build fits into memory that the process had before
CHECKED_FRACTIONS = (0.3, 0.05)  # of the faces: LODs whose certified errors are checked
BASE_FACES = 10
BASELINE = "fast_simplification"
STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def run(device, quick=False, largest=None, models=None):
    """Yield one row a mesh, and one of the slopes of its lines.

    Times are those that one thread of the host ran, in turn with the baselines'; of the device only bvh_build, a wp.Bvh
    over the boxes of the faces. peak is what a build takes at most above what was there, model what the arrays hold.
    tightness is the least of certified error over what was measured at some points, at least 1 where the bound holds.
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
    for name in ("build_ms", "collapse_ms", "error_ms", "tree_ms", "open_ms", "peak_mib", "file_mib"):
        some = [r for r in rows if r.get(name)]
        row[f"{name}_slope"] = fit_slope([r["faces"] for r in some], [r[name] for r in some])
    yield row


def check_model(model, samples):
    """Return the least of certified error over measured distance: points of the original against coarser LODs.

    Raises:
        RuntimeError: A point lies farther from a LOD than its certified error, or a LOD lacks faces.
    """
    vertices, faces, _ = model.mesh_at(model.lod_max)
    points = sample_surface(np.random.default_rng(0), vertices, faces, samples)
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


def check_same(model, other):
    """Compare all arrays of two models.

    Raises:
        RuntimeError: They differ.
    """
    for part in ("progressive", "tree"):
        for name, value in vars(getattr(model, part)).items():
            if isinstance(value, np.ndarray) and not np.array_equal(value, getattr(getattr(other, part), name)):
                raise RuntimeError(f"{name} of the opened model differs from the saved one's")


def read_status(name):
    """Return a size of this process [bytes], None where the system does not tell."""
    if not STATUS.is_file():
        return None
    line = next(line for line in STATUS.read_text().splitlines() if line.startswith(name))
    return 1024 * int(line.split()[1])


def peak_of(call):
    """Call something; return what it returns and by how much memory rose meanwhile [bytes], None if not known."""
    gc.collect()
    try:
        CLEAR.write_text("5")  # the peak starts from here
    except OSError:
        return call(), None
    before = read_status("VmRSS")
    found = call()
    return found, max(0, read_status("VmHWM") - before)


def build(vertices, faces, name):
    """Return a model and the times of its stages [ms] of this thread; collapse includes checking and welding."""
    begin, end = time.thread_time(), {}

    def progress(stage, done, total):
        end[stage] = time.thread_time()

    model = ab.Model.from_arrays(vertices, faces, base_faces=BASE_FACES, progress=progress, name=name)
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
    name = f"knot {face_target}"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"knot-{face_target}.npz"
    (model, first), peak = peak_of(lambda: build(vertices, faces, name))
    row = {"case": "build", "device": device.name, "faces": len(faces), "lod_max": model.lod_max}
    tightness = check_model(model, sizes["samples"])
    row["tightness"] = round(tightness, 2) if np.isfinite(tightness) else None
    model.save(path)
    check_same(model, ab.Model.open(path))
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
    row["faces_per_s"] = round(1e3 * len(faces) / row["build_ms"])
    held = [*vars(model.progressive).values(), *vars(model.tree).values()]
    held = sum(value.nbytes for value in held if isinstance(value, np.ndarray))
    sizes_of = {"peak": peak if len(faces) >= PEAK_LEAST else None, "model": held, "file": path.stat().st_size}
    for key, value in sizes_of.items():
        row[f"{key}_mib"] = None if value is None else round(value / 2**20, 2)
        row[f"{key}_bytes_a_face"] = None if value is None else round(value / len(faces), 1)
    return row
