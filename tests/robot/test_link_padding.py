"""Padded links against FCL, on known ways, and against dense samples of edges."""

import fcl
import numpy as np
import pytest
import trimesh
import warp as wp
from helpers import refused
from helpers.questions import captured
from helpers.robots import AROUND, described_arm, described_chain, pose_frames, random_configurations
from oracles.peers import fcl_object

import warp_abtree as ab

PADDING = {"base": 0.5, "upper": 0.01, "fore": 0.02, "left": 0.03, "flap": 0.005}
NAMED = dict(zip(("ring", "roof"), AROUND))
WALL = ab.Model.load(trimesh.creation.box((0.1, 1, 1)))
CUBE = trimesh.creation.box((0.1, 0.1, 0.1))
X, Y, HERE = (1, 0, 0), (0, 1, 0), (0, 0, 0)
AT_WALL = [(WALL, (0.71, 0, 0, 0, 0, 0, 1))]  # a cube touches it from x = 0.61 on


def padded_arm(device, padding=PADDING):
    arm = ab.Robot(described_arm(), device, mounted=["base"])
    arm.link_padding = dict(padding)
    return arm


class AskFcl:
    """How much farther apart than padded each tested pair of names is at a configuration."""

    def __init__(self, arm):
        self.arm, self.names = arm, [arm.link_names[k] for k in arm.model_link]
        self.parts = [fcl_object(*model.mesh_at(model.lod_max)[:2]) for model in arm.models]
        around = [(name, fcl_object(*model.mesh_at(model.lod_max)[:2], pose)) for name, (model, pose) in NAMED.items()]
        self.pairs = [(self.names[i], self.names[j], self.parts[i], self.parts[j]) for i, j in arm.pairs]
        self.pairs += [(a, b, x, y) for a, x in zip(self.names, self.parts) if a != "base" for b, y in around]

    def __call__(self, row):
        for part, matrix in zip(self.parts, pose_frames(self.arm.description, row)[self.arm.model_link]):
            part.setTransform(fcl.Transform(matrix[:3, :3], matrix[:3, 3]))
        found, padding, request = {}, self.arm.link_padding, fcl.DistanceRequest()
        for a, b, x, y in self.pairs:
            apart = 0.0 if fcl.collide(x, y) else fcl.distance(x, y, request, fcl.DistanceResult())
            found[a, b] = apart - padding.get(a, 0) - padding.get(b, 0)
        return found


def test_pairs_within_paddings_are_those_of_fcl(device):
    arm, scene, rows = padded_arm(device), ab.Scene(device), random_configurations(150, seed=5)
    for name, (model, pose) in NAMED.items():
        scene.add(model, pose, name=name)
    truth = list(map(AskFcl(arm), rows))
    assert min(abs(slack) for found in truth for slack in found.values() if slack) > 1e-5, "no matter of rounding"
    expected = [{pair for pair, slack in found.items() if slack <= 0} for found in truth]
    assert arm.check(rows, scene, which=True) == [sorted(pairs) for pairs in expected]
    hit = arm.check(rows, scene)
    np.testing.assert_array_equal(hit, [bool(pairs) for pairs in expected])
    np.testing.assert_array_equal(arm.check(rows, AROUND), hit)
    bare = ab.Robot(described_arm(), device, mounted=["base"])
    assert 0 < bare.check(rows, scene).sum() < hit.sum() < len(rows)
    far = [found.tobytes() for found in (robot.check(rows, scene, output="distance") for robot in (arm, bare))]
    assert far[0] == far[1], "distances are those of the links as they are"
    arm.link_padding = {name: 0 for name in arm.link_names}
    np.testing.assert_array_equal(arm.check(rows, scene), bare.check(rows, scene))


def test_an_operator_has_the_paddings_of_its_time(device):
    arm, rows = padded_arm(device), random_configurations(40, seed=6)
    expected = arm.check(rows, AROUND)
    query = arm.query(AROUND, room=40)
    arm.link_padding = {}
    assert arm.check(rows, AROUND).sum() < expected.sum()
    query.configurations.assign(wp.array(rows, dtype=wp.float64, device=device))
    replay = captured(query)
    replay()
    query.check()
    np.testing.assert_array_equal(query.hit.numpy(), expected)


@pytest.mark.parametrize(
    ("padding", "tolerance"), [(0.0, 1e-3), (2.0**-40, 2.0**-20), (0.01, 0.1), (0.06, 2.0**-20), (0.3, 1e-3)]
)
def test_times_of_known_ways(device, padding, tolerance):
    """A cube drives to a wall, past it, and away from it; its padding may be larger than itself."""
    car = ab.Robot(described_chain(CUBE, ("prismatic", X, HERE, 1.0), ("prismatic", Y, HERE, 1.0)), device)
    car.link_padding = {"link 2": padding}
    near = 0.61 - padding  # least x at which it meets the wall
    starts = np.array([[0, 0], [near - 0.01, -0.4], [near + 0.001, 0], [0, 0]])
    ends = np.array([[1, 0], [near - 0.01, 0.4], [0, 0], [-1, 0.3]])
    rows = car.check_edges(starts, ends, AT_WALL, tolerance)
    assert near - tolerance <= rows["time"][0] <= near and rows["time"].tolist()[1:] == [1, 0, 1]
    assert rows["clear"].tolist() == [False, True, False, True] and not rows["undecided"].any()
    alone = [car.check_edges(a, b, AT_WALL, tolerance) for a, b in zip(starts, ends)]
    assert np.array(alone).tobytes() == rows.tobytes()
    at = np.array([[near - 1e-9, 0], [near + 1e-9, 0]])
    assert car.check(at, AT_WALL).tolist() == [False, True]


def test_paddings_go_with_links(device):
    arm, rows = padded_arm(device), random_configurations(30, seed=7)
    expected = arm.check(rows, AROUND)
    cup = ab.Model.load(trimesh.creation.icosphere(subdivisions=1, radius=0.02))
    arm.attach(cup, "flange", (0, 0, 0.1, 0, 0, 0, 1), name="cup")
    thin = arm.check(rows, AROUND)
    arm.link_padding["cup"] = 0.2
    assert (arm.check(rows, AROUND) >= thin).all() and arm.check(rows, AROUND).sum() > thin.sum()
    arm.detach("cup")
    assert arm.link_padding == PADDING
    np.testing.assert_array_equal(arm.check(rows, AROUND), expected)


@pytest.mark.parametrize(
    ("padding", "kind", "message"),
    [
        ({"hand": 0.1}, ValueError, "link_padding: the robot has no link 'hand'"),
        ({"fore": -0.1}, ValueError, "link_padding of 'fore': -0.1 is below 0"),
        ({"fore": np.nan}, ValueError, "link_padding of 'fore': nan is not a finite number"),
        ({"fore": "a"}, ValueError, "link_padding of 'fore'"),
        ({"fore": (1, 2)}, ValueError, "link_padding of 'fore'"),
        (0.1, TypeError, "link_padding: a float is no dict"),
    ],
)
def test_refuses_bad_paddings(device, padding, kind, message):
    arm, rows = padded_arm(device), random_configurations(2)
    arm.link_padding = padding
    for call in (arm.check, arm.query, lambda *_: arm.check_edges(rows, rows)):
        refused(kind, message, call, rows if call == arm.check else None)
