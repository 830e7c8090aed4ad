"""Batched mesh-mesh interference queries at any level of detail, on NVIDIA Warp."""

from warp_abtree.intersect import CapacityError, Query, Result, sweep
from warp_abtree.mesh import MeshError
from warp_abtree.model import Model, ModelError
from warp_abtree.refine import UpdateStats
from warp_abtree.scene import Scene, TreeState

__version__ = "0.1.0"

__all__ = [
    "CapacityError",
    "MeshError",
    "Model",
    "ModelError",
    "Query",
    "Result",
    "Scene",
    "TreeState",
    "UpdateStats",
    "sweep",
]
