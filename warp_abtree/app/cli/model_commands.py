"""`warp-abtree info` and `warp-abtree build`: what a mesh holds, and the model that is built of it."""

import time
from pathlib import Path

import numpy as np

from warp_abtree.app.cli.arguments import MESHES, Parser, positive
from warp_abtree.app.cli.report import check_output, print_result
from warp_abtree.model.mesh import describe_mesh, load_mesh, mesh_from_arrays
from warp_abtree.model.model import Model
from warp_abtree.scene.scene import Scene
from warp_abtree.simulate.frame import resolve_lod

INFO_SUMMARY = "say what a mesh or a built model holds and what is odd about it"
INFO_EXAMPLES = ("cow.obj", "cow.npz", "warp:bunny --json")
BUILD_SUMMARY = "build a model from a mesh and save it"
BUILD_EXAMPLES = ("cow.obj cow.npz --base-faces 100",)
LISTED_FRACTIONS = (0.5, 0.2, 0.1, 0.05, 0.01)  # of the faces, at which `build` prints the errors


def is_model(source) -> bool:
    """Return whether a path is one of a built model."""
    return source.lower().endswith(".npz")


def load_model(source, progress) -> Model:
    """Open a built model, or build one of a mesh."""
    return Model.open(source) if is_model(source) else Model.load(source, progress=progress)


def lod_at(option, model, request) -> int:
    """Return the LOD that an option asks of a model; errors name the option."""
    try:
        return resolve_lod(model, request)
    except ValueError as error:
        raise ValueError(f"{option}: {error}") from None


def active_count(model, lod) -> int:
    """Return the active faces of a model at a LOD."""
    return len(model.mesh_at(lod)[2])


def add_info_arguments(sub: Parser):
    """Add the arguments of `info`."""
    sub.add_file("mesh", metavar="MESH", help=f"{MESHES}, or a model that build wrote (.npz)")


def info(options, progress):
    """Print what a mesh file or a built model holds."""
    Scene(device=options.device)
    found = _describe_model(options.mesh) if is_model(options.mesh) else describe_mesh(load_mesh(options.mesh))
    print_result(found, options.json)


def _describe_model(path) -> dict:
    model = Model.open(path)
    forest = model.progressive
    found = describe_mesh(mesh_from_arrays(forest.vertex_pos[: model.vertex_count], forest.face_vertex, model.name))
    for key in ("file_vertices", "unreferenced_vertices", "welded_vertices"):
        del found[key]  # a model does not keep them
    return found | {"lods": model.lod_max + 1, "base_faces": active_count(model, 0)}


def add_build_arguments(sub: Parser):
    """Add the arguments of `build`."""
    sub.add_file("mesh", metavar="MESH", help=MESHES)
    sub.add_file("out", metavar="OUT.npz", type=Path, help="file to write")
    sub.add_argument("--base-faces", type=positive, default=10, metavar="N", help="faces of the coarsest LOD (10)")


def build(options, progress):
    """Build a model and save it."""
    check_output(options.out, [".npz"])
    Scene(device=options.device)
    begin = time.perf_counter()
    model = Model.load(options.mesh, base_faces=options.base_faces, progress=progress)
    seconds = time.perf_counter() - begin
    progress.close()
    model.save(options.out)
    rows = []
    for fraction in LISTED_FRACTIONS:
        progress("outward bounds", len(rows), len(LISTED_FRACTIONS))
        lod = model.lod_for(fraction=fraction)
        errors = {f"error_{side}": model.error_at(lod, side=side) for side in ("inward", "outward")}
        rows.append({"share": fraction, "lod": lod, "faces": active_count(model, lod), **errors})
    progress.close()
    result = {
        "file": str(options.out),
        "bytes": options.out.stat().st_size,
        "faces": model.face_count,
        "vertices": model.vertex_count,
        "dropped_faces": len(model.dropped_faces),
        "lods": model.lod_max + 1,
        "base_faces": active_count(model, 0),
        "diagonal": float(np.linalg.norm(np.ptp(model.mesh_at(model.lod_max)[0], axis=0))),
        "seconds": seconds,
        "errors": rows,
    }
    print_result(result, options.json)
