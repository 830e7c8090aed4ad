"""Robots at many configurations against FCL, a scene of posed links, and dense samples of edges."""

import copy
import pickle
import re
from dataclasses import replace

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers import refused
from helpers.questions import captured
from helpers.robots import (
    AROUND,
    RING,
    ROOF,
    described_arm,
    described_chain,
    pose_frames,
    random_configurations,
)
from helpers.samples import STILL
from helpers.scenes import scene_with

import warp_abtree as ab
from warp_abtree.interop.robot import check, robot
from warp_abtree.interop.robot.description import Description, RobotFrame


@pytest.fixture
def arm(device):
    return ab.Robot(described_arm(), device, mounted=["base"])


def test_forward_kinematics_is_a_product_of_matrices(arm):
    rows = random_configurations(300)
    rows[:5, 0] = np.array([0.0, -1, 1, 2, -2]) * np.pi / 4
    expected = np.array([pose_frames(arm.description, row) for row in rows])
    np.testing.assert_allclose(arm.forward(rows).numpy(), expected, atol=1e-13)
    large = np.array([[1e6, 0, 0, 0], [-1048575.3, 0, 0, 0]])
    turned = np.array([pose_frames(arm.description, row) for row in large])
    np.testing.assert_allclose(arm.forward(large, limits=False).numpy(), turned, atol=1e-13)


def test_beyond_ends_the_search(arm):
    rows = random_configurations(100, seed=2)
    whole, part = (arm.check(rows, AROUND, output="distance", beyond=d) for d in (None, 0.05))
    near = whole["distance"] <= 0.05
    assert 5 < near.sum() < 95
    for name in ("distance", "points", "faces", "pair"):
        np.testing.assert_array_equal(part[name][near], whole[name][near])
    assert np.isinf(part["distance"][~near]).all() and (part["pair"][~near] == -1).all()


def test_surroundings_are_a_scene_with_bits_lods_and_solids(arm, device):
    shell = ab.Model.load(trimesh.creation.icosphere(subdivisions=2, radius=0.3))
    coarse, solid = {"lod": RING.lod_for(fraction=0.2)}, (shell, (0.4, 0.2, 0.7, 0, 0, 0, 1), {"solid": True})
    aside = {"collision_group": 2, "collision_mask": 2}
    scene = scene_with(device, (*AROUND[0], coarse), solid, (*AROUND[1], aside))
    rows = random_configurations(60, seed=3)

    def expected():
        one = ab.Scene(device)
        one.add_many(arm.models, np.tile(STILL, (len(arm.models), 1)))
        one.add(RING, lod=scene.lods[0])
        one.add(shell, solid=True)
        moving = [k for k in range(len(arm.models)) if arm.link_names[arm.model_link[k]] != "base"]
        pairs = [*arm.pairs.tolist(), *[(k, len(arm.models) + w) for k in moving for w in (0, 1)]]
        hits = []
        placed = scene.batch().objects.pool
        for row in rows:
            matrices = np.tile(np.eye(4), (len(arm.models) + 2, 1, 1))
            matrices[:-2] = pose_frames(arm.description, row)[arm.model_link]
            matrices[-2:, :3, :3], matrices[-2:, :3, 3] = placed.rotation.numpy()[:2], placed.position.numpy()[:2]
            one.set_poses(matrices)
            hits.append(one.intersect(pairs).any.any())
        return np.array(hits)

    first = arm.check(rows, scene)
    np.testing.assert_array_equal(first, expected())
    assert not np.array_equal(first, arm.check(rows, [(RING, AROUND[0][1]), (shell, (0.4, 0.2, 0.7, 0, 0, 0, 1))]))
    scene.set_poses(np.array([[0.2, 0, 0.6, 0, 0, 0, 1], [-0.3, 0, 0.9, 0, 0, 0, 1], AROUND[1][1]]))
    second = arm.check(rows, scene)
    np.testing.assert_array_equal(second, expected())
    assert not np.array_equal(first, second)
    scene.set_lods([RING.lod_max, shell.lod_max, ROOF.lod_max])
    np.testing.assert_array_equal(arm.check(rows, scene), expected())


def test_chunks_and_small_buffers_change_nothing(arm, monkeypatch):
    rows = random_configurations(50, seed=4)
    whole = [arm.check(rows, AROUND, output=output) for output in ("any", "distance")]
    monkeypatch.setattr(robot, "ROOMS", {"cpu": (7,), "cuda": (7,)})
    monkeypatch.setattr(check, "PAIRS_GUESS", 0)
    for output, expected in zip(("any", "distance"), whole):
        np.testing.assert_array_equal(arm.check(rows, AROUND, output=output), expected)


def test_pairs_and_mounted_links_may_be_set(arm, device):
    rows = random_configurations(50, seed=5)
    alone, around, pairs = arm.check(rows), arm.check(rows, AROUND), arm.pairs
    assert 0 < alone.sum() < around.sum()
    arm.pairs = pairs[:0]
    assert not arm.check(rows).any() and arm.check_edges(rows, rows)["clear"].all()
    arm.mounted = range(len(arm.link_names))
    assert not arm.check(rows, AROUND).any()
    arm.pairs, arm.mounted = pairs[:, ::-1].tolist(), [0]
    np.testing.assert_array_equal(arm.check(rows), alone)
    np.testing.assert_array_equal(arm.check(rows, AROUND), around)
    for name, value, message in (
        ("pairs", [(0, 9)], "pair 0 is .0, 9."),
        ("pairs", [(1, 1)], "with itself"),
        ("mounted", ["base"], "mounted 'base' is not a whole number"),
    ):
        other = copy.copy(arm)
        setattr(other, name, value)
        refused(ValueError, message, other.check, rows, AROUND)


def test_a_query_is_captured_and_says_when_room_was_short(arm, device, monkeypatch):
    rows = random_configurations(20, seed=6)
    expected = arm.check(rows, AROUND)
    query = arm.query(AROUND, room=20)
    refused(RuntimeError, "nothing was launched", query.check)
    query.launch()
    query.check()
    replay = captured(query)
    query.configurations.assign(rows)
    replay()
    query.check()
    np.testing.assert_array_equal(query.hit.numpy() != 0, expected)
    monkeypatch.setattr(check, "PAIRS_GUESS", 0)
    short = arm.query(AROUND, output="distance", room=20)
    short.configurations.assign(rows)
    short.launch()
    refused(ab.CapacityError, "launch again", short.check)
    short.launch()
    short.check()
    np.testing.assert_array_equal(short.nearest.distance.numpy() == 0, expected)


@pytest.mark.parametrize(
    "bad, message",
    [
        (np.zeros((3, 3)), r"shape \(3, 3\), not \(c, 4\)"),
        (np.zeros(3), r"shape \(3,\), not \(c, 4\) or \(4,\)"),
        (np.float64(0.0), r"shape \(\)"),
        ([[0, 0, 0, 0], [0, np.nan, 0, 0]], "configuration 1 has nan for joint 'bend', no finite number"),
        ([[0, 0, 0, 0], [0, 3, 0, 0]], "configuration 1 has 3 for joint 'bend', outside -2.8 .. 2.8"),
        ("x", "configurations"),
    ],
)
def test_bad_configurations_are_refused(arm, bad, message):
    for call in (arm.check, arm.forward):
        refused(ValueError, message, call, bad)


def test_limits_hold_to_within_rounding(arm, device):
    arm.description.joints |= {"bend": (-2.8718, -0.0698), "swing": (-np.inf, 2.5)}
    arm = ab.Robot(arm.description, device)
    low, high = np.array(np.maximum(arm.limits, -9), np.float32).T
    inside = [low, high, low + np.float32(1) * (high - low), np.nextafter(high, np.float32(99))]
    assert ((inside[2] > high) & (high > arm.limits[:, 1])).any()
    for taken in (np.array, list, lambda rows: np.array(rows, np.float64), lambda rows: np.array(rows).tolist()):
        poses = arm.forward(taken(inside)).numpy()
        np.testing.assert_array_equal(poses, arm.forward(np.array(inside, np.float64), limits=False).numpy())
    on_device = wp.array(np.array(inside), dtype=wp.float32, device=device)
    assert len(arm.check(wp.zeros((3, 4), dtype=wp.int32, device=device), limits=False)) == 3
    assert len(arm.check(on_device)) == len(arm.check_edges(inside, inside)) == 4
    arm.exclude_meeting(high)
    refused(ValueError, r"has 3 for joint 'swing', outside -inf .. 2.5 ", arm.check, [[0, -1, 0, 3]])
    low, high = np.maximum(arm.limits, -9).T
    spread = low + 1.0 * (high - low)
    assert (spread > arm.limits[:, 1]).any() and len(arm.check([spread, np.nextafter(high, 9)])) == 2
    for beyond in (np.float32(0.1) + np.float32(4e-8), 0.1 * (1 + 2.0**-50)):
        said = r"configuration 1 has (\S+) for joint 'grip', outside 0 .. (\S+) "
        told = re.search(said, str(refused(ValueError, said, arm.check, [[0, -1, 0, 0], [0, -1, beyond, 0]])))
        assert [float(number) for number in told.groups()] == [beyond, 0.1]


def test_a_robot_without_joints_is_asked_like_any_other(device):
    cup = ab.Robot(described_chain(trimesh.creation.box()), device)
    box = ab.Model.load(trimesh.creation.box())
    for world, far in ((box, 0.0), ([(box, (9, 0, 0, 0, 0, 0, 1))], 8.0), (None, np.inf)):
        for rows in (np.empty((3, 0)), np.empty((0, 0), np.float32), np.empty((300, 0))):
            assert cup.check(rows, world).tolist() == [far == 0] * len(rows)
            assert cup.check(rows, world, output="distance")["distance"].tolist() == [far] * len(rows)
            edges = cup.check_edges(rows, rows, world)
            assert edges.tolist() == [(float(far > 0), far > 0, False)] * len(rows)
            assert cup.forward(rows).shape == (len(rows), 1)
        for output in ("any", "distance"):
            query = cup.query(world, output, room=2)
            query.launch()
            query.check()
            assert query.hit.numpy().tolist() == [far == 0] * 2
            assert output == "any" or query.nearest.distance.numpy().tolist() == [far] * 2


def test_a_mounted_link_without_a_mesh_takes_those_fixed_to_it(device):
    """A world, a base without a mesh, two plates fixed to it, and what turns on them; a frame that turns alone."""
    description = described_arm()
    fixed = [RobotFrame(-1, np.eye(4)), RobotFrame(0, np.eye(4))]
    frames = [*fixed, *[replace(f, parent=f.parent + 2 if f.parent >= 0 else 1) for f in description.frames]]
    names = {"world": 0, "stand": 1, **{name: k + 2 for name, k in description.links.items()}, "eye": len(frames)}
    frames.append(RobotFrame(len(frames) - 1, np.eye(4), "revolute", (0, 0, 1), "turn"))
    order = list(names)
    parts = [replace(part, link=order.index(list(description.links)[part.link])) for part in description.parts]
    parts.append(replace(parts[0], link=order.index("stand")))
    made = Description(frames, description.joints, names, parts, description.excluded)
    for mounted, expected in (
        (["world"], {"world", "stand", "base"}),
        (["stand"], {"stand"}),
        (["base", "world"], {"world", "stand", "base"}),
        (["flange"], {"fore", "flange"}),
        ([], set()),
    ):
        robot = ab.Robot(made, device, mounted)
        assert {robot.link_names[k] for k in robot.mounted} == expected
    # Nothing but the stand and the base is where the ground is.
    ground = [(ab.Model.load(trimesh.creation.box((1, 1, 0.01))), (0, 0, -0.1, 0, 0, 0, 1))]
    rows = np.array([[0.0, 0, 0.05, 0]])
    assert ab.Robot(made, device, ["base"]).check(rows, ground)[0]
    assert not ab.Robot(made, device, ["world"]).check(rows, ground)[0]
    refused(ValueError, "mounted: no mesh is fixed to the link .eye.", ab.Robot, made, device, ["eye"])


def test_a_robot_is_copied_and_pickled(arm):
    rows = random_configurations(60, seed=8)
    arm.exclude_meeting(rows[np.flatnonzero(arm.check(rows))[0]])
    arm.link_padding = {"fore": 0.02}
    expected = arm.check(rows, AROUND)
    for other in (copy.copy(arm), copy.deepcopy(arm), pickle.loads(pickle.dumps(arm))):
        np.testing.assert_array_equal(other.check(rows, AROUND), expected)
        assert other.pairs.tolist() == arm.pairs.tolist() and other.mounted == arm.mounted
        assert other.link_padding == arm.link_padding
    for make in (copy.copy, copy.deepcopy, pickle.dumps):
        refused(TypeError, "this RobotQuery holds device memory", make, arm.query(AROUND, room=1))


def test_bad_options_are_refused(arm, device):
    rows = np.zeros((1, 4))
    other = scene_with(device, *[(*AROUND[0], {"world": world}) for world in (0, 1)])
    for call, error, message in (
        (lambda: arm.check(rows, output="faces"), ValueError, "neither 'any' nor 'distance'"),
        (lambda: arm.check(rows, beyond=1.0), ValueError, "beyond means nothing"),
        (lambda: arm.check(rows, [(RING, (0, 0, 0, 0, 0, 0, 2))]), ValueError, "world: pose 0"),
        (lambda: arm.check(rows, ["ring"]), TypeError, "world: entry 0"),
        (lambda: arm.check(rows, [trimesh.creation.box()]), TypeError, "world: entry 0 is neither"),
        (lambda: arm.check(rows, 3), TypeError, "world: a int"),
        (lambda: arm.check(rows, other), ValueError, "several worlds"),
        (lambda: arm.check_edges(rows, rows[:0]), ValueError, "ends: 0 given for 1"),
        (lambda: arm.check_edges(rows, rows, tolerance=0), ValueError, "tolerance"),
        (lambda: ab.Robot(described_arm(), device, mounted=["foot"]), ValueError, "no link 'foot'"),
        (lambda: ab.Robot(described_arm(), device, mounted="base"), TypeError, "'base' is a name"),
        (lambda: ab.Robot(described_arm(), device, mounted=None), TypeError, "mounted: None is a NoneType"),
    ):
        refused(error, message, call)
    described_arm_without_parts = described_arm()
    described_arm_without_parts.parts = []
    refused(ValueError, "no link with a mesh", ab.Robot, described_arm_without_parts, device)
    assert arm.check(np.empty((0, 4))).shape == (0,) and len(arm.check_edges(rows[:0], rows[:0])) == 0
    assert arm.check(rows + [0, 3, 0, 0], limits=False).shape == (1,)
