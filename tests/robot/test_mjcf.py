"""MJCF files: pairs and contacts as MuJoCo has them, ties beside joints, and where meshes stand."""

import warnings

import numpy as np
import pytest
import trimesh
from helpers.robots import asked_pairs, pairs_of, random_configurations
from scipy.spatial.distance import cdist

import warp_abtree as ab

mujoco = pytest.importorskip("mujoco")
OFF = 'contype="0" conaffinity="0"'
GEOM = '<geom name="{}" type="{}" size="{}" pos="{}" {}/>'
# Name, type, size and place of each geom: of the world, the base, links 1 (b), 2 (c) and 3 (d); c1 is rigidly on b.
GEOMS = {
    "w": [("w1", "box", ".3 .05 .05", ".25 0 .45")],
    "a": [("a1", "box", ".06 .06 .05", "0 0 0"), ("a2", "box", ".05 .04 .04", "0.2 0 0.1")],
    "b": [("b1", "box", ".03 .03 .1", "0 0 .15")],
    "c1": [("c1", "box", ".02 .02 .05", "0 .06 0")],
    "c": [("c2", "box", ".03 .03 .12", "0 0 .13"), ("c3", "box", ".04 .03 .03", "0 0.08 .2")],
    "d": [("d1", "box", ".03 .03 .03", "0 0 .05")],
}


def arm(rest="", flags="", bits=("", "", "", "", "")):
    """Return an arm on a base that is fixed to the world; bits of world, base and links 1 to 3."""
    made = {
        place: "".join(GEOM.format(*geom, bits["wabcd".index(place[0])]) for geom in geoms)
        for place, geoms in GEOMS.items()
    }
    return """<mujoco><compiler angle="radian"/>{flags}<worldbody>{w}<body name="base">{a}
    <body name="one" pos="0 0 .12"><joint name="p" axis="0 1 .1" range="-3 3"/><joint name="t" range="-3 3"/>{b}
      <body name="tool" pos="0.05 0 .3">{c1}<body name="two"><joint name="q" axis="0 1 0" range="-3 3"/>{c}
        <body name="three" pos="0 0 .25"><joint name="r" type="slide" axis="1 0 0" range="-.3 .3"/>{d}</body>
      </body></body></body></body></worldbody>{rest}</mujoco>""".format(flags=flags, rest=rest, **made)


def pairs(*named):
    return "<contact>" + "".join('<pair geom1="{}" geom2="{}"/>'.format(*pair.split()) for pair in named) + "</contact>"


ARMS = {
    "masks": arm(bits=("", "", 'contype="2" conaffinity="4"', 'contype="4" conaffinity="0"', "")),
    "plain": arm(),
    "parents": arm(flags='<option><flag filterparent="disable"/></option>'),
    "pairs only": arm(pairs("a1 c2", "b1 c3", "w1 d1"), bits=(OFF,) * 5),
    "pairs of all geoms": arm(pairs("a1 c2", "a2 c2", "a1 c3", "a2 c3"), bits=(OFF,) * 5),
    "a pair beside masks": arm(pairs("d1 a1", "d1 w1"), bits=(OFF, "", OFF, 'contype="4" conaffinity="0"', OFF)),
    "neighbours": arm(pairs("c2 d1", "b1 c3", "b1 c1")),
    "one body": arm(pairs("c2 c3")),
    "still bodies": arm(pairs("w1 a2")),
    "excluded": arm('<contact><exclude body1="world" body2="three"/><exclude body1="base" body2="one"/></contact>'),
    "pair and exclude": arm(
        '<contact><exclude body1="base" body2="two"/><exclude body1="two" body2="base"/>'
        '<pair geom1="a2" geom2="c3"/></contact>'
    ),
}


def load(text, folder, *rest, device="cpu"):
    (folder / "arm.xml").write_text(text, encoding="utf-8")
    return ab.Robot.load(folder / "arm.xml", *rest, device=device)


@pytest.mark.parametrize("name", ARMS)
def test_pairs_are_those_that_mujoco_has_contacts_of(name, tmp_path):
    model = mujoco.MjModel.from_xml_string(ARMS[name])
    # Within a margin of 100 all that may meet does; boxes so far apart have no contact points there.
    model.geom_type[:], model.geom_margin[:], model.pair_margin[:] = mujoco.mjtGeom.mjGEOM_SPHERE, 50, 100
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)  # its boxes know no such margin
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    robot = load(ARMS[name], tmp_path)
    found = {frozenset(robot.model_link[list(pair)].tolist()) for pair in robot.pairs}
    contacts = data.contact[: data.ncon]
    assert found == {frozenset(model.geom_bodyid[contact.geom].tolist()) for contact in contacts} and found


@pytest.mark.parametrize("name", ["plain", "parents", "pairs only", "pair and exclude"])
def test_links_meet_where_mujoco_has_contacts(name, tmp_path, device):
    robot = load(ARMS[name], tmp_path, device=device)
    model = mujoco.MjModel.from_xml_string(ARMS[name])
    data, rows, expected = mujoco.MjData(model), random_configurations(100, robot.limits, seed=3), []
    for row in rows:
        data.qpos[:] = row
        mujoco.mj_forward(model, data)
        expected.append(data.ncon > 0)
    assert 0 < sum(expected) < 100
    np.testing.assert_array_equal(robot.check(rows), expected)


def test_visual_geoms_leave_neighbours_out_unless_filterparent_is_disabled(tmp_path):
    def of(name):
        return asked_pairs(load(ARMS[name], tmp_path, "visual"))

    joined = pairs_of("base one", "world one", "two three", "one two")
    assert not joined & of("plain") and joined <= of("parents") and of("parents") - of("plain") >= joined
    assert of("neighbours") - of("plain") == pairs_of("two three", "one two", "one tool")


def test_equalities_and_tendons_that_nothing_enforces_are_named(tmp_path):
    tendons = (
        '<tendon><fixed name="short" range="0 1"><joint joint="p" coef="1"/></fixed>'
        '<fixed name="free"><joint joint="q" coef="1"/></fixed></tendon>'
    )
    equalities = (
        '<connect name="loop" body1="two" body2="base" anchor="0 0 0"/><weld body1="three"/><weld body1="one" active='
        '"false"/><tendon tendon1="short" tendon2="free"/><joint joint1="t" joint2="q" polycoef=".1 .5 0 0 0"/>'
        '<joint joint1="r" polycoef=".05 1 2 0 0"/>'
    )
    rest = f"{tendons}<equality>{equalities}</equality>"
    off = '<option><flag equality="disable"/></option>'
    with pytest.warns(RuntimeWarning) as caught:
        robot = load(arm(rest), tmp_path)
    assert [str(warning.message).split("arm.xml: ")[1] for warning in caught] == [
        "not enforced: equality connect 'loop' of 'two' and 'base', equality weld 1 of 'three' and 'world', "
        "equality tendon 3 of 'short' and 'free', the limits of tendon 'short'; "
        "links stand where their joints alone put them"
    ]
    assert caught[0].filename == __file__ and robot.joint_names == ("p", "q")
    with pytest.warns(RuntimeWarning, match="disables contacts; Robot.check tests its pairs all the same$") as caught:
        robot = load(arm(rest, '<option><flag constraint="disable"/></option>'), tmp_path)
    assert len(caught) == 1 and len(robot.pairs) == len(load(arm(), tmp_path).pairs)
    with warnings.catch_warnings(action="error"):
        load(arm(tendons, '<option><flag limit="disable"/></option>'), tmp_path)
        # Nothing is enforced there, and joints follow none.
        for disabled in (equalities.split("<tendon")[0], '<joint joint1="t" joint2="q"/>'):
            robot = load(arm(f"<equality>{disabled}</equality>", off), tmp_path)
            assert robot.joint_names == ("p", "t", "q", "r")


LETTER = [(0, 0), (4, 0), (4, 1), (1, 1), (1, 3), (4, 3), (4, 4), (0, 4)]  # area 10, perimeter 22


def prism(ring):
    """Return an OBJ file of a prism of height 1, a polygon a side, with vertices that none uses."""
    count = len(ring)
    faces = [range(count - 1, -1, -1), range(count, 2 * count)]
    faces += [(k, (k + 1) % count, (k + 1) % count + count, k + count) for k in range(count)]
    points = "".join(f"v {x} {y} {z}\n" for z in (0, 1) for x, y in ring)
    return points + "v 9 9 9\nv 0 0 0\n" + "".join(f"f {' '.join(str(k + 1) for k in face)}\n" for face in faces)


@pytest.mark.parametrize("turned", [0, 3, 6])
@pytest.mark.parametrize("more, scale", [("", 1), ('scale="2 2 -2" refpos="1 2 3" refquat="0 1 0 0"', 2)])
def test_polygons_do_not_fold(tmp_path, turned, more, scale):
    (tmp_path / "c.obj").write_text(prism(LETTER[turned:] + LETTER[:turned]))
    (tmp_path / "a.xml").write_text(
        f'<mujoco><asset><mesh name="m" file="c.obj" {more}/></asset><worldbody><geom type="mesh" mesh="m"/>'
        '<body name="arm"><joint name="j" axis="0 0 1"/><geom size="0.1" pos="9 9 9"/></body></worldbody></mujoco>'
    )
    model = ab.Robot.load(tmp_path / "a.xml", device="cpu").models[0]
    solid = trimesh.Trimesh(*model.mesh_at(model.lod_max)[:2])
    assert solid.is_watertight and len(solid.faces) == 2 * 6 + 2 * 8
    assert solid.area == pytest.approx((2 * 10 + 22) * scale**2) and solid.volume == pytest.approx(10 * scale**3)


@pytest.mark.parametrize("kind", ["o", "g", "usemtl"])
def test_all_objects_and_groups_of_a_file_count(tmp_path, kind):
    """MuJoCo collides with the hull of all vertices, and shows the first object or group alone."""
    lines, scale = [], np.array([0.5, 0.5, -0.5])
    boxes = [trimesh.creation.box((1, 2, 3), trimesh.transformations.translation_matrix((x, 0, 0))) for x in (0, 5, 9)]
    for k, box in enumerate(boxes):
        lines += [f"{kind} part{k}", *("v {} {} {}".format(*vertex) for vertex in box.vertices)]
        lines += ["f {} {} {}".format(*face) for face in box.faces + 1 + 8 * k]
    (tmp_path / "parts.obj").write_text("\n".join(lines))
    mesh = '<mesh name="m" file="parts.obj" scale="0.5 0.5 -0.5"/>'
    body = '<body name="arm"><joint name="j" axis="0 0 1"/><geom type="mesh" mesh="m"/></body>'
    robot = load(f"<mujoco><asset>{mesh}</asset><worldbody>{body}</worldbody></mujoco>", tmp_path)
    solid = trimesh.Trimesh(*robot.models[0].mesh_at(robot.models[0].lod_max)[:2])
    expected = trimesh.util.concatenate(boxes).apply_scale(scale)
    assert solid.is_watertight and solid.volume == pytest.approx(3 * 6 / 8)
    np.testing.assert_allclose(solid.bounds, expected.bounds, atol=1e-6)
    ball = ab.Model.load(trimesh.creation.icosphere(1, 0.1))
    poses = [(x, 0, 0.75, 0, 0, 0, 1) for x in (0, 2.5, 4.5, 1.2)]
    assert [bool(robot.check([0.0], [(ball, pose)])) for pose in poses] == [True, True, True, False]


PLACED = '<mesh file="ring.obj"/><mesh file="box.obj"/><mesh file="hull.stl"/>'
OF_LINK = f'<geom type="mesh" mesh="ring" {OFF}/><geom type="mesh" mesh="box" {OFF}/>'


@pytest.mark.parametrize("geometry, files", [("visual", ["ring.obj", "box.obj"]), ("collision", ["hull.stl"])])
def test_links_of_several_files(geometry, files, tmp_path):
    """Each stands where its file has it, though MuJoCo moves a mesh to its middle and turns it to its axes."""
    make, place = trimesh.creation, trimesh.transformations.translation_matrix
    meshes = {
        "ring.obj": make.torus(0.15, 0.04, transform=place((0.2, 0, 0.1))),
        "box.obj": make.box((0.1, 0.2, 0.06), place((0.1, 0, 0.2))),
        "hull.stl": make.box((0.36, 0.12, 0.3), place((0, 0.02, 0.1))),
    }
    for name, mesh in meshes.items():
        mesh.export(tmp_path / name)
    body = f'<body pos="0 0 0.3" quat="1 1 0 0"><joint/>{OF_LINK}<geom type="mesh" mesh="hull" group="3"/></body>'
    (model,) = load(f"<mujoco><asset>{PLACED}</asset><worldbody>{body}</worldbody></mujoco>", tmp_path, geometry).models
    between = cdist(model.mesh_at(model.lod_max)[0], np.concatenate([meshes[name].vertices for name in files]))
    assert max(between.min(0).max(), between.min(1).max()) < 1e-6
