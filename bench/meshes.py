"""Meshes of the studies by name, and a folder that keeps their models: built on one machine, opened on another.

Names: the real meshes of a folder (ABTREE_MESHES, or ../shared/meshes beside the checkout), "warp:bunny" and the like,
"knot:5000" (`shapes.knot`), "graded knot:5000" (the same, its faces ever smaller to one side), and what is made of
these: `MADE`.
"""

import os
import re
from pathlib import Path

import numpy as np

import warp_abtree as ab

from .shapes import knot

ROOT = Path(__file__).resolve().parents[1]
REAL = ("cow", "fandisk", "fcl-env", "fcl-rob", "homer", "rocker-arm", "stanford-bunny", "woody")
WARP = ("warp:bear", "warp:bunny", "warp:rocks")
# Collapsed from another mesh to so many faces, or the nearest number there is; originals of their own.
MADE = {"bunny 57564": ("stanford-bunny", 57563), "fandisk 4204": ("fandisk", 4204)}
GRADE = 6.0  # a graded knot is about one long, so its faces differ in size by exp(6)


def mesh_folder() -> Path | None:
    """Return the folder of the real meshes, None where there is none."""
    named = os.environ.get("ABTREE_MESHES")
    folder = Path(named) if named else ROOT.parent / "shared" / "meshes"
    return folder if folder.is_dir() else None


def mesh_file(name) -> Path | None:
    """Return the file of a real mesh, None where it is not at hand."""
    folder = mesh_folder()
    files = [folder / f"{name}{ending}" for ending in (".obj.gz", ".obj")] if folder else []
    return next((file for file in files if file.is_file()), None)


def has_source(name) -> bool:
    """Return whether a mesh can be loaded or made here."""
    if name in MADE:
        return has_source(MADE[name][0])
    if name in WARP:
        try:
            import pxr  # noqa: F401
        except ImportError:
            return False
        return True
    return name.partition(":")[0] in ("knot", "graded knot") or mesh_file(name) is not None


class ModelFolder:
    """Models in a folder, by name and faces of the base mesh; those in use stay in memory.

    Args:
        folder: Made when the first model is kept.
    """

    def __init__(self, folder):
        self.folder = Path(folder)
        self._open = {}

    def file(self, name, base_faces) -> Path:
        """Return where a model lies, or would."""
        return self.folder / f"{re.sub('[^a-z0-9-]+', '-', name.lower())}-base{base_faces}.npz"

    def has(self, name) -> bool:
        """Return whether a mesh can be loaded, or its model lies in the folder."""
        return has_source(name) or any(self.folder.glob(self.file(name, "*").name))

    def load(self, names, base_faces=10, progress=None) -> ab.Model:
        """Return the model of the first name that is at hand; its `name` is that name.

        Raises:
            ValueError: None is at hand.
        """
        for name in names:
            if self.file(name, base_faces).is_file() or has_source(name):
                return self._load(name, base_faces, progress)
        raise ValueError(f"none of {', '.join(names)} is at hand: set ABTREE_MESHES, or install the extra `usd`")

    def _load(self, name, base_faces, progress):
        key = name, base_faces
        if key not in self._open:
            file = self.file(name, base_faces)
            if not file.is_file():
                self.folder.mkdir(parents=True, exist_ok=True)
                self._make(name, base_faces, progress).save(file)
            self._open[key] = ab.Model.open(file)
        return self._open[key]

    def _make(self, name, base_faces, progress):
        if name in MADE:
            whole, faces = self._load(MADE[name][0], 10, progress), MADE[name][1]
            arrays = whole.mesh_at(whole.lod_for(fraction=faces / whole.face_count))[:2]
            return ab.Model.from_arrays(*arrays, base_faces=base_faces, progress=progress, name=name)
        kind, _, size = name.partition(":")
        if kind in ("knot", "graded knot"):
            vertices, faces = knot(int(size))
            if kind == "graded knot":
                vertices = vertices * np.exp(GRADE * vertices[:, :1])
            return ab.Model.from_arrays(vertices, faces, base_faces=base_faces, progress=progress, name=name)
        mesh = ab.load_mesh(name if name in WARP else mesh_file(name), name=name)
        return ab.Model.load(mesh, base_faces=base_faces, progress=progress)
