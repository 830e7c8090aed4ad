"""Meshes by name, and a folder that keeps their models: built on one machine, opened on another.

Names: the real meshes of a folder (ABTREE_MESHES, or ../shared/meshes beside the checkout), "warp:bunny" and the like,
"knot:5000" (`shapes.knot`), and the meshes of `COLLAPSED`.
"""

import importlib.util
import os
import re
from pathlib import Path

import warp_abtree as ab
from warp_abtree.model.mesh import load_mesh

from .shapes import knot

ROOT = Path(__file__).resolve().parents[1]
NUT = ("factory-bolt-m20", "factory-nut-m20")
WARP = ("warp:bear", "warp:bunny", "warp:rocks")
# Collapsed from another mesh to so many faces, or the nearest number there is; originals of their own.
COLLAPSED = {"bunny 57564": ("stanford-bunny", 57563), "fandisk 4204": ("fandisk", 4204)}


def mesh_file(name) -> Path | None:
    """Return the file of a real mesh, None where it is not at hand."""
    named = os.environ.get("ABTREE_MESHES")
    folder = Path(named) if named else ROOT.parent / "shared" / "meshes"
    files = [folder / f"{name}{ending}" for ending in (".obj.gz", ".obj")]
    return next((file for file in files if file.is_file()), None)


def real_meshes(pairs) -> dict:
    """Return the models of named tuples of meshes, where the folder in ABTREE_MESHES has all of a tuple."""
    folder = ModelFolder(None)
    found = [key for key, names in pairs.items() if os.environ.get("ABTREE_MESHES") and all(map(mesh_file, names))]
    return {key: tuple(folder.load([name]) for name in pairs[key]) for key in found}


def knot_model(face_target, folder=None) -> ab.Model:
    """Return the model of a knot, which takes minutes for a million faces; a folder keeps it between runs."""
    return ModelFolder(folder).load([f"knot:{face_target}"])


def has_source(name) -> bool:
    """Return whether a mesh can be loaded or made here."""
    if name in COLLAPSED:
        return has_source(COLLAPSED[name][0])
    if name in WARP:
        return importlib.util.find_spec("pxr") is not None
    return name.startswith("knot:") or mesh_file(name) is not None


class ModelFolder:
    """Models in a folder, by name and faces of the base mesh; those in use stay in memory. None keeps no files."""

    def __init__(self, folder):
        self.folder = None if folder is None else Path(folder)
        self._open = {}

    def file(self, name, base_faces=10) -> Path:
        """Return where a model lies, or would."""
        return self.folder / f"{re.sub('[^a-z0-9-]+', '-', name.lower())}-base{base_faces}.npz"

    def has(self, name) -> bool:
        """Return whether a mesh can be loaded, or its model lies in the folder."""
        kept = () if self.folder is None else self.folder.glob(self.file(name, "*").name)
        return has_source(name) or any(kept)

    def load(self, names, base_faces=10) -> ab.Model:
        """Return the model of the first name that is at hand, its `name`; raise a ValueError where none is."""
        for name in names:
            key, file = (name, base_faces), self.folder and self.file(name, base_faces)
            if key not in self._open and file and file.is_file():
                self._open[key] = ab.Model.open(file)
            elif key not in self._open and has_source(name):
                self._open[key] = self._make(name, base_faces)
                if file:
                    self.folder.mkdir(parents=True, exist_ok=True)
                    self._open[key].save(file)
            if key in self._open:
                return self._open[key]
        raise ValueError(f"none of {', '.join(names)} is at hand: set ABTREE_MESHES, or install the extra `usd`")

    def _make(self, name, base_faces):
        if name in COLLAPSED:
            whole, face_count = self.load(COLLAPSED[name][:1]), COLLAPSED[name][1]
            vertices, faces, _ = whole.mesh_at(whole.lod_for(fraction=face_count / whole.face_count))
        elif name.startswith("knot:"):
            vertices, faces = knot(int(name.removeprefix("knot:")))
        else:
            mesh = load_mesh(name if name in WARP else mesh_file(name), name=name)
            return ab.Model.load(mesh, base_faces=base_faces)
        return ab.Model.from_arrays(vertices, faces, base_faces=base_faces, name=name)
