"""Planar and floating joints of URDF, free ones of MJCF: poses by SciPy and MuJoCo, answers against FCL, edges."""

import numpy as np
import pytest
import trimesh
from helpers import refused
from helpers.robots import MJCF, URDF, InFcl, asked_pairs, random_configurations, write_arm
from oracles.peers import STILL
from scipy.spatial.transform import Rotation

import warp_abtree as ab

TURNED = Rotation.from_euler("xyz", (0.3, -0.2, 0.7)).as_matrix()
WALL = trimesh.creation.box((0.02, 4, 4))


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
    in_fcl = InFcl(arm, [(ab.Model.load(WALL), STILL)])
    hit = [in_fcl.ask(matrices)[0] for matrices in poses]
    assert 10 < sum(hit) < 70
    np.testing.assert_array_equal(arm.check(rows, ab.Model.load(WALL)), hit)
    starts, ends = rows[:20], rows[:20] + 0.2 * (rows[20:40] - rows[:20])
    edges = arm.check_edges(starts, ends, ab.Model.load(WALL), tolerance=1e-3)
    sampled = starts[:, None] + np.linspace(0, 1, 60)[:, None] * (ends - starts)[:, None]
    met = arm.check(sampled.reshape(-1, 8), ab.Model.load(WALL)).reshape(20, 60)
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
