"""`warp-abtree info` and `warp-abtree build`: what a mesh holds, and the model that is built of it."""

import sys
import time
from pathlib import Path

import numpy as np

from warp_abtree.app.cli.arguments import MESHES, PROGRAM, Parser, positive_count
from warp_abtree.app.cli.report import check_output, print_result
from warp_abtree.model.files.read import split_file_name
from warp_abtree.model.mesh import describe_mesh, load_mesh, mesh_from_arrays
from warp_abtree.model.model import Model
from warp_abtree.scene.scene import Scene
from warp_abtree.simulate.lod_request import resolve_lod

INFO_SUMMARY = "say what a mesh or a built model holds and what is odd about it"
INFO_EXAMPLES = ("warp:bunny --json", "bunny.npz")
BUILD_SUMMARY = "build models from meshes and save them"
BUILD_EXAMPLES = ("warp:bunny bunny.npz --base-faces 100", "warp:bear warp:rocks .")
KEPT_APART = "clash, run, view and picture of this file alone, and scene_from_file in Python, keep them apart"
LISTED_FRACTIONS = (0.5, 0.2, 0.1, 0.05, 0.01)  # of the faces, at which `build` prints the errors


def is_model(source) -> bool:
    """Return whether a path is one of a built model."""
    return source.lower().endswith(".npz")


def load_models(sources, progress) -> list[Model]:
    """Open built models, or build them of meshes, each source once; say on stderr which are of several parts."""
    known = {}
    for source in dict.fromkeys(sources):
        known[source] = Model.open(source) if is_model(source) else Model.load(source, progress=progress)
        tell_joined(source, known[source], progress)
    return [known[source] for source in sources]


def tell_joined(source, mesh, progress):
    """Say on stderr that a `Mesh` or a `Model` of a file is one mesh of several parts."""
    if mesh.parts > 1:
        if progress is not None:
            progress.close()
        told = f"{source}: its {mesh.parts} parts are joined into one mesh, and not asked of one another"
        print(f"{PROGRAM}: {told}; {KEPT_APART}", file=sys.stderr)


def lod_at(option, model, request) -> int:
    """Return the LOD that an option asks of a model; errors name the option."""
    try:
        return resolve_lod(model, request)
    except ValueError as error:
        raise ValueError(f"{option}: {error}") from None


def diagonal_of(model) -> float:
    """Return the diagonal of the original's box, which tells meshes of different units apart [model units]."""
    return float(np.linalg.norm(np.ptp(model.mesh_at(model.lod_max)[0], axis=0)))


def add_info_arguments(sub: Parser):
    """Add the arguments of `info`."""
    sub.add_file("mesh", metavar="MESH", help=f"{MESHES}, or a model that build wrote (.npz)")


def info(options, progress):
    """Print what a mesh file or a built model holds."""
    Scene(device=options.device)
    if is_model(options.mesh):
        model = Model.open(options.mesh)
        forest = model.progressive
        found = describe_mesh(mesh_from_arrays(forest.vertex_pos[: model.vertex_count], forest.face_vertex, model.name))
        for key in ("parts", "file_vertices", "unreferenced_vertices", "welded_vertices"):
            del found[key]  # a model does not keep them
        found |= {"lods": model.lod_max + 1, "base_faces": forest.active_count(0)}
    else:
        mesh = load_mesh(options.mesh)
        tell_joined(options.mesh, mesh, progress)
        found = describe_mesh(mesh)
    print_result(found, options.json)


def add_build_arguments(sub: Parser):
    """Add the arguments of `build`."""
    sub.add_file("mesh", metavar="MESH", nargs="+", help=f"{MESHES}; one after another")
    sub.add_file("out", metavar="OUT", type=Path, help="file to write (.npz), or a folder for NAME.npz of each mesh")
    sub.add_number("--base-faces", "faces of the coarsest LOD (10)", positive_count, 10)
    sub.add_flag("--orient", "turn faces that disagree with neighbours or point into the solid")


def build(options, progress):
    """Build models and save them; a mesh that is bad costs a line on stderr, and the status in the end."""
    several = len(options.mesh) > 1 or (options.out.is_dir() and options.out.suffix != ".npz")
    files = [_model_file(options.out, mesh) for mesh in options.mesh] if several else [options.out]
    for mesh, file in zip(options.mesh, files):
        check_output(file, [".npz"])
        if files.count(file) > 1:
            raise ValueError(f"{file}: would be written for {mesh} and for another mesh")
    Scene(device=options.device)
    if not several:
        print_result(_build_file(options.mesh[0], options.out, options, progress), options.json)
        return 0
    rows = []
    for mesh, file in zip(options.mesh, files):
        try:
            rows.append(_build_file(mesh, file, options, progress))
        except (ValueError, OSError, MemoryError) as error:
            progress.close()
            print(f"{PROGRAM}: {' '.join(str(error).split()) or type(error).__name__}", file=sys.stderr)
    listed = ("file", "bytes", "faces", "vertices", "dropped_faces", "lods", "base_faces", "seconds")
    shown = rows if options.json else [{key: row[key] for key in listed} for row in rows]
    print_result({"models": shown, "failed": len(files) - len(rows)}, options.json)
    return 2 if len(rows) < len(files) else 0


def _model_file(folder, mesh) -> Path:
    """Return where in a folder the model of a mesh is written."""
    if not folder.is_dir():
        raise ValueError(f"{folder}: is no folder; several models are written to one")
    return folder / f"{split_file_name(Path(mesh.removeprefix('warp:')))[0]}.npz"


def _build_file(mesh, file, options, progress) -> dict:
    """Build a model, save it and say what it holds."""
    begin = time.perf_counter()
    model = Model.load(mesh, options.base_faces, progress, cache=False, orient=options.orient, certify=True)
    seconds = time.perf_counter() - begin
    progress.close()
    tell_joined(mesh, model, progress)
    model.save(file)
    rows = []
    for fraction in LISTED_FRACTIONS:
        progress("outward bounds", len(rows), len(LISTED_FRACTIONS))
        lod = model.lod_for(fraction=fraction)
        errors = {f"error_{side}": model.error_at(lod, side=side) for side in ("inward", "outward")}
        rows.append({"share": fraction, "lod": lod, "faces": model.progressive.active_count(lod), **errors})
    progress.close()
    return {
        "file": str(file),
        "bytes": file.stat().st_size,
        "faces": model.face_count,
        "vertices": model.vertex_count,
        "dropped_faces": len(model.dropped_faces),
        "lods": model.lod_max + 1,
        "base_faces": model.progressive.active_count(0),
        "diagonal": diagonal_of(model),
        "seconds": seconds,
        "errors": rows,
    }
