"""Robots as MuJoCo Menagerie has them, links of several files each: against FCL on the files, posed by MuJoCo.

Of a written arm, and of the real one in $ABTREE_ROBOT, as bench/motions/robot.py takes it.
"""

import os
from pathlib import Path
from xml.etree import ElementTree

import fcl
import numpy as np
import pytest
import trimesh
from helpers.robots import asked_pairs, pairs_of, random_configurations
from oracles.peers import fcl_object

import warp_abtree as ab

mujoco = pytest.importorskip("mujoco")
GIVEN = os.environ.get("ABTREE_ROBOT")
ARM = """<mujoco><compiler angle="radian" meshdir="assets" autolimits="true"/>
<default><default class="arm"><joint axis="0 0 1" range="-2.8 2.8"/>
  <default class="visual"><geom type="mesh" contype="0" conaffinity="0" group="2"/></default>
  <default class="collision"><geom type="mesh" group="3"/></default></default></default>
<asset><mesh file="base_0.obj"/><mesh file="base_1.obj"/><mesh file="upper_0.obj"/><mesh file="upper_1.obj"/>
  <mesh file="fore_0.obj"/><mesh file="fore_1.obj"/><mesh file="finger_0.obj"/>
  <mesh name="hull" file="hull.stl"/></asset>
<worldbody><body name="base" childclass="arm">
  <geom mesh="base_0" class="visual"/><geom mesh="base_1" class="visual"/><geom mesh="hull" class="collision"/>
  <body name="upper" pos="0 0 0.3"><joint name="turn"/>
    <geom mesh="upper_0" class="visual"/><geom mesh="upper_1" class="visual"/><geom mesh="hull" class="collision"/>
    <body name="fore" pos="0 0 0.25" quat="1 -1 0 0"><joint name="bend"/>
      <geom mesh="fore_0" class="visual"/><geom mesh="fore_1" class="visual"/><geom mesh="hull" class="collision"/>
      <body name="hand" pos="0 -0.45 0" quat="1 1 0 0">
        <body name="left"><joint name="grip" type="slide" axis="0 1 0" range="0.01 0.04"/>
          <geom mesh="finger_0" class="visual"/><geom mesh="finger_0" class="collision"/></body>
        <body name="right" quat="0 0 0 1"><joint name="follow" type="slide" axis="0 1 0" range="0.01 0.04"/>
          <geom mesh="finger_0" class="visual"/><geom mesh="finger_0" class="collision"/></body>
      </body></body></body></body></worldbody>
<contact><exclude body1="base" body2="upper"/></contact>
<equality><joint joint1="follow" joint2="grip"/></equality></mujoco>"""


def write_arm(folder):
    """Write an arm whose files lie apart from their frames' origins, and return its path."""
    make, place = trimesh.creation, trimesh.transformations.translation_matrix
    meshes = {
        "base_0.obj": make.cylinder(0.12, 0.1, transform=place((0, 0, 0.05))),
        "base_1.obj": make.torus(0.15, 0.04, transform=place((0.2, 0, 0.1))),
        "upper_0.obj": make.capsule(0.35, 0.05, count=(12, 12)),
        "upper_1.obj": make.box((0.1, 0.2, 0.06), place((0.1, 0, 0.2))),
        "fore_0.obj": make.cylinder(0.04, 0.4, transform=trimesh.transformations.rotation_matrix(1.5708, (1, 0, 0))),
        "fore_1.obj": make.icosphere(radius=0.09),
        "finger_0.obj": make.box((0.02, 0.02, 0.1), place((0, 0.01, 0.05))),
        "hull.stl": make.box((0.36, 0.12, 0.3), place((0, 0.02, 0.1))),
    }
    (folder / "assets").mkdir()
    for name, mesh in meshes.items():
        mesh.export(folder / "assets" / name)
    (folder / "arm.xml").write_text(ARM, encoding="utf-8")
    return folder / "arm.xml"


class FilesInFcl:
    """The files of a robot's geoms in FCL, a tree each, and where MuJoCo poses them."""

    def __init__(self, path, geometry):
        root, self.model = ElementTree.parse(path).getroot(), mujoco.MjModel.from_xml_path(str(path))
        self.data, self.geoms = mujoco.MjData(self.model), []
        folder = path.parent / root.find("compiler").get("meshdir")
        files = {entry.get("name", Path(entry.get("file")).stem): entry.get("file") for entry in root.iter("mesh")
                 if entry.get("file")}  # fmt: skip
        for g in range(self.model.ngeom):
            if (self.model.geom_contype[g] == 0) != (geometry == "visual"):
                continue
            if int(self.model.geom_type[g]) == int(mujoco.mjtGeom.mjGEOM_MESH):
                mesh = trimesh.load(folder / files[self.model.mesh(self.model.geom_dataid[g]).name], force="mesh")
            else:  # a box, unturned
                mesh = trimesh.creation.box(2 * self.model.geom_size[g])
                mesh.apply_translation(self.model.geom_pos[g])
            self.geoms.append((int(self.model.geom_bodyid[g]), fcl_object(mesh.vertices, mesh.faces)))

    def pose(self, values):
        """Pose the geoms for the values of joints by name."""
        for name, value in values.items():
            self.data.qpos[self.model.joint(name).qposadr[0]] = value
        mujoco.mj_kinematics(self.model, self.data)
        for body, geom in self.geoms:
            geom.setTransform(fcl.Transform(self.data.xmat[body].reshape(3, 3), self.data.xpos[body]))

    def of(self, name):
        return [geom for body, geom in self.geoms if self.model.body(body).name == name]


def check_originals(path, geometry, pairs, follower, base, count, device):
    """Compare with FCL at random configurations, alone and around a ring."""
    robot = ab.Robot.load(path, geometry, device, mounted=[base])
    names = [robot.link_names[k] for k in robot.model_link]
    assert len(names) == len(set(names)) and asked_pairs(robot) == pairs
    files, ring = FilesInFcl(path, geometry), trimesh.creation.torus(0.55, 0.15, 48, 16)
    ring.apply_translation((0, 0, 0.5))
    around = fcl_object(ring.vertices, ring.faces)
    # Fingers that are closed touch exactly, which rounding decides.
    low, high = robot.limits.T
    rows = random_configurations(count, np.array([low + 1e-3 * (high - low), high]).T, seed=4)
    alone, both = [], []
    for row in rows:
        files.pose(dict(zip(robot.joint_names, row)) | {follower: row[-1]})
        alone.append(any(fcl.collide(a, b) for i, j in map(tuple, pairs) for a in files.of(i) for b in files.of(j)))
        moving = [geom for name in names if name != base for geom in files.of(name)]
        both.append(alone[-1] or any(fcl.collide(geom, around) for geom in moving))
    assert 0 < sum(alone) < sum(both) < count
    np.testing.assert_array_equal(robot.check(rows), alone)
    np.testing.assert_array_equal(robot.check(rows, ab.Model.load(ring)), both)


@pytest.mark.parametrize("geometry", ["visual", "collision"])
def test_links_of_several_files(geometry, tmp_path, device):
    pairs = pairs_of("base fore", "base left", "base right", "upper left", "upper right", "left right")
    check_originals(write_arm(tmp_path), geometry, pairs, "follow", "base", 200, device)


@pytest.mark.slow
@pytest.mark.skipif(not GIVEN, reason="ABTREE_ROBOT names no panda.xml")
@pytest.mark.parametrize("geometry", ["visual", "collision"])
def test_panda(geometry, device):
    # Links by the joint that moves them; the hand is fixed to link 7, and fingers hang on it.
    order = {f"link{k}": k for k in range(8)} | {"hand": 7, "left_finger": 8, "right_finger": 8}
    pairs = {frozenset((a, b)) for a in order for b in order if abs(order[a] - order[b]) > 1}
    pairs |= {frozenset(("left_finger", "right_finger"))}
    pairs |= {frozenset(("link0", "link1"))} if geometry == "collision" else set()  # link 0 stands still
    check_originals(Path(GIVEN), geometry, pairs, "finger_joint1", "link0", 500, device)
