"""Batched mesh-mesh interference queries at any level of detail, on NVIDIA Warp."""

from warp_abtree.broadphase import CapacityError
from warp_abtree.contact import ContactQuery
from warp_abtree.dynamics import Kinematic
from warp_abtree.frame import Frame, FrameRow, LodSweep, resolve_lod
from warp_abtree.intersect import Query, Result
from warp_abtree.mesh import MeshError, describe_mesh, load_mesh, mesh_from_arrays
from warp_abtree.model import Model, ModelError
from warp_abtree.pose_sweep import sweep
from warp_abtree.refine import UpdateStats
from warp_abtree.scene import Scene, TreeState
from warp_abtree.scene_file import SceneError, load_scene

__version__ = "0.1.0"

__all__ = [
    "CapacityError",
    "ContactQuery",
    "Frame",
    "FrameRow",
    "Kinematic",
    "LodSweep",
    "MeshError",
    "Model",
    "ModelError",
    "Query",
    "Result",
    "Scene",
    "SceneError",
    "TreeState",
    "UpdateStats",
    "describe_mesh",
    "load_mesh",
    "load_scene",
    "mesh_from_arrays",
    "resolve_lod",
    "sweep",
]
