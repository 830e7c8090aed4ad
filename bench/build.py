"""Time and memory of making models: progressive mesh, certified errors and tree, by the number of faces.

Beside it what others make of the same mesh, which is less: `fast_simplification`, where installed, collapses edges
without errors and keeps no positions; a wp.Bvh is one tree over one mesh.
"""

import contextlib
import gc
import tempfile
import time
from pathlib import Path

import numpy as np
import warp as wp

import warp_abtree as ab

from .peer import BvhPeer
from .shapes import knot
from .timing import fit_slope, summarise, time_wall

FULL = {"faces": (200, 1000, 5000, 20_000, 60_000, 250_000, 1_000_000), "repeats": (5, 1), "samples": 2000}
QUICK = {"faces": (200, 600), "repeats": (2, 1), "samples": 100}
LARGE = 100_000  # faces from which on a build is timed once
PEAK_LEAST = 20_000  # a smaller build fits into memory that the process had before
CHECKED_SHARES = (0.3, 0.05)  # of the faces: LODs whose certified errors are tried
BASE_FACES = 10
PEER = "fast_simplification"
STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")

PANEL = {"where": {"case": "build"}, "x": "faces", "xlabel": "faces a mesh", "by": None}
FIGURES = (
    {
        "file": "build.svg",
        "panels": (
            PANEL
            | {
                "title": "making a model, time",
                "y": {
                    "build_ms": "whole model",
                    "collapse_ms": "collapse",
                    "tree_ms": "tree",
                    f"{PEER}_ms": "fast-simplification",
                    "bvh_build_ms": "wp.Bvh",
                    "open_ms": "open the file",
                },
                "ylabel": "time [ms]",
            },
            PANEL
            | {
                "title": "making a model, memory",
                "y": {"peak_mib": "to build", "model_mib": "model", "file_mib": "file"},
                "ylabel": "memory [MiB]",
            },
        ),
    },
)


@wp.kernel(enable_backward=False)
def distance_kernel(mesh: wp.uint64, points: wp.array(dtype=wp.vec3), distance_out: wp.array(dtype=wp.float32)):
    i = wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], 1.0e30)
    distance_out[i] = wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - points[i])


def measure_distance(vertices, faces, points):
    """Return how far points lie from a surface, float32 (n,), by Warp's own mesh queries on the CPU."""
    mesh = wp.Mesh(
        wp.array(vertices, dtype=wp.vec3, device="cpu"), wp.array(faces.reshape(-1), dtype=wp.int32, device="cpu")
    )
    asked = wp.array(points, dtype=wp.vec3, device="cpu")
    distance = wp.empty(len(points), dtype=wp.float32, device="cpu")
    wp.launch(distance_kernel, len(points), [mesh.id, asked, distance], device="cpu")
    return distance.numpy().copy()


def check_model(model, samples, seed=0):
    """Return the least of certified error over measured distance: points of the original against coarser LODs.

    Raises:
        RuntimeError: A point lies farther from a LOD than its certified error, or a LOD lacks faces.
    """
    rng = np.random.default_rng(seed)
    vertices, faces, _ = model.mesh_at(model.lod_max)
    weights = rng.dirichlet(np.ones(3), samples)
    points = (weights[:, :, None] * vertices[faces[rng.integers(len(faces), size=samples)]]).sum(1)
    rounding = 1e-6 * np.ptp(vertices, axis=0).max()  # of float32
    least = np.inf
    for share in CHECKED_SHARES:
        lod = model.lod_for(fraction=share)
        coarse = model.mesh_at(lod)
        if len(coarse[1]) != model.progressive.active_count(lod):
            raise RuntimeError(f"LOD {lod} has {len(coarse[1])} faces, not {model.progressive.active_count(lod)}")
        farthest = float(measure_distance(coarse[0], coarse[1], points).max())
        if farthest > model.error_at(lod) + rounding:
            raise RuntimeError(f"a point lies {farthest} from LOD {lod}, beyond its error {model.error_at(lod)}")
        if farthest > rounding:
            least = min(least, model.error_at(lod) / farthest)
    return least


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


class Stages:
    """Times of the stages of a build [ms], by what `progress` reports."""

    def __init__(self):
        self.begin = time.thread_time()
        self.end = {}

    def __call__(self, stage, done, total):
        self.end[stage] = time.thread_time()

    def finish(self):
        stop, collapse = time.thread_time(), self.end.get("collapse", self.begin)
        error = self.end.get("LOD bounds", collapse)
        parts = {"collapse": collapse - self.begin, "error": error - collapse, "tree": stop - error}
        return {name: 1e3 * seconds for name, seconds in {**parts, "build": stop - self.begin}.items()}


def build(vertices, faces, name):
    """Return a model and the times of its stages [ms]; collapse includes that to check and weld the mesh."""
    stages = Stages()
    model = ab.Model.from_arrays(vertices, faces, base_faces=BASE_FACES, progress=stages, name=name)
    return model, stages.finish()


def simplify(vertices, faces):
    """Collapse by the peer to as many faces; return how many it reached.

    Raises:
        ImportError: It is not installed.
    """
    import fast_simplification

    found = fast_simplification.simplify(vertices, faces, target_count=BASE_FACES, return_collapses=True)
    return len(found[1])


def time_call(call):
    """Return what a call returns and the time [ms] that this thread ran."""
    begin = time.thread_time()
    found = call()
    return found, 1e3 * (time.thread_time() - begin)


def run(device, quick=False, largest=None, models=None):
    """Yield one row a mesh, and one of the slopes of its lines.

    Times are those that one thread of the host ran, in turn with the peers'; of the device only bvh_build, a wp.Bvh
    over the boxes of the faces. peak is what a build takes at most above what was there, model what the arrays hold.
    tightness is the least of certified error over what was measured at some points, at least 1 where the bound holds.
    """
    device = wp.get_device(device)
    sizes = QUICK if quick else FULL
    rows = []
    check_model(build(*knot(200), "")[0], 10)  # compiles what there is to compile
    with contextlib.suppress(ImportError):
        simplify(*knot(200))
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
    peer = BvhPeer(vertices, faces, np.zeros((0, 7)), 0, device, None)
    rebuild = time_wall(peer.rebuild, device, time.thread_time if device.is_cpu else time.perf_counter)
    times, skipped, reached = {}, None, None
    repeats = sizes["repeats"][len(faces) > LARGE]
    for _ in range(repeats):
        found = build(vertices, faces, name)[1] if repeats > 1 else first
        found["save"] = time_call(lambda: model.save(path))[1]
        found["open"] = time_call(lambda: ab.Model.open(path))[1]
        found["bvh_build"] = rebuild()
        try:
            reached, found[PEER] = time_call(lambda: simplify(vertices, faces))
        except ImportError as error:
            skipped = str(error)
        for key, value in found.items():
            times.setdefault(key, []).append(value)
    for key, values in times.items():
        row |= summarise(key, values)
    row |= {f"{PEER}_skipped": skipped} if skipped else {f"{PEER}_reached": reached}
    row["faces_per_s"] = round(1e3 * len(faces) / row["build_ms"])
    held = [*vars(model.progressive).values(), *vars(model.tree).values()]
    held = sum(value.nbytes for value in held if isinstance(value, np.ndarray))
    sizes_of = {"peak": peak if len(faces) >= PEAK_LEAST else None, "model": held, "file": path.stat().st_size}
    for key, value in sizes_of.items():
        row[f"{key}_mib"] = None if value is None else round(value / 2**20, 2)
        row[f"{key}_bytes_a_face"] = None if value is None else round(value / len(faces), 1)
    return row


def check_same(model, other):
    """Compare all arrays of two models.

    Raises:
        RuntimeError: They differ.
    """
    for part in ("progressive", "tree"):
        for name, value in vars(getattr(model, part)).items():
            if isinstance(value, np.ndarray) and not np.array_equal(value, getattr(getattr(other, part), name)):
                raise RuntimeError(f"{name} of the opened model differs from the saved one's")
