"""Pickles and copies: one sentence refuses them of what holds device memory; of what is on the host they work."""

import copy
import pickle

import numpy as np
import pytest
from helpers import refused
from helpers.questions import in_a_row

import warp_abtree as ab
from warp_abtree.query.broad_phase import BroadPhase

WAYS = {"pickle": pickle.dumps, "deepcopy": copy.deepcopy, "copy": copy.copy}
MAKERS = {
    "Scene": lambda scene: scene,
    "CollisionManager": lambda scene: ab.CollisionManager(scene.device),
    "Batch": lambda scene: scene.batch(),
    "ModelArrays": lambda scene: scene.batch().models,
    "StateArrays": lambda scene: scene.batch().states,
    "ObjectArrays": lambda scene: scene.batch().objects,
    "BroadPhase": lambda scene: BroadPhase(scene.batch()),
    "Query": lambda scene: ab.Query(scene, "any"),
    "ContactQuery": ab.ContactQuery,
    "ManifoldQuery": ab.ManifoldQuery,
    "DistanceQuery": ab.DistanceQuery,
    "FirstContactQuery": lambda scene: ab.FirstContactQuery(scene, None),
    "PoseInput": ab.PoseInput,
    "Pipeline": ab.Pipeline,
    "Frame": ab.Frame,
    "Dynamics": ab.Dynamics,
    "PaperController": lambda scene: ab.PaperController(scene, 8.0),
    "PredictiveController": lambda scene: ab.PredictiveController(scene, 8.0),
    "ToleranceController": lambda scene: ab.ToleranceController(scene, 1e-3),
    "LodUpdate": lambda scene: scene.set_lods([0, 0]),
    "Result": lambda scene: scene.intersect(device=True),
}


@pytest.fixture(scope="module")
def scenes():
    return {}


@pytest.mark.parametrize("name", MAKERS)
def test_device_memory_is_not_copied(device, name, scenes):
    scene = scenes.setdefault(device, in_a_row(device, "small ball", [0.0, 0.1]))
    made = MAKERS[name](scene)
    assert type(made).__name__ == name
    for held in (made, [made], {"a": made}):
        for way in WAYS.values():
            if way is copy.copy and held is not made:
                continue
            refused(TypeError, f"^this {name} holds device memory and cannot be pickled or copied; ", way, held)


def test_what_lies_on_the_host_is_copied(device):
    scene = in_a_row(device, "small ball", [0.0, 0.1])
    result = scene.intersect(output="contacts")
    for made in (pickle.loads(pickle.dumps(result)), copy.deepcopy(result), copy.copy(result)):
        assert made.contacts.tobytes() == result.contacts.tobytes() and len(made) == len(result)
        made.check()
    motion = ab.Kinematic(np.zeros((2, 3)))
    ab.Frame(scene, motion=motion).run(1)
    for made in (scene.models[0], ab.Ladder(scene.models), scene.tree_state(0), ab.Buffers(hits=5), motion):
        assert type(pickle.loads(pickle.dumps(copy.deepcopy(made)))) is type(made)
