"""Meshes of URDF files, and pairs of links with an SRDF file as MoveIt's matrix of allowed collisions has them."""

import gzip
import warnings
import zipfile

import numpy as np
import pytest
import trimesh
from helpers import refused
from helpers.robots import asked_pairs, pairs_of

import warp_abtree as ab

pytest.importorskip("yourdfpy")
ROBOT = """<robot name="r"><link name="l"><collision>{}<geometry><mesh filename="{}" {}/></geometry></collision></link>
{}</robot>"""
TURN = '<origin xyz="0 0 1" rpy="0 0 1.5707963267948966"/>'
BOX = trimesh.creation.box((1, 2, 3), trimesh.transformations.translation_matrix((2, 0.5, 0)))


def load(folder, file, options="", origin="", rest=""):
    """Return the link's mesh as trimesh has it."""
    (folder / "r.urdf").write_text(ROBOT.format(origin, file, options, rest), encoding="utf-8")
    return mesh_of(ab.Robot.load(folder / "r.urdf", device="cpu").models[0])


def mesh_of(model):
    return trimesh.Trimesh(*model.mesh_at(model.lod_max)[:2], process=False)


def write_dae(path, unit, node="", up="Z_UP"):
    """Write a box as trimesh does, with a unit, an axis and a transform of its node."""
    text = trimesh.exchange.dae.export_collada(BOX).decode()
    start, end = text.index("<asset"), text.index("</asset>")
    text = text[:start] + f"<asset>{unit}<up_axis>{up}</up_axis>" + text[end:]
    assert "<instance_geometry" in text
    text = text.replace("<instance_geometry", f"{node}<instance_geometry", 1)
    path.write_bytes(gzip.compress(text.encode()) if path.suffix == ".gz" else text.encode())


@pytest.mark.parametrize("scale", ["-1 1 1", "1 -2 1", "-1 -1 1", "-1 -1 -1", "2", "-2"])
@pytest.mark.parametrize("ending", ["stl", "obj", "ply", "dae"])
def test_mirrored_meshes_keep_their_outside(ending, scale, tmp_path):
    BOX.export(tmp_path / f"part.{ending}")
    found = load(tmp_path, f"part.{ending}", f'scale="{scale}"', TURN)
    by = np.ones(3) * np.array(scale.split(), float)
    corners = [BOX.bounds[[i, j, k], [0, 1, 2]] * by for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    expected = np.array([(-y, x, z + 1) for x, y, z in corners])
    np.testing.assert_allclose(found.bounds, [expected.min(0), expected.max(0)], atol=1e-6)
    np.testing.assert_allclose(found.volume, 6 * abs(by.prod()), rtol=1e-6)


@pytest.mark.parametrize(
    "unit, meters",
    [
        ("", 1),
        ('<unit name="meter"/>', 1),
        ('<unit meter="0.0254" name="inch"/>', 0.0254),
        ('<unit name="millimeter" meter="1e-3"/>', 0.001),
        ('<unit meter="1000"/>', 1000),
    ],
)
@pytest.mark.parametrize("name", ["part.dae", "part.DAE", "part.dae.gz"])
def test_collada_is_scaled_to_meters(name, unit, meters, tmp_path):
    write_dae(tmp_path / name, unit, up="Y_UP")
    found = load(tmp_path, name, 'scale="1 2 1"', TURN)
    low, high = BOX.bounds * meters
    expected = [(-2 * high[1], low[0], low[2] + 1), (-2 * low[1], high[0], high[2] + 1)]
    np.testing.assert_allclose(found.bounds, expected, atol=1e-6 * meters)
    # A mesh by itself keeps the numbers of its file.
    np.testing.assert_allclose(mesh_of(ab.Model.load(tmp_path / name)).bounds, BOX.bounds, rtol=1e-6)


@pytest.mark.parametrize("scale", ["1 1 1", "1 1 -1"])
def test_collada_nodes_may_be_mirrored(scale, tmp_path):
    write_dae(tmp_path / "part.dae", '<unit meter="0.5"/>', "<matrix>-2 0 0 3  0 1 0 0  0 0 1 0  0 0 0 1</matrix>")
    found = load(tmp_path, "part.dae", f'scale="{scale}"')
    np.testing.assert_allclose(found.bounds, [[-1, -0.25, -0.75], [0, 0.75, 0.75]], atol=1e-6)
    np.testing.assert_allclose(found.volume, 12 / 8, rtol=1e-6)


@pytest.mark.parametrize("unit", ["0", "-1", "nan", "inf", "inch"])
def test_units_that_are_none_are_refused(unit, tmp_path):
    write_dae(tmp_path / "part.dae", f'<unit meter="{unit}"/>')
    refused(ValueError, f"link 'l': part.dae has a unit of '{unit}' meters", load, tmp_path, "part.dae")
    with zipfile.ZipFile(tmp_path / "part.zae", "w") as archive:
        archive.write(tmp_path / "part.dae", "part.dae")
    refused(ValueError, r"link .l.: part\.zae is an archive; unpack the \.dae of it", load, tmp_path, "part.zae")


NAMES = """meshes/part.stl meshes\\part.stl package://arm/meshes/part.stl package://arm\\meshes\\part.stl
package:\\\\arm\\meshes\\part.stl package:///arm/meshes/part.stl model://arm/meshes/part.stl
file://{}/arm/meshes/part.stl file://{}/arm/%6Deshes/part.stl package://arm/meshes/p%61rt.stl {}/arm/meshes/part.stl"""


@pytest.mark.parametrize("name", [*NAMES.split(), " package://arm/meshes/part.stl "])
def test_files_are_found_by_all_ways_to_name_them(name, tmp_path, caplog):
    for package, size in (("arm", 1), ("hand", 2)):
        (tmp_path / package / "meshes").mkdir(parents=True)
        trimesh.creation.box((size, size, size)).export(tmp_path / package / "meshes" / "part.stl")
    (tmp_path / "arm" / "urdf").mkdir()
    assert load(tmp_path / "arm" / "urdf", name.format(tmp_path)).volume == pytest.approx(1)
    assert not caplog.records
    if name.strip().startswith("package:"):  # of the package that is named, not of the one at hand
        assert load(tmp_path / "arm" / "urdf", name.replace("arm", "hand")).volume == pytest.approx(8)
        assert load(tmp_path / "arm" / "urdf", name.replace("arm", "renamed")).volume == pytest.approx(1)


def test_what_joints_do_not_place_is_named(tmp_path):
    BOX.export(tmp_path / "part.stl")
    loops = '<drake:loop_joint name="bar"/><gazebo><joint name="ring" type="ball"/></gazebo>'
    with pytest.warns(RuntimeWarning, match="r.urdf: not enforced: joints 'bar', 'ring' of") as caught:
        load(tmp_path, "part.stl", rest=loops)
    assert len(caught) == 1
    with pytest.warns(RuntimeWarning, match="r.urdf: 'm', 'n' hang on no joint, and are placed where 'l' is"):
        load(tmp_path, "part.stl", rest='<link name="m"/><link name="n"/>')
    with warnings.catch_warnings(action="error"):
        refused(RuntimeWarning, "not enforced", load, tmp_path, "part.stl", rest=loops)
        others = '<gazebo reference="l"/><transmission name="t"><joint name="x"/></transmission>'
        load(tmp_path, "part.stl", rest=others)


LINKS = [f"l{k}" for k in range(5)]
LINK = '<link name="{}"><collision><geometry><box size="0.1 0.1 0.2"/></geometry></collision></link>'
JOINT = (
    '<joint name="j{1}" type="{0}"><parent link="l{1}"/><child link="l{2}"/><origin xyz="0 0 0.3"/>'
    '<axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
)
ALL = {frozenset((a, b)) for a in LINKS for b in LINKS if a < b}
# The last two links are fixed to one another: neighbours of neither are tested unless an SRDF says so.
JOINED = pairs_of("l0 l1", "l1 l2", "l2 l3", "l3 l4", "l2 l4")


@pytest.fixture
def load_pairs(tmp_path):
    kinds = "revolute", "revolute", "revolute", "fixed"
    joints = "".join(JOINT.format(kind, k, k + 1) for k, kind in enumerate(kinds))
    (tmp_path / "r.urdf").write_text(f'<robot name="r">{"".join(map(LINK.format, LINKS))}{joints}</robot>')

    def load_pairs(srdf, root="robot", **options):
        (tmp_path / "r.srdf").write_text(f'<{root} name="r">{srdf}</{root}>', encoding="utf-8")
        return asked_pairs(ab.Robot.load(tmp_path / "r.urdf", device="cpu", srdf=tmp_path / "r.srdf", **options))

    return load_pairs


def moveit_pairs(entries):
    """Return the pairs that are tested: a link's default, then entries of pairs, first enabled, then disabled ones."""
    default, matrix = set(), {}
    for tag, allowed in (("disable_default_collisions", None), ("enable_collisions", False), ("disable_collisions", 1)):
        for name, *links in entries:
            if name == tag:
                default |= set(links) if allowed is None else set()
                matrix |= {} if allowed is None else {frozenset(links): allowed}
    return {pair for pair in ALL if not matrix.get(pair, bool(pair & default) or pair in JOINED)}


def write(entries):
    keys = {1: ["link"], 2: ["link1", "link2"]}
    said = [" ".join(f'{key}="{link}"' for key, link in zip(keys[len(links)], links)) for _, *links in entries]
    return "".join(f"<{tag} {links}/>" for (tag, *_), links in zip(entries, said))


def test_pairs_are_those_of_moveit(load_pairs):
    assert load_pairs("") == ALL - JOINED
    rng, found = np.random.default_rng(0), []
    for _ in range(40):
        entries = [("disable_default_collisions", *rng.choice(LINKS, 1)) for _ in range(rng.integers(3))]
        for tag in ("enable_collisions", "disable_collisions"):
            entries += [(tag, *rng.choice(LINKS, 2, replace=False)) for _ in range(rng.integers(5))]
        rng.shuffle(entries)
        found.append(load_pairs(write(entries)))
        assert found[-1] == moveit_pairs(entries), entries
    assert any(pairs & JOINED for pairs in found) and any(ALL - JOINED - pairs for pairs in found)


def test_only_entries_of_the_robot_itself_count(load_pairs):
    assert load_pairs('<group name="g"><disable_collisions link1="l0" link2="l2"/></group>') == ALL - JOINED
    assert load_pairs('<disable_collisions link1=" l0 " link2="l2"/>') == ALL - JOINED - pairs_of("l0 l2")


def test_links_that_the_robot_lacks_are_refused_or_named(load_pairs):
    entries = '<disable_collisions link1="l0" link2="l2"/><disable_collisions link1="l0" link2="camera"/>'
    entries += '<enable_collisions link1="mast" link2="l1"/><disable_default_collisions link="camera"/>'
    refused(ValueError, r"disable_default_collisions names 'camera', .* \(strict=False goes on\)", load_pairs, entries)
    with pytest.warns(RuntimeWarning, match=r"r.srdf: what is said of 'camera', 'mast' is left out") as caught:
        assert load_pairs(entries, strict=False) == ALL - JOINED - pairs_of("l0 l2")
    assert len(caught) == 1 and caught[0].filename == __file__
    with warnings.catch_warnings(action="error"):
        load_pairs(write([("disable_collisions", "l0", "l2")]), strict=False)


def test_unknown_elements_are_named(load_pairs):
    with pytest.warns(RuntimeWarning, match="r.srdf: not read: elements disable_collision, hand$") as caught:
        assert load_pairs('<disable_collision link1="l0" link2="l2"/><hand/><hand/>') == ALL - JOINED
    assert len(caught) == 1 and caught[0].filename == __file__
    known = "group group_state end_effector virtual_joint passive_joint joint_property link_sphere_approximation"
    with warnings.catch_warnings(action="error"):
        load_pairs("<!-- none -->" + "".join(f"<{tag}/>" for tag in known.split()))


@pytest.mark.parametrize(
    "srdf, root, message",
    [
        ('<disable_collisions link1="l0"/>', "robot", "a disable_collisions without link2"),
        ("<disable_default_collisions/>", "robot", "a disable_default_collisions without link"),
        ("<enable_collisions", "robot", "not read as SRDF"),
        ("", "srdf", "not read as SRDF .its root is 'srdf', not 'robot'"),
    ],
)
def test_bad_srdf_is_refused(srdf, root, message, load_pairs):
    refused(ValueError, message, load_pairs, srdf, root, strict=False)


def test_an_srdf_goes_over_the_pairs_of_mjcf(tmp_path):
    pytest.importorskip("mujoco")
    bodies = "".join(
        f'<body name="l{k}" pos="0 0 {k}"><joint name="j{k}"/><geom name="g{k}" size=".1"/><geom size=".1" contype="2" '
        f'conaffinity="2"/></body>'
        for k in range(3)
    )
    pairs = '<contact><pair geom1="g0" geom2="g1"/><exclude body1="l1" body2="l2"/></contact>'
    (tmp_path / "r.xml").write_text(f"<mujoco><worldbody>{bodies}</worldbody>{pairs}</mujoco>", encoding="utf-8")
    entries = [("enable_collisions", "l1", "l2"), ("disable_collisions", "l1", "l0")]
    (tmp_path / "r.srdf").write_text(f"<robot>{write(entries)}</robot>", encoding="utf-8")
    robot = ab.Robot.load(tmp_path / "r.xml", device="cpu", srdf=tmp_path / "r.srdf")
    found = [tuple(sorted(robot.link_names[robot.model_link[k]] for k in pair)) for pair in robot.pairs]
    # Parts of links 0 and 2 by their bits, all of links 1 and 2.
    assert sorted(found) == [("l0", "l2")] * 2 + [("l1", "l2")] * 4
