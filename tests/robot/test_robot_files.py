"""Robots of URDF and MJCF files: kinematics as yourdfpy and MuJoCo have it, pairs, meshes, and refused files."""

import sys

import numpy as np
import pytest
from helpers import refused
from helpers.robots import MJCF, URDF, asked_pairs, pairs_of, random_configurations, write_arm

import warp_abtree as ab

BEND_LIMIT, GRIP_LIMIT = (
    f'<limit lower="{low}" upper="{high}" effort="1" velocity="1"/>' for low, high in ((-2.8, 2.8), (0, 0.1))
)
FLEX = """<flexcomp name="rag" type="grid" count="3 3 1" spacing="1 1 1" dim="2"><edge equality="true"/></flexcomp>"""
SRDF = '<robot name="arm"><disable_collisions link1="{}" link2="fore" reason="Never"/></robot>'


@pytest.fixture
def urdf(tmp_path):
    pytest.importorskip("yourdfpy")
    return write_arm(tmp_path, URDF, "arm.urdf")


@pytest.fixture
def mjcf(tmp_path):
    pytest.importorskip("mujoco")
    return write_arm(tmp_path, MJCF, "arm.xml")


def test_urdf_poses_are_those_of_yourdfpy(urdf, device):
    import yourdfpy

    arm = ab.Robot.load(urdf, device=device)
    assert arm.joint_names == ("turn", "bend", "grip")
    np.testing.assert_array_equal(arm.limits, [[-np.inf, np.inf], [-2.8, 2.8], [0, 0.1]])
    other = yourdfpy.URDF.load(str(urdf), load_meshes=False)
    rows = random_configurations(100, arm.limits)
    for row, poses in zip(rows, arm.forward(rows).numpy()):
        other.update_cfg(dict(zip(arm.joint_names, row)))
        expected = [other.get_transform(name) for name in arm.link_names]
        np.testing.assert_allclose(poses, expected, atol=1e-14)


def test_mjcf_poses_are_those_of_mujoco(mjcf, device):
    import mujoco

    arm = ab.Robot.load(mjcf, device=device)
    assert arm.joint_names == ("turn", "lean", "bend", "grip")
    model = mujoco.MjModel.from_xml_path(str(mjcf))
    data = mujoco.MjData(model)
    rows = random_configurations(100, arm.limits)
    for row, poses in zip(rows, arm.forward(rows).numpy()):
        data.qpos[:] = [*row, -0.04 - row[3]]
        mujoco.mj_kinematics(model, data)
        bodies = [data.body(name).id for name in arm.link_names]
        np.testing.assert_allclose(poses[:, :3, :3].reshape(-1, 9), data.xmat[bodies], atol=1e-14)
        np.testing.assert_allclose(poses[:, :3, 3], data.xpos[bodies], atol=1e-14)


def test_urdf_meshes_pairs_and_srdf(urdf, tmp_path):
    arm = ab.Robot.load(urdf, device="cpu")
    upper = arm.models[1].mesh_at(arm.models[1].lod_max)[0]
    assert arm.models[1].face_count == 24  # a box, and a box in a file that is scaled and moved
    np.testing.assert_allclose([upper.min(0), upper.max(0)], [[-0.05, -0.04, 0.05], [0.05, 0.15, 0.55]], atol=1e-12)
    # The flange is rigidly joined to the forearm, so that fingers are neighbours of this.
    fingers = pairs_of("base left", "base right", "upper left", "upper right", "left right")
    assert asked_pairs(arm) == fingers | pairs_of("base fore")
    assert [arm.link_names[k] for k in ab.Robot.load(urdf, "visual", device="cpu").model_link] == ["upper"]
    (tmp_path / "arm.srdf").write_text(SRDF.format("base"), encoding="utf-8")
    assert asked_pairs(ab.Robot.load(urdf, device="cpu", srdf=tmp_path / "arm.srdf")) == fingers
    neutral = ab.Robot.load(urdf, device="cpu", neutral=[0, 0, 0.0])
    assert asked_pairs(neutral) == asked_pairs(arm) - pairs_of("left right")


def test_mjcf_meshes_and_pairs(mjcf):
    arm = ab.Robot.load(mjcf, device="cpu")
    upper = arm.models[1].mesh_at(arm.models[1].lod_max)[0]
    np.testing.assert_allclose([upper.min(0), upper.max(0)], [[-0.05, -0.04, 0.05], [0.05, 0.15, 0.55]], atol=1e-7)
    # The left finger has a part of other bits, which meets nothing.
    names = [arm.link_names[k] for k in arm.model_link]
    assert names == ["base", "upper", "fore", "left", "left", "right"] and not (arm.pairs == 4).any()
    pairs = pairs_of("base left", "base right", "upper left", "upper right", "left right")
    assert asked_pairs(arm) == pairs | pairs_of("base upper")  # the base stands still
    visual = ab.Robot.load(mjcf, "visual", device="cpu")
    assert asked_pairs(visual) == pairs
    assert visual.models[1].face_count > arm.models[1].face_count


def test_a_limit_that_urdf_leaves_out_is_zero(urdf):
    urdf.write_text(URDF.replace('lower="-2.8"', ""), encoding="utf-8")
    np.testing.assert_array_equal(ab.Robot.load(urdf, device="cpu").limits[1], [0, 2.8])


@pytest.mark.parametrize(
    "before, after, message",
    [
        ('type="continuous"', 'type="screw"', "joint 'turn' is screw; fixed, .*, planar, floating ones are supported"),
        ('"grip" type="prismatic"', '"grip" type="floating"', "'follow' mimics 'grip', which is none of one value"),
        ('"follow" type="prismatic"', '"follow" type="planar"', "joint 'follow' is planar, and mimics another"),
        ("package://arm/part.stl", "lost.stl", "link 'upper': no mesh file lost.stl"),
        ("package://arm/part.stl", "package://arm/lost.stl", "no mesh file package://arm/lost.stl"),
        ("package://arm/part.stl", "package://", "no mesh file package://$"),
        ("package://arm/part.stl", "package://arm", "no mesh file package://arm$"),
        ("package://arm/part.stl", r"C:\arm\part.stl", r"no mesh file C:\\arm\\part.stl$"),
        ('<mimic joint="grip"', '<mimic joint="gone"', "joint 'follow' mimics 'gone'"),
        ('<child link="fore"/>', '<child link="hand"/>', "joint 'bend': no link 'hand'"),
        ('<child link="left"/>', '<child link="fore"/>', "another joint moves link 'fore'"),
        ('<parent link="base"/>', '<parent link="left"/>', "link 'upper' hangs on itself"),
        ('xyz="0 0 2"', 'xyz="0 0 0"', "is no axis"),
        ('<robot name="arm">', "arm", "not read as URDF"),
        ("</robot>", "", r"arm.urdf: not read as URDF \(line \d+: "),  # yourdfpy would read what is there
        ('<box size="0.06 0.06 0.4"/>', "", r"not read as URDF \(line 10: a geometry has one shape\)"),
        ('<box size="0.06', '<sphere radius="1"/><box size="0.06', r"\(line 10: a geometry has one shape\)"),
        ('<link name="flange"/>', '<link name="flange"><collision/></link>', "line 12: a collision has one geometry"),
        (' size="0.06 0.06 0.4"', "", "an element lacks 'size'"),
        ('<robot name="arm">', '<robot name="arm" xmlns="urdf">', "its root is '{urdf}robot', not 'robot'"),
        ('lower="-2.8"', 'lower="2.9"', "joint 'bend': limits 2.9 .. 2.8 leave no value"),
        ('lower="-2.8"', 'lower="nan"', "joint 'bend': limits nan .. 2.8 leave no value"),
        (BEND_LIMIT, "", "joint 'bend' is revolute and has no limits; .*, or make it continuous$"),
        (BEND_LIMIT, '<limit effort="1" velocity="1"/>', "joint 'bend' is revolute and has no limits"),
        (GRIP_LIMIT, "", r"'grip' is prismatic and has no limits; .*\.\.>$"),
        ('size="0.08 0.08 0.5"', 'size="0.08 0.5"', "link 'upper': sizes .* are not 3"),
        ('radius="0.1" length', 'radius="-0.1" length', "link 'base': sizes .* are not 2"),
        ('radius="0.03"', 'radius="nan"', "link 'left': sizes .* are not 1"),
        ('radius="0.03"', 'radius="0"', "link 'left': a sphere has radius 0"),
        ('<link name="flange"/>', '<link name="base"/>', "2 links have the name 'base'"),
        ('<joint name="mount"', '<joint name="turn"', "2 joints have the name 'turn'"),
        ('multiplier="-1"', 'multiplier="nan"', "joint 'follow' mimics 'grip' by numbers that are not finite"),
        ('scale="2 1 1"', 'scale="2 1"', "link 'upper': scale .* of a mesh is not 3 finite numbers"),
        ('size="0.06 0.06 0.4"', 'size="0 0 0"', "urdf: link 'fore': .*no face has three distinct corners"),
    ],
)
def test_bad_urdf_is_refused(urdf, before, after, message):
    assert before in URDF
    urdf.write_text(URDF.replace(before, after), encoding="utf-8")
    refused(ValueError, message, ab.Robot.load, urdf, device="cpu")


@pytest.mark.parametrize(
    "before, after, message",
    [
        ('axis="0 1 0.2" range="-2.8 2.8"', 'type="ball"', "joint 'bend' is ball"),
        ('type="cylinder" size="0.1 0.1"', 'name="ground" type="plane" size="1 1 1"', "geom 'ground' is a plane"),
        ('polycoef="-0.04 -1 0 0 0"', 'polycoef="0 -1 1 0 0"', "follows another by a curve"),
        ("</equality>", '<joint joint1="follow" joint2="turn"/></equality>', "joint 'follow' follows two others"),
        ("</body></worldbody>", FLEX + "</body></worldbody>", "flex 'rag' may deform"),
        ('file="part.stl"', 'file="lost.stl"', "lost.stl"),
        ('<body name="flange" pos="0 0 0.45">', '<body><body name="body 4"/>', "2 bodies have the name 'body 4'"),
        ('<joint name="turn" axis="0 0 1"/>', '<joint/><joint name="joint 0"/>', "2 joints have the name 'joint 0'"),
    ],
)
def test_bad_mjcf_is_refused(mjcf, before, after, message, monkeypatch):
    monkeypatch.chdir(mjcf.parent)  # where MuJoCo leaves its log
    assert before in MJCF
    mjcf.write_text(MJCF.replace(before, after), encoding="utf-8")
    refused(ValueError, message, ab.Robot.load, mjcf, device="cpu")


def test_formats_are_told_apart_and_a_geometry_without_meshes_is_named(urdf, mjcf, tmp_path):
    for source, name, message in (
        (mjcf, "other.urdf", "other.urdf: not read as URDF .its root is 'mujoco', not 'robot'"),
        (urdf, "other.xml", "other.xml: not read as MJCF .its root is 'robot', as of a URDF"),
    ):
        # A comment before the root counts for nothing.
        (tmp_path / name).write_text("<!-- <mujoco> <robot> -->" + source.read_text("utf-8"), encoding="utf-8")
        refused(ValueError, message, ab.Robot.load, tmp_path / name, device="cpu")
    urdf.write_text(
        '<robot name="r"><link name="l"><visual><geometry><sphere radius="1"/></geometry></visual></link></robot>'
    )
    mjcf.write_text('<mujoco><worldbody><geom size="1" contype="0" conaffinity="0"/></worldbody></mujoco>')
    for path in (urdf, mjcf):
        said = f"{path.name}: no link has a mesh of geometry='collision'; .* 'visual'"
        refused(ValueError, said, ab.Robot.load, path, device="cpu")
        assert len(ab.Robot.load(path, "visual", device="cpu").models) == 1


def test_names_that_are_not_in_utf_8_are_refused(tmp_path):
    pytest.importorskip("mujoco")
    text = '<mujoco><worldbody><body name="f\xfc\xdf"><joint/><geom size="1"/></body></worldbody></mujoco>'
    path = tmp_path / "arm.xml"
    path.write_text(text, encoding="utf-8")
    assert ab.Robot.load(path, device="cpu").link_names == ("world", "f\xfc\xdf")
    path = tmp_path / "latin.xml"
    path.write_text(text, encoding="latin-1")
    refused(ValueError, r"latin\.xml: a name is not in UTF-8", ab.Robot.load, path, device="cpu")


def test_joints_that_follow_followers_and_stand_off_are_those_of_mujoco(tmp_path, device, monkeypatch):
    mujoco = pytest.importorskip("mujoco")
    text = """<mujoco><worldbody><body name="one"><joint name="a" axis="0 0 1" pos=".1 0 0" ref="20"/>
    <joint name="b" type="slide" axis="1 0 0" pos="0 .2 0" ref=".1"/><joint name="c" axis="0 1 0"
    pos="0 .2 .3" ref="-15" range="-90 90"/><geom size=".1"/><body name="two" pos="0 0 .5">
    <joint name="d" axis="1 0 0" ref="10"/>
    <joint name="e" axis="1 1 0" pos=".1 .1 0" ref="5"/><geom size=".1"/></body></body></worldbody><equality>
    <joint joint1="d" joint2="c" polycoef=".1 -2 0 0 0"/><joint joint1="c" joint2="a" polycoef=".2 .5 0 0 0"/>
    <joint joint1="e" polycoef=".3 0 0 0 0"/></equality></mujoco>"""
    (tmp_path / "arm.xml").write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)  # where MuJoCo leaves its log
    arm, model = ab.Robot.load(tmp_path / "arm.xml", device=device), mujoco.MjModel.from_xml_string(text)
    assert arm.joint_names == ("a", "b") and np.isinf(arm.limits).all()
    data, start = mujoco.MjData(model), dict(zip("abcde", model.qpos0))
    rows = random_configurations(20, [(-1, 1), (-1, 1)])
    for (a, b), poses in zip(rows, arm.forward(rows).numpy()):
        moved = 0.2 + 0.5 * (a - start["a"])
        data.qpos[:] = a, b, start["c"] + moved, start["d"] + 0.1 - 2 * moved, start["e"] + 0.3
        mujoco.mj_forward(model, data)
        assert data.ne == 3 and np.abs(data.efc_pos[:3]).max() < 1e-12  # as MuJoCo's equalities want it
        np.testing.assert_allclose(poses[:, :3, 3], data.xpos, atol=1e-12)
        np.testing.assert_allclose(poses[:, :3, :3].reshape(-1, 9), data.xmat, atol=1e-12)


def test_joints_may_mimic_ones_that_mimic(urdf, device):
    added = """<link name="third"/><joint name="again" type="prismatic"><parent link="flange"/><child link="third"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1"/><mimic joint="follow" multiplier="-2" offset="0.3"/>
    </joint></robot>"""
    urdf.write_text(URDF.replace("</robot>", added), encoding="utf-8")
    arm = ab.Robot.load(urdf, device=device)
    poses = dict(zip(arm.link_names, arm.forward([[0, 0, 0.07]]).numpy()[0]))
    third = np.linalg.inv(poses["flange"]) @ poses["third"]
    np.testing.assert_allclose(third[:3, 3], [0, -2 * (-0.07 - 0.04) + 0.3, 0], atol=1e-14)


def test_links_may_stand_in_any_order(tmp_path):
    pytest.importorskip("yourdfpy")
    count = 1200  # deeper than Python's calls may nest
    ends = '<link name="l{}"><collision><geometry><sphere radius="0.01"/></geometry></collision></link>'
    links = [ends.format(0), *[f'<link name="l{k}"/>' for k in range(1, count)], ends.format(count)]
    joint = '<joint name="j{0}" type="{1}"><parent link="l{0}"/><child link="l{2}"/><origin xyz="0 0 0.1"/></joint>'
    joints = [joint.format(k, "continuous" if k == 500 else "fixed", k + 1) for k in range(count)]
    path = tmp_path / "chain.urdf"
    path.write_text(f'<robot name="chain">{"".join([*links, *joints][::-1])}</robot>', encoding="utf-8")
    poses = ab.Robot.load(path, device="cpu").forward([[np.pi / 2]]).numpy()[0]
    # Joints turn about x; links come as in the file, the last one first.
    np.testing.assert_allclose(poses[0, :3, 3], [0, -0.1 * (count - 501), 50.1], atol=1e-9)


def test_macros_that_were_not_expanded_are_named(urdf):
    macros = '<robot name="arm" xmlns:x="http://www.ros.org/wiki/xacro"><x:include filename="hand.xacro"/><xacro:hand/>'
    urdf.write_text(URDF.replace('<robot name="arm">', macros), encoding="utf-8")
    with pytest.warns(RuntimeWarning, match="arm.urdf: not read: elements xacro:include, xacro:hand; xacro") as caught:
        ab.Robot.load(urdf, device="cpu")
    assert len(caught) == 1 and caught[0].filename == __file__


def test_bad_paths_and_options_are_refused(urdf, tmp_path):
    (tmp_path / "arm.srdf").write_text(SRDF.format("elbow"), encoding="utf-8")
    for arguments, message in (
        ({"path": tmp_path / "none.urdf"}, "none.urdf: no such file"),
        ({"path": tmp_path / "part.stl"}, "a robot is a .urdf or .xml file"),
        ({"path": urdf, "geometry": "both"}, "geometry 'both'"),
        ({"path": urdf, "srdf": tmp_path / "no.srdf"}, "no.srdf: no such file"),
        ({"path": urdf, "srdf": tmp_path / "arm.srdf"}, r"names 'elbow', .* \(strict=False goes on\)"),
        ({"path": urdf, "neutral": [0, 0]}, r"shape \(2,\)"),
        ({"path": urdf, "device": "cuda:9"}, "no device 'cuda:9'"),
    ):
        refused(ValueError, message, ab.Robot.load, **arguments)


@pytest.mark.parametrize("name, library", [("arm.urdf", "yourdfpy"), ("arm.xml", "mujoco")])
def test_without_the_extra_there_is_one_line(name, library, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)
    said = r"^an? \w+ file needs the extra `robot`: pip install 'warp-abtree\[robot\]'$"
    refused(ImportError, said, ab.Robot.load, write_arm(tmp_path, URDF, name))
