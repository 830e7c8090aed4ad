"""The public names, each once; `import warp_abtree as ab` has them."""

from warp_abtree.checks.arguments import wrap_array
from warp_abtree.interop.arrays import PoseInput
from warp_abtree.interop.collision_manager import CollisionManager
from warp_abtree.interop.newton import NewtonContacts
from warp_abtree.interop.robot.robot import Robot
from warp_abtree.interop.scenes import scene_from_file, scene_from_trimesh, to_trimesh
from warp_abtree.lod.controllers import Feedback, PaperController, PredictiveController, ToleranceController
from warp_abtree.lod.view import Camera
from warp_abtree.model.mesh import MeshError
from warp_abtree.model.model import Model, ModelError
from warp_abtree.query.request import Buffers, CapacityError
from warp_abtree.query.result import Result
from warp_abtree.query.stages.contacts import ContactQuery
from warp_abtree.query.stages.distance import DistanceQuery
from warp_abtree.query.stages.intersect import Query
from warp_abtree.query.stages.motion import FirstContactQuery
from warp_abtree.query.stages.points import ManifoldQuery
from warp_abtree.scene.pipeline import Pipeline
from warp_abtree.scene.point_distance import contains, signed_distance
from warp_abtree.scene.scene import Scene
from warp_abtree.scene.sweep import sweep
from warp_abtree.simulate.frame import Frame
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
    "DistanceQuery",
    "Dynamics",
    "Feedback",
    "FirstContactQuery",
    "Frame",
    "Kinematic",
    "Ladder",
    "ManifoldQuery",
    "MeshError",
    "Model",
    "ModelError",
    "NewtonContacts",
    "PaperController",
    "Pipeline",
    "PoseInput",
    "PredictiveController",
    "Query",
    "Result",
    "Robot",
    "Scene",
    "ToleranceController",
    "contains",
    "scene_from_file",
    "scene_from_trimesh",
    "signed_distance",
    "sweep",
    "to_trimesh",
    "wrap_array",
]
