"""Batched mesh-mesh interference queries at any level of detail, on NVIDIA Warp."""

from warp_abtree.broadphase import CapacityError
from warp_abtree.checks import wrap_array
from warp_abtree.clock import ReplayClock, WorkClock
from warp_abtree.cluster import RayPool, WorldsJob
from warp_abtree.collision_manager import CollisionManager
from warp_abtree.contact import ContactQuery
from warp_abtree.control import Feedback, PaperController, PredictiveController, ToleranceController
from warp_abtree.dynamics import Dynamics, Kinematic
from warp_abtree.frame import Frame, FrameRow, LodSweep, judge_budget, judge_step, resolve_lod
from warp_abtree.frame_graph import FrameGraph
from warp_abtree.interop import PoseInput, scene_from_file, scene_from_trimesh, to_trimesh
from warp_abtree.intersect import Query, Result
from warp_abtree.lod import Camera, Ladder
from warp_abtree.manifold import ManifoldQuery
from warp_abtree.mesh import MeshError, describe_mesh, load_mesh, mesh_from_arrays
from warp_abtree.model import Model, ModelError
from warp_abtree.newton import NewtonContacts
from warp_abtree.plot import draw_controllers
from warp_abtree.pose_sweep import sweep
from warp_abtree.refine import UpdateStats
from warp_abtree.scene import Scene, TreeState
from warp_abtree.scene_file import SceneError, load_scene
from warp_abtree.shard_folder import read_shards
from warp_abtree.shards import SweepJob, ThisProcess, run_shards

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "CapacityError",
    "CollisionManager",
    "ContactQuery",
    "Dynamics",
    "Feedback",
    "Frame",
    "FrameGraph",
    "FrameRow",
    "Kinematic",
    "Ladder",
    "LodSweep",
    "ManifoldQuery",
    "MeshError",
    "Model",
    "ModelError",
    "NewtonContacts",
    "PaperController",
    "PoseInput",
    "PredictiveController",
    "Query",
    "RayPool",
    "ReplayClock",
    "Result",
    "Scene",
    "SceneError",
    "SweepJob",
    "ThisProcess",
    "ToleranceController",
    "TreeState",
    "UpdateStats",
    "WorkClock",
    "WorldsJob",
    "describe_mesh",
    "draw_controllers",
    "judge_budget",
    "judge_step",
    "load_mesh",
    "load_scene",
    "mesh_from_arrays",
    "read_shards",
    "resolve_lod",
    "run_shards",
    "scene_from_file",
    "scene_from_trimesh",
    "sweep",
    "to_trimesh",
    "wrap_array",
]
