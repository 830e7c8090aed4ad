"""Models that a robot holds, and which links and objects intersect: an arm with a cup in a shelf against FCL."""

import copy
import pickle
from itertools import combinations

import fcl
import numpy as np
import pytest
import trimesh
from helpers import refused
from helpers.questions import to_matrix
from helpers.robots import (
    MJCF,
    RING,
    asked_pairs,
    described_arm,
    described_chain,
    pose_frames,
    random_configurations,
    write_arm,
)
from oracles.peers import fcl_object
from scipy.spatial.transform import Rotation

import warp_abtree as ab

# A cup, open where it stands on its hand, and a shelf of two boards.
CUP = trimesh.creation.annulus(0.05, 0.07, 0.25)
BOARDS = [(trimesh.creation.box((0.8, 0.4, 0.02)), (0.3, 0.35, z, 0, 0, 0, 1)) for z in (0.6, 1.0)]
TILTED = (0.02, 0.0, 0.2, *Rotation.from_rotvec((0.4, 0.1, 0)).as_quat())
LINKS, FIXED = ("base", "upper", "fore", "left", "right", "flap"), {"fore", "flange"}


@pytest.fixture
def arm(device):
    return ab.Robot(described_arm(), device, mounted=["base"])


@pytest.fixture
def shelf(device):
    scene = ab.Scene(device)
    for k, (board, pose) in enumerate(BOARDS):
        scene.add(ab.Model.load(board), pose, name=f"board {k}")
    scene.add(RING, (0, 0, 0.75, 0, 0, 0, 1))  # "trimesh 2"
    return scene


class Posed:
    """The links of an arm, what it holds and the shelf in FCL, and how far each pair of two names is apart."""

    def __init__(self, description, held=()):
        self.description, self.held = description, held
        self.links = {name: part for name, part in zip(LINKS, description.parts)}
        self.objects = {name: fcl_object(part.mesh.vertices, part.mesh.faces) for name, part in self.links.items()}
        self.objects |= {name: fcl_object(mesh.vertices, mesh.faces) for name, mesh, _, _ in held}
        self.around = {f"board {k}": fcl_object(b.vertices, b.faces, pose) for k, (b, pose) in enumerate(BOARDS)}
        ring = RING.mesh_at(RING.lod_max)[:2]
        self.around |= {"trimesh 2": fcl_object(*ring, (0, 0, 0.75, 0, 0, 0, 1))}

    def distances(self, row, tested):
        """Return the distance of each pair, 0 where it intersects, by its names, for pairs of links that are tested."""
        frames = pose_frames(self.description, row)
        placed = {name: frames[part.link] for name, part in self.links.items()}
        for name, _, link, pose in self.held:
            turn = Rotation.from_quat(pose[3:]).as_matrix()
            placed[name] = frames[self.description.links[link]] @ to_matrix(turn, pose[:3])
        for name, matrix in placed.items():
            self.objects[name].setTransform(fcl.Transform(matrix[:3, :3], matrix[:3, 3]))
        asked = [pair for pair in combinations(self.objects, 2) if frozenset(pair) in tested]
        asked += [(name, other) for name in self.objects if name != "base" for other in self.around]
        return {pair: self.distance(*pair) for pair in asked}

    def distance(self, *names):
        a, b = ((self.objects | self.around)[name] for name in names)
        return 0.0 if fcl.collide(a, b) else fcl.distance(a, b, fcl.DistanceRequest(), fcl.DistanceResult())


def meeting(distances):
    return sorted(pair for pair, far in distances.items() if far == 0)


@pytest.mark.parametrize("touches", [(), ("left", "right")])
def test_an_arm_holds_a_cup_in_a_shelf(arm, shelf, touches):
    rows = random_configurations(80, seed=1)
    before, alone = arm.check(rows, shelf), asked_pairs(arm)
    arm.attach(ab.Model.load(CUP), "flange", TILTED, name="cup", touches=touches)
    assert arm.attached == ("cup",) and arm.link_names[-1] == "cup"
    tested = alone | {frozenset(("cup", name)) for name in {*LINKS} - FIXED - {*touches}}
    assert asked_pairs(arm) == tested
    posed = Posed(described_arm(), [("cup", CUP, "flange", TILTED)])
    expected = [posed.distances(row, tested) for row in rows]
    found = arm.check(rows, shelf, which=True)
    assert found == [meeting(distances) for distances in expected]
    named = {name for row in found for pair in row for name in pair}
    assert {"cup", "board 0", "trimesh 2"} <= named and len({len(row) for row in found}) > 3
    hit = arm.check(rows, shelf)
    assert hit.tolist() == [bool(row) for row in found] and before.sum() < hit.sum() < 80
    near = arm.check(rows, shelf, output="distance")
    np.testing.assert_allclose(near["distance"], [min(distances.values()) for distances in expected], atol=1e-6)
    assert "cup" in near["names"][~hit, 0]
    for row, names, distances in zip(near[~hit], near["names"][~hit], np.array(expected)[~hit]):
        far = distances.get(tuple(names), distances.get(tuple(names[::-1])))
        assert far == pytest.approx(row["distance"], abs=1e-6)
        of = [arm.link_names[k] for k in arm.model_link] + [shelf.name(i) for i in range(3)]
        assert names.tolist() == [of[k] for k in row["pair"]]
    arm.detach("cup")
    np.testing.assert_array_equal(arm.check(rows, shelf), before)
    assert arm.attached == () and asked_pairs(arm) == alone and arm.link_names[-1] == "flap"


def test_the_world_goes_by_its_names_of_now(arm, shelf):
    """Also where a place has no object any more, and of arrays that are kept."""
    rows = random_configurations(60, seed=4)
    told = arm.check(rows, shelf, which=True)
    shelf.change(2, name="hoop")
    as_hoop = [sorted((a, b.replace("trimesh 2", "hoop")) for a, b in row) for row in told]
    assert [sorted(row) for row in arm.check(rows, shelf, which=True)] == as_hoop != [sorted(row) for row in told]
    near = arm.check(rows, shelf, output="distance")
    shelf.change(2, name="a ring of steel")
    nearer = arm.check(rows, shelf, output="distance")
    assert np.array_equal(np.where(near["names"] == "hoop", "a ring of steel", near["names"]), nearer["names"])
    assert "a ring of steel" in nearer["names"]
    shelf.remove(0)
    kept = [[(a, b.replace("hoop", "a ring of steel")) for a, b in row if b != "board 0"] for row in as_hoop]
    assert arm.check(rows, shelf, which=True) == [sorted(row) for row in kept]
    shelf.remove([1, 2])
    emptied, alone = (arm.check(rows, *world, output="distance") for world in ([shelf], []))
    np.testing.assert_array_equal(emptied["names"], alone["names"])


def test_an_edge_is_blocked_by_what_is_held(device):
    """A cube slides along x by 1; a rod of 0.5 that it holds ahead meets a wall 0.8 away."""
    mesh, wall = trimesh.creation.box((0.1, 0.1, 0.1)), ab.Model.load(trimesh.creation.box((0.1, 1, 1)))
    car = ab.Robot(described_chain(mesh, ("prismatic", (1, 0, 0), (0, 0, 0), 1.0)), device)
    world, rod = [(wall, (1.35, 0, 0, 0, 0, 0, 1))], ab.Model.load(trimesh.creation.box((0.5, 0.01, 0.01)))
    assert car.check_edges([0.0], [1.0], world)["clear"]
    car.attach(rod, "link 1", (0.25, 0, 0, 0, 0, 0, 1), name="rod")
    row = car.check_edges([0.0], [1.0], world, tolerance=1e-4)
    assert not row["clear"] and 0.8 - 1e-4 <= row["time"] <= 0.8
    assert car.check([[0.7], [0.9]], which=True) == [[], []]
    assert car.check([[0.7], [0.9]], world, which=True) == [[], [("rod", f"{wall.name} 0")]]
    scene = ab.Scene(device)
    assert car.add_to(scene, [0.0]).tolist() == [0, 1] and [scene.name(i) for i in (0, 1)] == ["link 1", "rod"]
    assert len(scene.broad_phase()) == 0


def test_models_are_attached_to_one_another_and_taken_away_in_any_order(arm, shelf):
    lid = trimesh.creation.box((0.2, 0.2, 0.01))
    on_top, aside = (0, 0, 0.2, 0, 0, 0, 1), (0.1, 0, 0.1, 0, 0, 0, 1)
    rows, alone = random_configurations(60, seed=2), asked_pairs(arm)
    arm.attach(ab.Model.load(CUP), "upper", aside, name="cup")
    arm.attach(ab.Model.load(CUP), "flange", TILTED, name="other cup")
    arm.attach(ab.Model.load(lid), "other cup", on_top, name="lid")
    arm.mounted = [*arm.mounted, arm.link_names.index("other cup")]
    other = pickle.loads(pickle.dumps(arm))
    for held in (arm, other, copy.copy(arm), copy.deepcopy(arm)):
        assert held.attached == ("cup", "other cup", "lid")
        assert held.check(rows, shelf, which=True) == arm.check(rows, shelf, which=True)
    of_lid = {frozenset(("lid", name)) for name in {*LINKS} - FIXED}
    tested = asked_pairs(arm)
    assert {pair for pair in tested if "lid" in pair} == of_lid | {frozenset(("lid", "cup"))}
    refused(ValueError, "detach: 'lid' is attached to 'other cup'", arm.detach, "other cup")
    arm.detach("cup")
    assert asked_pairs(arm) == {pair for pair in tested if "cup" not in pair}
    assert [arm.link_names[k] for k in arm.mounted] == ["base", "other cup"]
    # The lid's place in the flange's frame: that of the cup, then its own.
    turn = Rotation.from_quat(TILTED[3:])
    at = (*(turn.apply(on_top[:3]) + TILTED[:3]), *turn.as_quat())
    posed = Posed(described_arm(), [("other cup", CUP, "flange", TILTED), ("lid", lid, "flange", at)])
    expected = [posed.distances(row, asked_pairs(arm)) for row in rows]
    for row, distances in zip(arm.check(rows, shelf, which=True), expected):
        assert row == [pair for pair in meeting(distances) if pair[0] != "other cup" or pair[1] not in posed.around]
    arm.detach("lid")
    arm.detach("other cup")
    assert asked_pairs(arm) == alone and arm.mounted == [0]
    # A copy keeps what it holds.
    other.detach("lid")
    assert other.attached == ("cup", "other cup")


def test_parts_of_a_link_are_named_once(tmp_path, device):
    pytest.importorskip("mujoco")
    arm = ab.Robot.load(write_arm(tmp_path, MJCF, "arm.xml"), device=device)  # whose left finger has two
    left = arm.forward([0, 0, 0, 0.05]).numpy()[arm.link_names.index("left")]
    spanning = trimesh.creation.box((0.001, 0.001, 0.4), left)
    pairs = arm.check([0, 0, 0, 0.05], ab.Model.load(spanning), which=True)
    assert sum(pair[0] == "left" for pair in pairs) == 1


def test_bad_attachments_change_nothing(arm):
    cup, rows = ab.Model.load(CUP), random_configurations(5)
    arm.attach(cup, "flange", name="cup")
    for arguments, options, kind, message in (
        ((CUP, "flange"), {"name": "x"}, TypeError, "model is a Trimesh"),
        ((cup, "hand"), {"name": "x"}, ValueError, "attach: the robot has no link 'hand'"),
        ((cup, "flange"), {"name": "cup"}, ValueError, "attach: the robot has a link 'cup' already"),
        ((cup, "flange"), {"name": "left"}, ValueError, "a link 'left' already"),
        ((cup, "flange"), {"name": ""}, ValueError, "name '' is no string"),
        ((cup, "flange", (0, 0, 0)), {"name": "x"}, ValueError, "pose: shape"),
        ((cup, "flange", 2 * np.eye(4)), {"name": "x"}, ValueError, "pose: matrix 0 is not rigid"),
        ((cup, "flange"), {"name": "x", "touches": "left"}, TypeError, "touches: 'left' is a name"),
        ((cup, "flange"), {"name": "x", "touches": ["thumb"]}, ValueError, "touches: the robot has no link 'thumb'"),
    ):
        refused(kind, message, arm.attach, *arguments, **options)
    for name in ("base", "lid"):
        refused(ValueError, f"detach: no attached model has the name '{name}'", arm.detach, name)
    refused(ValueError, "which means nothing for output 'distance'", arm.check, rows, output="distance", which=True)
    assert arm.attached == ("cup",) and len(arm.models) == 7 and arm.check(rows[:0], which=True) == []
    assert arm.check(rows, output="distance", beyond=0.0)["names"].shape == (5, 2)
