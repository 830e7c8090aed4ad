"""Held models and padded links: intersecting pairs and distances against FCL, and edges on known ways."""

import copy
import pickle

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers import refused
from helpers.questions import captured, to_matrix
from helpers.robots import (
    AROUND,
    MJCF,
    RING,
    InFcl,
    asked_pairs,
    described_arm,
    described_chain,
    pose_frames,
    random_configurations,
    write_arm,
)
from helpers.scenes import scene_with
from scipy.spatial.transform import Rotation

import warp_abtree as ab

# A cup, open where it stands on its hand, and a shelf of two boards.
CUP = trimesh.creation.annulus(0.05, 0.07, 0.25)
BOARD = ab.Model.load(trimesh.creation.box((0.8, 0.4, 0.02)))
SHELF = {f"board {k}": (BOARD, (0.3, 0.35, z, 0, 0, 0, 1)) for k, z in enumerate((0.6, 1.0))}
SHELF["trimesh 2"] = RING, (0, 0, 0.75, 0, 0, 0, 1)  # a name by default
TILTED = (0.02, 0.0, 0.2, *Rotation.from_rotvec((0.4, 0.1, 0)).as_quat())
LINKS, FIXED = ("base", "upper", "fore", "left", "right", "flap"), {"fore", "flange"}
WALL, CUBE = ab.Model.load(trimesh.creation.box((0.1, 1, 1))), trimesh.creation.box((0.1, 0.1, 0.1))
X, Y, HERE = (1, 0, 0), (0, 1, 0), (0, 0, 0)


@pytest.fixture
def arm(device):
    return ab.Robot(described_arm(), device, mounted=["base"])


@pytest.fixture
def shelf(device):
    scene = scene_with(device, *SHELF.values())
    for k in range(2):
        scene.change(k, name=f"board {k}")
    return scene


def distances_at(arm, rows, *held):
    """Return how far each tested pair of names is apart at configurations, by what is held on the flange and where."""
    in_fcl, found = InFcl(arm, **SHELF), []
    for row in rows:
        frames = pose_frames(described_arm(), row)
        flange = frames[arm.link_names.index("flange")]
        placed = [flange @ to_matrix(Rotation.from_quat(pose[3:]).as_matrix(), pose[:3]) for pose in held]
        found.append(in_fcl.distances(np.array([*frames, *placed])))
    return found


def meeting(distances):
    return sorted(pair for pair, far in distances.items() if far == 0)


@pytest.mark.parametrize("touches", [(), ("left", "right")])
def test_an_arm_holds_a_cup_in_a_shelf(arm, shelf, touches):
    rows = random_configurations(80, seed=1)
    before, alone = arm.check(rows, shelf), asked_pairs(arm)
    arm.attach(ab.Model.load(CUP), "flange", TILTED, name="cup", touches=touches)
    assert arm.attached == ("cup",) and arm.link_names[-1] == "cup" and arm.mounted == [0]
    tested = alone | {frozenset(("cup", name)) for name in {*LINKS} - FIXED - {*touches}}
    assert asked_pairs(arm) == tested
    expected = distances_at(arm, rows, TILTED)
    found = arm.check(rows, shelf, which=True)
    assert found == [meeting(distances) for distances in expected]
    named = {name for row in found for pair in row for name in pair}
    assert {"cup", "board 0", "trimesh 2"} <= named and len({len(row) for row in found}) > 3
    hit = arm.check(rows, shelf)
    assert hit.tolist() == [bool(row) for row in found] and before.sum() < hit.sum() < 80
    near = arm.check(rows, shelf, output="distance")
    np.testing.assert_allclose(near["distance"], [min(distances.values()) for distances in expected], atol=1e-6)
    np.testing.assert_array_equal(near["distance"] == 0, hit)
    between = np.linalg.norm(near["points"][:, 0] - near["points"][:, 1], axis=1)
    np.testing.assert_allclose(between, near["distance"], atol=1e-12)
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
    car = ab.Robot(described_chain(CUBE, ("prismatic", X, HERE, 1.0)), device)
    world, rod = [(WALL, (1.35, 0, 0, 0, 0, 0, 1))], ab.Model.load(trimesh.creation.box((0.5, 0.01, 0.01)))
    assert car.check_edges([0.0], [1.0], world)["clear"]
    car.attach(rod, "link 1", (0.25, 0, 0, 0, 0, 0, 1), name="rod")
    row = car.check_edges([0.0], [1.0], world, tolerance=1e-4)
    assert not row["clear"] and 0.8 - 1e-4 <= row["time"] <= 0.8
    assert car.check([[0.7], [0.9]], which=True) == [[], []]
    assert car.check([[0.7], [0.9]], world, which=True) == [[], [("rod", f"{WALL.name} 0")]]
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
    assert arm.check(rows, shelf, which=True) == [meeting(found) for found in distances_at(arm, rows, TILTED, at)]
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


PADDING = {"base": 0.5, "upper": 0.01, "fore": 0.02, "left": 0.03, "flap": 0.005}
NAMED = dict(zip(("ring", "roof"), AROUND))
AT_WALL = [(WALL, (0.71, 0, 0, 0, 0, 0, 1))]  # a cube touches it from x = 0.61 on


@pytest.fixture
def padded_arm(arm):
    arm.link_padding = dict(PADDING)
    return arm


def test_pairs_within_paddings_are_those_of_fcl(padded_arm, device):
    arm, rows = padded_arm, random_configurations(150, seed=5)
    scene = scene_with(device, *[(*placed, {"name": name}) for name, placed in NAMED.items()])
    in_fcl, truth = InFcl(arm, **NAMED), []
    for row in rows:
        apart = in_fcl.distances(pose_frames(arm.description, row))
        truth.append({pair: far - sum(PADDING.get(name, 0) for name in pair) for pair, far in apart.items()})
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


def test_an_operator_has_the_paddings_of_its_time(padded_arm, device):
    arm, rows = padded_arm, random_configurations(40, seed=6)
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


def test_paddings_go_with_links(padded_arm):
    arm, rows = padded_arm, random_configurations(30, seed=7)
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
def test_refuses_bad_paddings(arm, padding, kind, message):
    rows = random_configurations(2)
    arm.link_padding = padding
    for call in (arm.check, arm.query, lambda *_: arm.check_edges(rows, rows)):
        refused(kind, message, call, rows if call == arm.check else None)
