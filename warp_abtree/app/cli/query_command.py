"""`warp-abtree query`: one query of two meshes at a pose and two LODs."""

import csv
import time
from pathlib import Path

import numpy as np

from warp_abtree.app.cli.arguments import LOD_HELP, MESHES, PRECISION_NAMES, Parser
from warp_abtree.app.cli.model_commands import diagonal_of, is_model, load_models, lod_at
from warp_abtree.app.cli.report import check_output, print_result, show_number
from warp_abtree.app.toml.folder import find_scene
from warp_abtree.app.toml.scene_file import load_scene
from warp_abtree.checks.atomic_write import atomic_write
from warp_abtree.interop.scenes import is_assembly
from warp_abtree.model.files.found import MeshError
from warp_abtree.query.result import RESULT_ARRAYS, VECTORS
from warp_abtree.scene.scene import Scene
from warp_abtree.state.poses import IDENTITY_POSE

SUMMARY = "intersect two meshes, A at the origin and B at a pose, or all objects of a scene"
EXAMPLES = (
    "warp:bear warp:bunny --pose 2 2 0 0 0 0 1",
    "bunny_tori --output distance --beyond 0.2 --record pairs.csv",
    "bunny.npz bunny.npz --pose -0.5 0 0 0 0 0 1 --lod-a 0.25 --lod-b tol:0.01 --output faces --json",
    "bunny.npz bunny.npz --pose 0.2 0 0 0 0 0 1 --output contacts --record contacts.csv",
    "bunny.npz bunny.npz --pose 2 0 0 0 0 0 1 --output distance --json",
    "bunny.npz bunny.npz --pose 2 0 0 0 0 0 1 --lod-a 0.1 --lod-b 0.1 --output distance --relative 0.05 --originals",
)
OUTPUTS = ("any", "count", "faces", "contacts", "distance")
DISTANCE_OPTIONS = ("tolerance", "relative", "beyond", "originals", "signed")


def add_arguments(sub: Parser):
    """Add the arguments of the command to its parser."""
    about = f"{MESHES}, or a model that build wrote (.npz); alone a scene file (.toml) or file of several objects"
    sub.add_scene("a", metavar="A", help=about)
    sub.add_file("b", metavar="B", nargs="?", help="a mesh or model; with a scene none")
    sub.add_pose("pose of B in the frame of A: position and unit quaternion (0 0 0 0 0 0 1)")
    sub.add_argument("--lod-a", metavar="LOD", help=f"LOD of A: {LOD_HELP} (finest)")
    sub.add_argument("--lod-b", metavar="LOD", help="the same for B (finest)")
    sub.add_argument("--output", choices=OUTPUTS, default="count", help="what to ask (count)")
    about = "signs of determinants: exact, or of the rounded ones (exact)"
    sub.add_argument("--precision", choices=PRECISION_NAMES, default="exact", help=about)
    sub.add_number("--tolerance", "width of the bracket that ends the search of a distance (0)")
    sub.add_number("--relative", "the same as a fraction of the distance (0)")
    sub.add_number("--beyond", "distance that is far enough (none)")
    sub.add_flag("--originals", "the distance of the original meshes, at whatever LODs A and B stand", None)
    sub.add_flag("--signed", "negative distances, as deep as the deepest point of one solid in the other", None)
    sub.add_flag("--solid", "what lies inside A or B, or objects of the scene, closed meshes, intersects it")
    about = "write face pairs and contacts as .csv, of a scene its object pairs, or the whole result as .npz"
    sub.add_file("--record", type=Path, metavar="FILE", help=about)


def query(options, progress):
    """Intersect two meshes at a pose and two LODs, or the objects of a scene."""
    if options.record:
        check_output(options.record, [".csv", ".npz"], inputs=filter(None, (options.a, options.b)))
    if options.b is None:
        return _query_scene(options, progress)
    if options.record and options.record.suffix.lower() == ".csv" and options.output not in ("faces", "contacts"):
        raise ValueError(f"{options.record}: a row is a face pair; ask --output faces or contacts, or write .npz")
    scene, models = _make_scene(options, progress)
    found, spent = _ask(scene, np.array([[0, 1]]), options)
    lods = scene.lods.tolist()
    result = {
        "intersects": bool(found.any[0]),
        "count": None if found.count is None else int(found.count[0]),
        "bound": sum(model.error_at(lod) for model, lod in zip(models, lods)),
        "lods": lods,
        "diagonals": [diagonal_of(model) for model in models],
        "active_faces": [model.progressive.active_count(lod) for model, lod in zip(models, lods)],
        "node_tests": int(found.node_tests[0]),
        "triangle_tests": int(found.triangle_tests[0]),
        "milliseconds": spent,
        "device": str(scene.device),
        "precision": options.precision,
    }
    if found.faces is not None:
        result["faces"] = found.faces[:, 1:]
    if found.distance is not None:
        result |= {name: getattr(found, name)[0] for name in ("distance", "bracket", "points", "point_faces")}
        if not options.json and np.isinf(result["distance"]):
            result["distance"] = f"farther than {show_number(result.pop('bracket')[0])}"
            del result["points"], result["point_faces"]
    if found.contacts is not None:
        names = found.contacts.dtype.names[2:]
        rows = [{"face_a": r["faces"][0], "face_b": r["faces"][1], **_named(r, names)} for r in found.contacts]
        result |= {"contacts": rows, "pair_contacts": _named(found.pair_contacts[0])}
    if options.record:
        record_found(found, options.record)
        result["written"] = [str(options.record)]
    print_result(result, options.json)


def _ask(scene, pairs, options):
    """Return what pairs are found, and the time that it takes [ms]."""
    asked = {"output": options.output, **_list_options(options)}
    scene.intersect(pairs, **asked)  # loads the kernels, so that the time below is the query's
    begin = time.perf_counter()
    found = scene.intersect(pairs, **asked)
    return found, 1e3 * (time.perf_counter() - begin)


def _query_scene(options, progress):
    """Ask the pairs of a scene that are near one another."""
    for name in ("pose", "lod_a", "lod_b"):
        if getattr(options, name) is not None:
            raise ValueError(f"--{name.replace('_', '-')}: for two meshes; {options.a} says where its objects are")
    path = find_scene(options.a)
    is_built = is_model(options.a) and path.is_file()
    if path.suffix.lower() != ".toml" and (is_built or not is_assembly(path, readable=True)):
        raise ValueError(f"{options.a}: B is missing; alone stands a scene file or a file of several objects")
    scene = load_scene(options.a, device=options.device, progress=progress).scene
    progress.close()
    for i in np.flatnonzero(scene.present).tolist() if options.solid else []:
        scene.change(i, solid=True)
    found, spent = _ask(scene, None, options)
    if options.record and options.record.suffix.lower() == ".csv":
        found.to_csv(options.record)
    elif options.record:
        record_found(found, options.record)
    result = {
        "scene": options.a,
        "objects": scene.object_count,
        "near": len(found),
        "intersecting": int(found.any.sum()),
        "milliseconds": spent,
        "device": str(scene.device),
        "precision": options.precision,
        "written": [str(options.record)] if options.record else [],
        "pairs": found.rows(),
    }
    print_result(result, options.json)


def _list_options(options) -> dict:
    """Return the options of an output; raise ValueError for one of another."""
    of_distance = {name: getattr(options, name) for name in DISTANCE_OPTIONS if getattr(options, name) is not None}
    if options.output == "distance":
        if options.precision != "exact":
            raise ValueError("--precision means nothing for --output distance")
        return of_distance
    for name in of_distance:
        raise ValueError(f"--{name} means nothing for --output {options.output}")
    return {"precision": options.precision}


def _make_scene(options, progress):
    """Return a scene of both meshes, and their models."""
    scene = Scene(device=options.device)
    models = load_models([options.a, options.b], progress)
    progress.close()
    named = zip(("--lod-a", "--lod-b"), models, (options.lod_a, options.lod_b))
    lods = [lod_at(name, model, lod or "finest") for name, model, lod in named]
    scene.add(models[0], lod=lods[0], solid=options.solid)
    try:
        scene.add(models[1], pose=options.pose or IDENTITY_POSE, lod=lods[1], solid=options.solid)
    except MeshError:
        raise
    except ValueError as error:
        raise ValueError(f"--{error}") from None
    return scene, models


def _named(row, names=None) -> dict:
    return {name: row[name] for name in names or row.dtype.names}


def record_found(found, path: Path):
    """Write the arrays of a `Result` to a .npz file, or a row for each face pair of one object pair to a .csv file."""
    if path.suffix.lower() == ".npz":
        names = (*RESULT_ARRAYS, "count")
        arrays = {name: getattr(found, name) for name in names if getattr(found, name) is not None}
        with atomic_write(path) as file:
            np.savez(file, **arrays)
        return
    columns = {"face_a": found.faces[:, 1], "face_b": found.faces[:, 2]}
    if found.contacts is not None:
        for name in VECTORS:
            columns |= {f"{name}_{axis}": found.contacts[name][:, k] for k, axis in enumerate("xyz")}
        columns["coplanar"] = found.contacts["coplanar"].astype(int)
    with atomic_write(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*(values.tolist() for values in columns.values())))
