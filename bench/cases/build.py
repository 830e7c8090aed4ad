"""Time and memory of making models: progressive mesh, certified errors and tree, by the number of faces.

Beside it what others make of the same mesh, which is less: `fast_simplification`, where installed, collapses edges
without errors and keeps no positions; a wp.Bvh is one tree over one mesh.
"""

import gc
import tempfile
import time

import warp_abtree as ab
from warp_abtree import testing

from ..baselines.wp_bvh import FaceBvh
from ..meshes import ModelFolder
from ..shapes import knot
from ..timing import host_clock, summarise, time_call

FULL = {"faces": (200, 1000, 5000, 20_000, 60_000, 250_000, 1_000_000), "repeats": 5}
QUICK = {"faces": (200, 600), "repeats": 2}
LARGE = 100_000  # faces from which on a build is timed once
BASE_FACES = 10
BASELINE = "fast_simplification"


def run(device, quick=False, models=None):
    """Yield one row a mesh.

    Times are those that one thread of the host ran, in turn with the baselines'; of the device only bvh_build, a wp.Bvh
    over the boxes of the faces.
    """
    sizes = QUICK if quick else FULL
    build(*knot(200), "")  # compiles what there is to compile
    with tempfile.TemporaryDirectory() as folder:
        for face_target in sizes["faces"]:
            yield run_mesh(device, face_target, sizes["repeats"], ModelFolder(models or folder))


def build(vertices, faces, name):
    """Return a model and the times of its stages [ms] of this thread; collapse includes checking and welding."""
    begin, end = time.thread_time(), {}

    def progress(stage, done, total):
        end[stage] = time.thread_time()

    with testing.regime(cpu_threads=1):  # stages one after another
        options = {"base_faces": BASE_FACES, "name": name, "cache": False, "certify": True}
        model = ab.Model.from_arrays(vertices, faces, progress=progress, **options)
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


def run_mesh(device, face_target, repeats, folder):
    """Return the row of one mesh."""
    gc.collect()
    vertices, faces = knot(face_target)
    name = f"knot:{face_target}"
    path = folder.file(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    model, first = build(vertices, faces, name)
    row = {"case": "build", "faces": len(faces), "lod_max": model.lod_max}
    model.save(path)
    if ab.Model.open(path).digest != model.digest:
        raise RuntimeError("the model saved and opened is another")
    calls = {"save": lambda: model.save(path), "open": lambda: ab.Model.open(path)}
    simplify, skipped = find_simplifier(vertices, faces)
    if simplify:
        calls[BASELINE] = simplify
    runs = {name: time_call(call, "cpu", time.thread_time) for name, call in calls.items()}
    runs["bvh_build"] = time_call(FaceBvh(vertices, faces, device).rebuild, device, host_clock(device))
    times = {}
    for turn in range(1 if len(faces) > LARGE else repeats):
        found = build(vertices, faces, name)[1] if turn else first
        for key, value in (found | {key: run() for key, run in runs.items()}).items():
            times.setdefault(key, []).append(value)
    row |= summarise(times) | {"file_mib": path.stat().st_size / 2**20}
    return row | ({f"{BASELINE}_reached": simplify()} if simplify else {f"{BASELINE}_skipped": skipped})
