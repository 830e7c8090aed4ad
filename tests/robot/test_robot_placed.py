"""Base poses, locked joints, one configuration or many, and joints of several values, against SciPy, MuJoCo and FCL."""

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers import refused
from helpers.questions import to_matrix
from helpers.robots import (
    AROUND,
    MJCF,
    URDF,
    InFcl,
    asked_pairs,
    described_arm,
    pose_frames,
    random_configurations,
    write_arm,
)
from oracles.peers import STILL
from scipy.spatial.transform import Rotation

import warp_abtree as ab

BASE = (0.3, -0.2, 0.1, *Rotation.from_rotvec((0.2, -0.5, 1.1)).as_quat())


def matrix_of(pose):
    return to_matrix(Rotation.from_quat(pose[3:]).as_matrix(), pose[:3])


@pytest.fixture
def arm(device):
    return ab.Robot(described_arm(), device, mounted=["base"])


@pytest.mark.parametrize("name, text, extra", [("arm.urdf", URDF, "yourdfpy"), ("arm.xml", MJCF, "mujoco")])
def test_a_base_moves_the_robot_in_the_world(name, text, extra, tmp_path, device):
    pytest.importorskip(extra)
    path = write_arm(tmp_path, text, name)
    still, base = ab.Robot.load(path, device=device), matrix_of(BASE)
    rows = random_configurations(40, still.limits, seed=1)
    expected, moved = base @ still.forward(rows).numpy(), [(model, base @ matrix_of(pose)) for model, pose in AROUND]
    rounded = base.astype(np.float32)  # rigid within 1e-6 alone
    for given, tolerance in ((BASE, 1e-14), (base, 1e-14), (rounded, 1e-6)):
        placed = ab.Robot.load(path, device=device, base=given)
        np.testing.assert_allclose(placed.forward(rows).numpy(), expected, atol=tolerance)
        turned = placed.forward(rows[0]).numpy()[:, :3, :3]
        np.testing.assert_allclose(turned @ turned.transpose(0, 2, 1), [np.eye(3)] * len(turned), atol=1e-14)
    hit = still.check(rows, AROUND)
    assert 3 < hit.sum() < 37
    np.testing.assert_array_equal(placed.check(rows, moved), hit)
    assert not np.array_equal(placed.check(rows, AROUND), hit)
    asked = (still, AROUND), (placed, moved)
    times = [robot.check_edges(rows[:9], rows[1:10], world)["time"] for robot, world in asked]
    np.testing.assert_allclose(*times, atol=2e-3)
    for bad, message in (
        ((0, 0, 0), "base: shape"),
        ((0, 0, 0, 0, 0, 0, 2), "base: pose 0"),
        (2 * base, "base: matrix 0"),
    ):
        refused(ValueError, message, ab.Robot.load, path, device=device, base=bad)


def test_locked_joints_stand_at_their_values(tmp_path, device):
    pytest.importorskip("yourdfpy")
    path = write_arm(tmp_path, URDF, "arm.urdf")
    whole = ab.Robot.load(path, device=device)
    at = {"grip": np.float32(0.1), "turn": 0.7}  # rounded up: within the limit of 0.1 all the same
    locked = ab.Robot.load(path, device=device, locked=at, neutral=[0.0])
    assert locked.joint_names == ("bend",) and locked.limits.tolist() == [[-2.8, 2.8]]
    whole.exclude_meeting([0.7, 0, at["grip"]])
    assert locked.pairs.tolist() == whole.pairs.tolist() and len(locked.pairs)
    rows = random_configurations(60, locked.limits, seed=2)
    full = np.column_stack([np.full(60, 0.7), rows[:, 0], np.full(60, at["grip"])])
    np.testing.assert_array_equal(locked.forward(rows).numpy(), whole.forward(full).numpy())
    hit = whole.check(full, AROUND)
    assert 3 < hit.sum() < 57
    np.testing.assert_array_equal(locked.check(rows, AROUND), hit)
    edges = locked.check_edges(rows[:6], rows[1:7], AROUND)
    np.testing.assert_array_equal(edges, whole.check_edges(full[:6], full[1:7], AROUND))
    still = ab.Robot.load(path, device=device, locked=at | {"bend": 1.0})
    expected = whole.check([0.7, 1.0, at["grip"]], AROUND)
    assert still.joint_names == () and bool(still.check([], AROUND)) == bool(expected)
    for bad, kind, message in (
        ({"follow": 0.0}, ValueError, "locked: a configuration has no joint 'follow'"),
        ({"mount": 0.0}, ValueError, "no joint 'mount'"),
        ({"bend": 2.9}, ValueError, r"locked: 2.9 for joint 'bend', outside -2.8 .. 2.8$"),
        ({"bend": np.nan}, ValueError, "locked joint 'bend': nan is not a finite number"),
        ({"bend": [0, 1]}, ValueError, "locked joint 'bend'"),
        ({"turn": 2.0**21}, ValueError, "locked: 2097152 for joint 'turn', no finite number within 1048576$"),
        (["bend"], TypeError, "locked: a list is no dict"),
    ):
        refused(kind, message, ab.Robot.load, path, device=device, locked=bad)


def test_one_configuration_is_asked_as_one_of_many(arm, device):
    rows = random_configurations(6, seed=3)
    on_device = wp.array(rows[0], dtype=wp.float64, device=device)
    hit, far = arm.check(rows, AROUND), arm.check(rows, AROUND, output="distance")
    edges, poses = arm.check_edges(rows, rows[::-1], AROUND), arm.forward(rows).numpy()
    for k, row in enumerate(rows):
        for given in (row, row.tolist(), *([on_device] if k == 0 else [])):
            assert arm.check(given, AROUND).shape == () and arm.check(given, AROUND) == hit[k]
            np.testing.assert_array_equal(arm.check(given, AROUND, output="distance"), far[k])
            np.testing.assert_array_equal(arm.forward(given).numpy(), poses[k])
            assert arm.check_edges(given, rows[-1 - k], AROUND) == edges[k]
    assert 0 < hit.sum() < 6 and arm.check(rows[:1]).shape == arm.check_edges(rows[0], rows[:1]).shape == (1,)
    matrices = pose_frames(arm.description, rows[0])
    np.testing.assert_allclose(arm.forward(rows[0]).numpy(), matrices, atol=1e-13)


def test_a_robot_is_added_to_a_scene_where_it_stands(device):
    arm, rows = ab.Robot(described_arm(), device), random_configurations(30, seed=4)
    found = []
    for row in rows:
        scene = ab.Scene(device)
        scene.add(*AROUND[0])
        assert arm.add_to(scene, row).tolist() == [1, 2, 3, 4, 5, 6]
        assert [scene.name(i) for i in range(1, 7)] == ["base", "upper", "fore", "left", "right", "flap"]
        found.append(scene.intersect().any.any())
    assert 3 < sum(found) < 27
    np.testing.assert_array_equal(found, arm.check(rows, AROUND[:1]))
    placed = ab.to_trimesh(scene, names=["ring", *map(scene.name, range(1, 7))])
    for part, matrix in zip(arm.description.parts, pose_frames(arm.description, rows[-1])[arm.model_link]):
        pose, geometry = placed.graph[arm.link_names[part.link]]
        found = trimesh.transform_points(placed.geometry[geometry].vertices, pose)
        posed = trimesh.transform_points(part.mesh.vertices, matrix)
        np.testing.assert_allclose([found.min(0), found.max(0)], [posed.min(0), posed.max(0)], atol=1e-12)
    for call, kind, message in (
        (lambda: arm.add_to([], rows[0]), TypeError, "a list is no Scene"),
        (lambda: arm.add_to(scene, rows), ValueError, r"30 configurations, not one of shape \(4,\)"),
        (lambda: arm.add_to(scene, [0, 9, 0, 0]), ValueError, "9 for joint 'bend'"),
    ):
        refused(kind, message, call)
    assert scene.object_count == 7


TURNED = Rotation.from_euler("xyz", (0.3, -0.2, 0.7)).as_matrix()
WALL = ab.Model.load(trimesh.creation.box((0.02, 4, 4)))


def load(folder, kind, axis, device):
    """Return the arm of `URDF` with its first joint of a kind, off the origin of the base."""
    pytest.importorskip("yourdfpy")
    text = URDF.replace('name="turn" type="continuous"', f'name="turn" type="{kind}"')
    text = text.replace('<origin xyz="0 0 0.1"/>', '<origin xyz="0.5 0 0.1" rpy="0.3 -0.2 0.7"/>')
    text = text.replace('<axis xyz="0 0 2"/>', f'<axis xyz="{axis}"/>' if axis else "")
    return ab.Robot.load(write_arm(folder, text, "arm.urdf"), device=device)


PLANES = {  # axis of a planar joint, and its x and y
    "0 0 2": ((1, 0, 0), (0, 1, 0)),
    "0 0 -1": ((1, 0, 0), (0, -1, 0)),
    "": ((0, 1, 0), (0, 0, 1)),  # URDF's own: x
    "0 3 0": ((0, 0, 1), (1, 0, 0)),
    "3 4 0": ((0, 0, 1), (0.8, -0.6, 0)),
    "2 1 2": (np.array((-1, 4, -1)) / 18**0.5, np.array((-1, 0, 1)) / 2**0.5),
}


@pytest.mark.parametrize("axis", PLANES)
def test_a_planar_joint_slides_in_a_plane_and_turns(axis, tmp_path, device):
    arm, (x, y) = load(tmp_path, "planar", axis, device), np.array(PLANES[axis], float)
    assert arm.joint_names == ("turn/x", "turn/y", "turn/angle", "bend", "grip")
    assert np.isinf(arm.limits[:3]).all() and np.isfinite(arm.limits[3:]).all()
    row = [0.4, -1.5, 2.1, 0.0, 0.0]
    assert frozenset(("base", "upper")) not in asked_pairs(arm)
    upper = arm.forward(row).numpy()[arm.link_names.index("upper")]
    np.testing.assert_allclose(upper[:3, 3], [0.5, 0, 0.1] + TURNED @ (0.4 * x - 1.5 * y), atol=1e-13)
    turn = Rotation.from_rotvec(2.1 * np.cross(x, y)).as_matrix()
    np.testing.assert_allclose(upper[:3, :3], TURNED @ turn, atol=1e-13)


def test_a_floating_joint_has_xyz_and_rpy(tmp_path, device):
    arm = load(tmp_path, "floating", "0 0 0", device)
    names = [f"turn/{name}" for name in ("x", "y", "z", "roll", "pitch", "yaw")]
    assert arm.joint_names == (*names, "bend", "grip") and np.isinf(arm.limits[:6]).all()
    assert frozenset(("base", "upper")) in asked_pairs(arm)  # which no joint holds in place
    limits = [*[(-1, 1)] * 3, *[(-4, 4)] * 3, *arm.limits[6:]]
    rows = random_configurations(80, limits, seed=1)
    base, upper = arm.link_names.index("base"), arm.link_names.index("upper")
    expected = np.tile(np.eye(4), (80, 1, 1))
    expected[:, :3, 3] = [0.5, 0, 0.1] + rows[:, :3] @ TURNED.T
    expected[:, :3, :3] = TURNED @ Rotation.from_euler("xyz", rows[:, 3:6]).as_matrix()  # about fixed axes, as URDF
    poses = arm.forward(rows).numpy()
    np.testing.assert_allclose(poses[:, upper], expected, atol=1e-13)
    np.testing.assert_array_equal(poses[:, base], np.tile(np.eye(4), (80, 1, 1)))
    arm.mounted = [base]
    in_fcl = InFcl(arm, wall=(WALL, STILL))
    hit = [min(in_fcl.distances(matrices).values()) == 0 for matrices in poses]
    assert 10 < sum(hit) < 70
    np.testing.assert_array_equal(arm.check(rows, WALL), hit)
    starts, ends = rows[:20], rows[:20] + 0.2 * (rows[20:40] - rows[:20])
    edges = arm.check_edges(starts, ends, WALL, tolerance=1e-3)
    sampled = starts[:, None] + np.linspace(0, 1, 60)[:, None] * (ends - starts)[:, None]
    met = arm.check(sampled.reshape(-1, 8), WALL).reshape(20, 60)
    assert 3 < edges["clear"].sum() < 17 and not met[edges["clear"]].any()
    assert not (met & (np.linspace(0, 1, 60) < edges["time"][:, None])).any()


def test_a_free_joint_is_the_pose_of_its_body_in_the_world(tmp_path, device):
    mujoco = pytest.importorskip("mujoco")
    text = MJCF.replace('<body name="base">', '<body name="base" pos="1 2 3" euler="1 0 0"><freejoint name="loose"/>')
    rock = '<worldbody><geom type="box" size="0.1 0.1 0.1"/>'
    visual = ab.Robot.load(write_arm(tmp_path, text.replace("<worldbody>", rock), "arm.xml"), "visual", device)
    assert frozenset(("world", "base")) in asked_pairs(visual)
    path = write_arm(tmp_path, text, "arm.xml")
    base = np.eye(4)
    base[:3, :3], base[:3, 3] = TURNED, (0.1, 0.2, 0.3)
    arm, placed = ab.Robot.load(path, device=device), ab.Robot.load(path, device=device, base=base)
    names = [f"loose/{name}" for name in ("x", "y", "z", "roll", "pitch", "yaw")]
    assert arm.joint_names == (*names, "turn", "lean", "bend", "grip")
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    rows = random_configurations(30, [*[(-2, 2)] * 6, *arm.limits[6:]], seed=2)
    for row, poses, moved in zip(rows, arm.forward(rows).numpy(), placed.forward(rows).numpy()):
        turn = Rotation.from_euler("xyz", row[3:6]).as_quat()
        data.qpos[:] = [*row[:3], turn[3], *turn[:3], *row[6:], -0.04 - row[9]]
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(poses[:, :3, 3], data.xpos, atol=1e-13)
        np.testing.assert_allclose(poses[:, :3, :3].reshape(-1, 9), data.xmat, atol=1e-13)
        np.testing.assert_allclose(moved, base @ poses, atol=1e-13)


def test_values_of_a_joint_are_locked_and_named(tmp_path, device):
    arm = load(tmp_path, "floating", "0 0 1", device)
    path, at = tmp_path / "arm.urdf", {"turn/x": 0.5, "turn/yaw": 1.0}
    locked = ab.Robot.load(path, device=device, locked=at)
    assert locked.joint_names == ("turn/y", "turn/z", "turn/roll", "turn/pitch", "bend", "grip")
    rows = random_configurations(20, [(-1, 1)] * 4 + arm.limits[6:].tolist(), seed=3)
    full = np.insert(np.insert(rows, 0, 0.5, axis=1), 5, 1.0, axis=1)
    np.testing.assert_array_equal(locked.forward(rows).numpy(), arm.forward(full).numpy())
    refused(ValueError, "no joint 'turn'", ab.Robot.load, path, device=device, locked={"turn": 0.0})
    path.write_text(path.read_text().replace('"bend"', '"turn/x"'))
    refused(ValueError, "2 joints have the name 'turn/x'", ab.Robot.load, path, device=device)
