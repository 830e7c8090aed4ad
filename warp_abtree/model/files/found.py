"""Surfaces that readers of mesh files return, their remarks, and the error that they raise."""

import contextlib
import inspect
import warnings
from dataclasses import dataclass

import numpy as np

from warp_abtree.checks.arguments import first_line

NAMED = 4  # things that a warning lists by name
ROOT_FRAME = "\0"  # frame that nodes hang on; one of them may be called as trimesh calls it


class MeshError(ValueError):
    """Say in one line what is wrong with a mesh, and where."""


def warn_caller(message: str, category: type[Warning] = RuntimeWarning):
    """Warn at the line that called the library."""
    frame, level = inspect.currentframe(), 1
    while frame is not None and frame.f_globals.get("__name__", "").startswith("warp_abtree."):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)


@contextlib.contextmanager
def refusing(message: str, errors: type[Exception] | tuple = Exception, with_type=False):
    """Raise MeshError in the place of errors inside: a message, perhaps the error's type, and its first line."""
    try:
        yield
    except MeshError:
        raise
    except errors as error:
        kind = f"{type(error).__name__}: " if with_type else ""
        raise MeshError(f"{message}: {kind}{first_line(error)}") from None


def empty_scene():
    """Return a trimesh.Scene for nodes of any name."""
    import trimesh

    return trimesh.Scene(base_frame=ROOT_FRAME)


class Remarks:
    """What a reader did not take as it stands in the file: what was done, and with which things."""

    def __init__(self):
        self._found: dict[str, list[str]] = {}

    def add(self, what: str, name: str):
        """Remember what was done with a thing: `add("left out", "edges")`."""
        names = self._found.setdefault(what, [])
        if name not in names:
            names.append(name)

    def __str__(self):
        """All of them in one line, empty without any."""
        said = []
        for what, names in self._found.items():
            more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
            said.append(f"{what} {', '.join(names[:NAMED])}{more}")
        return "; ".join(said)

    def warn(self, where):
        """Warn of them, if any, at the line that called the library."""
        if str(self):
            warn_caller(f"{where}: {self}", UserWarning)


@dataclass(frozen=True, eq=False)
class FileSurface:
    """Triangles over one list of vertices, in the order of their file."""

    vertices: np.ndarray  # positions [file's units], float64 (v, 3)
    faces: np.ndarray  # corners (n_f, 3), integers
    names: tuple[str | None, ...] = (None,)  # of the parts that the file makes of its faces, None without a name
    parts: np.ndarray | None = None  # part of each face (n_f,); None where there is one part

    def as_scene(self, name: str):
        """Return a trimesh.Scene with a node of each part that has faces, those without a name called by one."""
        import trimesh

        scene, counts = empty_scene(), {}
        for part, own in enumerate(self.names):
            faces = self.faces if self.parts is None else self.faces[self.parts == part]
            if len(faces):
                vertices = self.vertices
                if self.parts is not None:
                    used, corners = np.unique(faces, return_inverse=True)
                    vertices, faces = vertices[used], corners.reshape(-1, 3)
                mesh = trimesh.Trimesh(vertices, faces, process=False)
                title = trimesh.util.unique_name(own or name, scene.geometry, counts)
                scene.add_geometry(mesh, node_name=title, geom_name=title)
        return scene
