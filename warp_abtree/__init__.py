"""Batched mesh-mesh interference queries at any level of detail, on NVIDIA Warp."""

from warp_abtree.app.pictures.plots import draw_controllers
from warp_abtree.app.toml.scene_file import SceneError, load_scene
from warp_abtree.checks.arguments import wrap_array
from warp_abtree.checks.version import __version__ as __version__
from warp_abtree.interop.arrays import PoseInput
from warp_abtree.interop.collision_manager import CollisionManager
from warp_abtree.interop.newton import NewtonContacts
from warp_abtree.interop.scenes import scene_from_file, scene_from_trimesh, to_trimesh
from warp_abtree.jobs import RayPool, SweepJob, ThisProcess, WorldsJob, read_shards, run_shards
from warp_abtree.lod.controllers import Feedback, PaperController, PredictiveController, ToleranceController
from warp_abtree.lod.timing import ReplayClock, WorkClock
from warp_abtree.lod.view import Camera
from warp_abtree.model.mesh import MeshError, describe_mesh, load_mesh, mesh_from_arrays
from warp_abtree.model.model import Model, ModelError
from warp_abtree.query.contacts import ContactQuery
from warp_abtree.query.manifold import ManifoldQuery
from warp_abtree.query.narrow_phase import Query
from warp_abtree.query.request import Buffers, CapacityError
from warp_abtree.query.result import Result
from warp_abtree.scene.pipeline import FrameGraph
from warp_abtree.scene.scene import Scene, TreeState
from warp_abtree.scene.sweep import sweep
from warp_abtree.simulate.budget_report import budget_report, step_response
from warp_abtree.simulate.frame import Frame, FrameRow, LodSweep, resolve_lod
from warp_abtree.simulate.motion import Kinematic
from warp_abtree.simulate.rigid_bodies import Dynamics
from warp_abtree.state.batch import Batch
from warp_abtree.state.ladder import Ladder

__all__ = [
    "Batch",
    "Buffers",
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
    "WorkClock",
    "WorldsJob",
    "budget_report",
    "describe_mesh",
    "draw_controllers",
    "load_mesh",
    "load_scene",
    "mesh_from_arrays",
    "read_shards",
    "resolve_lod",
    "run_shards",
    "scene_from_file",
    "scene_from_trimesh",
    "step_response",
    "sweep",
    "to_trimesh",
    "wrap_array",
]
