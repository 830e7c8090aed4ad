"""Mesh files of all formats: our own readers where polygons, parts or what is left out matter, trimesh for the rest."""

import codecs
import contextlib
import io
import os
import sys
import warnings
import zlib
from pathlib import Path

import numpy as np

from warp_abtree.model.files.collada import read_collada
from warp_abtree.model.files.found import FileSurface, MeshError, Remarks, empty_scene, refusing
from warp_abtree.model.files.gltf import read_gltf
from warp_abtree.model.files.obj import read_obj
from warp_abtree.model.files.off import read_off
from warp_abtree.model.files.ply import read_ply
from warp_abtree.model.files.stl import read_stl
from warp_abtree.model.files.threemf import read_3mf
from warp_abtree.model.files.unpack import gunzip, unzip

SURFACES = {"obj": read_obj, "ply": read_ply, "off": read_off, "stl": read_stl, "stl_ascii": read_stl}
USD = ("usd", "usda", "usdc", "usdz")
STEP = ("step", "stp")
# Of trimesh, or of ours: packages that some formats need.
NEEDED = {"dae": "pycollada", "zae": "pycollada", "xaml": "lxml", "3dxml": "lxml networkx"}
MILLIMETRES = 1000.0  # in a metre, the unit of glTF
UNREAD = {"tar.gz", "tar.bz2", "bz2"}  # archives that trimesh would read past the limit, and past our readers


def split_file_name(path: Path) -> tuple[str, str, bool]:
    """Return a mesh file's name without extensions, its format as trimesh calls it, and whether it is gzipped."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    archive = suffixes[-2:] in ([".tar", ".gz"], [".tar", ".bz2"])
    zipped = suffixes[-1:] == [".gz"] and not archive
    kind = "".join(suffixes[-2:-1] if zipped else suffixes[-2:] if archive else suffixes[-1:]).removeprefix(".")
    stem = path.name.removesuffix(path.suffixes[-1]) if zipped else path.name
    return stem[: len(stem) - len(kind) - 1] if kind else stem, kind, zipped


def read_file(path: Path, remarks: Remarks):
    """Return a `FileSurface` of a file with one list of vertices; of any other format a trimesh.Scene.

    Raises MeshError for a file that is missing, damaged, of an unknown format, or holds what cannot be read.
    """
    if path.is_dir():
        raise MeshError(f"{path}: is a folder, not a mesh file")
    if not path.exists():
        raise MeshError(f"{path}: no such file")
    if not path.is_file():
        raise MeshError(f"{path}: is no regular file")
    _, kind, zipped = split_file_name(path)
    if kind == "npz":
        raise MeshError(f"{path}: not a mesh file; a built model is read by Model.open")
    if kind in USD:
        raise MeshError(f"{path}: USD is read by scene_from_file alone, as a scene of its objects")
    with refusing(f"{path}: cannot be read", (OSError, EOFError, zlib.error)):
        data = path.read_bytes()
        if zipped:
            data = gunzip(data, str(path))
    if data.startswith(b"version https://git-lfs"):
        raise MeshError(f"{path}: stands for a file that Git LFS has, which was not fetched (git lfs pull)")
    return _read_data(data, kind, str(path), None, remarks)


def _read_data(data, kind, where, resolver, remarks):
    """Return what the bytes of a file hold, as `read_file` does; without a resolver, `where` is its path."""
    if kind in SURFACES:
        return SURFACES[kind](data.removeprefix(codecs.BOM_UTF8), where, remarks)
    import trimesh  # takes as long as the rest of the library

    resolver = trimesh.resolvers.FilePathResolver(where) if resolver is None else resolver
    if kind in ("glb", "gltf"):
        return read_gltf(data, where, resolver, remarks)
    if kind == "dae":
        return read_collada(data, where, remarks)
    if kind in STEP:
        return _read_step(data, where, remarks)
    if kind in UNREAD:
        raise MeshError(f"{where}: unpack it; of archives zip and gz alone are read")
    known = _known_formats()
    if kind not in known and kind in NEEDED:
        raise MeshError(f"{where}: reading it needs {NEEDED[kind]}: pip install {NEEDED[kind]}")
    if kind not in known:
        raise MeshError(f"{where}: cannot be read: unknown extension '{kind}'; known here: {' '.join(sorted(known))}")
    with refusing(f"{where}: cannot be read as {kind}"):  # trimesh's readers raise whatever goes wrong inside them
        if kind in ("zip", "zae"):
            return _read_archive(unzip(data, where), where, remarks)
        if kind == "3mf":
            return read_3mf(unzip(data, where), where, remarks)
        with warnings.catch_warnings():
            # Older NumPy only warns where a number in a text file cannot be read, and cuts the file short there.
            warnings.filterwarnings("error", message="string or file could not be read")
            return trimesh.load_scene(io.BytesIO(data), file_type=kind, resolver=resolver, process=False)


def _known_formats() -> set[str]:
    """Return the formats of trimesh that are read, and those of our own that it may lack the packages for."""
    import trimesh

    return (trimesh.available_formats() | {"3mf"}) - UNREAD


def _read_step(data, where, remarks):
    """Return the parts of a STEP file in millimetres, whatever its units, as a trimesh.Scene."""
    try:
        import cascadio
    except ImportError:
        raise MeshError(f"{where}: reading STEP needs cascadio: pip install cascadio") from None
    with _stdout_to_stderr():
        converted = cascadio.load(data, "step")
    if not converted:
        raise MeshError(f"{where}: cannot be read as STEP")
    scene = read_gltf(converted, where, None, remarks)
    if not scene.geometry:
        raise MeshError(f"{where}: holds no solid or surface")
    for mesh in scene.geometry.values():
        # Rounded as they were in metres, most coordinates are those of the file again.
        mesh.vertices = (mesh.vertices * MILLIMETRES).astype(np.float32)
    for node in scene.graph.nodes_geometry:
        pose, geometry = scene.graph[node]
        scene.graph.update(node, geometry=geometry, matrix=np.vstack([pose[:3] * [1, 1, 1, MILLIMETRES], pose[3]]))
    return scene


@contextlib.contextmanager
def _stdout_to_stderr():
    """Send to stderr what native code prints: stdout is for results."""
    sys.stdout.flush()
    kept = os.dup(1)
    try:
        os.dup2(2, 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def _read_archive(members, where, remarks):
    """Return the mesh files of a zip archive in one scene, but for hidden ones, such as macOS adds to each file."""
    import trimesh

    merged, counts = empty_scene(), {}
    for name, data in members.items():
        stem, kind, zipped = split_file_name(Path(name))
        if Path(name).name.startswith("."):
            continue
        if zipped or kind in {*USD, *UNREAD, "zip"}:
            remarks.add("left out", name)
        elif kind in _known_formats() or kind in NEEDED or kind in STEP:
            folder = name[: name.rfind("/") + 1]
            beside = {key.removeprefix(folder): other for key, other in members.items() if key.startswith(folder)}
            resolver = trimesh.resolvers.ZipResolver(beside)
            found = _read_data(data, kind, f"{where}: {name}", resolver, remarks)
            scene = found.as_scene(stem) if isinstance(found, FileSurface) else found
            for node in scene.graph.nodes_geometry:
                pose, part = scene.graph[node]
                title = trimesh.util.unique_name(node, merged.graph.nodes, counts)
                merged.add_geometry(scene.geometry[part], title, f"{name}: {part}", transform=pose)
    if not merged.geometry:
        raise MeshError(f"{where}: holds no mesh file" + (f" ({remarks})" if str(remarks) else ""))
    return merged
