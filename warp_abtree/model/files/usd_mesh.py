"""Meshes of USD, and those inside Warp."""

from pathlib import Path

import numpy as np
import warp as wp

from warp_abtree.model.files.found import MeshError
from warp_abtree.model.files.polygons import triangulate

WARP_ASSETS = ("bunny", "bear", "rocks")


def read_warp_asset(source, asset) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of a mesh inside Warp; raise MeshError if it cannot be had."""
    if asset not in WARP_ASSETS:
        raise MeshError(f"{source}: unknown; Warp's meshes are {', '.join('warp:' + each for each in WARP_ASSETS)}")
    try:
        from pxr import Usd, UsdGeom
    except ImportError:
        raise MeshError(f"{source}: reading it needs usd-core: pip install usd-core") from None
    path = Path(wp.__file__).parent / "examples" / "assets" / f"{asset}.usd"
    if not path.is_file():
        raise MeshError(f"{source}: {path} is missing from this installation of Warp")
    stage = Usd.Stage.Open(str(path))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/root/{asset}"))  # its transform is the identity in all three files
    return read_usd_mesh(mesh, Usd.TimeCode.Default(), source)


def read_usd_mesh(mesh, time, where):
    """Return vertices and triangles of a `UsdGeom.Mesh`, None without any; raise MeshError if they do not fit."""
    points, counts = mesh.GetPointsAttr().Get(time), mesh.GetFaceVertexCountsAttr().Get(time)
    if not points or not counts:
        return None
    vertices, counts = np.array(points, np.float64), np.array(counts)
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get(time) or [], np.int64)
    if (counts < 3).any() or counts.sum() != len(corners):
        raise MeshError(f"{where}: its face counts do not fit its indices")
    holes = np.array(mesh.GetHoleIndicesAttr().Get(time) or [], np.int64)
    if len(holes):
        solid = ~np.isin(np.arange(len(counts)), holes)
        corners, counts = corners[np.repeat(solid, counts)], counts[solid]
        if not solid.any():
            return None
    return vertices, triangulate(vertices, counts, corners, where)
