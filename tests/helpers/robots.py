"""Robots that tests write themselves: an arm as URDF and MJCF, and one described by hand, which needs no parser."""

import numpy as np
import trimesh
from oracles.peers import fcl_object
from scipy.spatial.transform import Rotation

import warp_abtree as ab
from warp_abtree.interop.robot.description import Description, Part, RobotFrame
from warp_abtree.model.mesh import mesh_from_arrays

LIMITS = ((-20.0, 20.0), (-2.8, 2.8), (0.0, 0.1), (-2.5, 2.5))

URDF = """<robot name="arm">
<link name="base"><collision><geometry><cylinder radius="0.1" length="0.2"/></geometry></collision></link>
<link name="upper">
  <visual><geometry><sphere radius="0.2"/></geometry></visual>
  <collision><origin xyz="0 0 0.3"/><geometry><box size="0.08 0.08 0.5"/></geometry></collision>
  <collision><origin xyz="0 0.1 0.3"/><geometry>
    <mesh filename="package://arm/part.stl" scale="2 1 1"/></geometry></collision>
</link>
<link name="fore">
  <collision><origin xyz="0 0 0.2" rpy="0.1 0.2 0.3"/><geometry><box size="0.06 0.06 0.4"/></geometry></collision>
</link>
<link name="flange"/>
<link name="left"><collision><geometry><sphere radius="0.03"/></geometry></collision></link>
<link name="right"><collision><geometry><sphere radius="0.03"/></geometry></collision></link>
<joint name="turn" type="continuous"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.1"/>
  <axis xyz="0 0 2"/></joint>
<joint name="bend" type="revolute"><parent link="upper"/><child link="fore"/>
  <origin xyz="0 0.01 0.5" rpy="0.3 -0.2 0.7"/><axis xyz="0 1 0.2"/>
  <limit lower="-2.8" upper="2.8" effort="1" velocity="1"/></joint>
<joint name="mount" type="fixed"><parent link="fore"/><child link="flange"/><origin xyz="0 0 0.42" rpy="0 0 1"/></joint>
<joint name="grip" type="prismatic"><parent link="flange"/><child link="left"/><origin xyz="0 0 0.05"/>
  <axis xyz="0 1 0"/><limit lower="0" upper="0.1" effort="1" velocity="1"/></joint>
<joint name="follow" type="prismatic"><parent link="flange"/><child link="right"/><origin xyz="0 0 0.05"/>
  <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/>
  <mimic joint="grip" multiplier="-1" offset="-0.04"/></joint>
</robot>"""

MJCF = """<mujoco><compiler angle="radian" autolimits="true"/>
<asset><mesh name="part" file="part.stl" scale="2 1 1"/></asset>
<worldbody><body name="base"><geom type="cylinder" size="0.1 0.1"/>
  <body name="upper" pos="0 0 0.1" euler="0.1 0 0.4"><joint name="turn" axis="0 0 1"/>
    <joint name="lean" axis="1 0 0" pos="0 0.1 0.2" range="-0.5 0.5" ref="0.1"/>
    <geom type="box" size="0.04 0.04 0.25" pos="0 0 0.3"/><geom type="mesh" mesh="part" pos="0 0.1 0.3"/>
    <geom type="sphere" size="0.2" contype="0" conaffinity="0" group="2"/>
    <body name="fore" pos="0 0.01 0.5" quat="0.9 0.1 0.3 0.2"><joint name="bend" axis="0 1 0.2" range="-2.8 2.8"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0 0 0.4"/>
      <body name="flange" pos="0 0 0.45">
        <body name="left"><joint name="grip" type="slide" axis="0 1 0" range="0 0.1"/>
          <geom type="sphere" size="0.03"/><geom type="sphere" size="0.01" pos="0 0 0.05" contype="2" conaffinity="2"/>
        </body>
        <body name="right"><joint name="follow" type="slide" axis="0 1 0" range="-1 1"/>
          <geom type="ellipsoid" size="0.03 0.03 0.02"/></body>
      </body></body></body></body></worldbody>
<contact><exclude body1="base" body2="fore"/></contact>
<equality><joint joint1="follow" joint2="grip" polycoef="-0.04 -1 0 0 0"/></equality>
</mujoco>"""


RING = ab.Model.load(trimesh.creation.torus(0.45, 0.12, 32, 12))
ROOF = ab.Model.load(trimesh.creation.box((1.5, 0.1, 0.02)))
AROUND = [(RING, (0, 0, 0.75, 0, 0, 0, 1)), (ROOF, (0, 0.3, 1.1, 0, 0, 0.6, 0.8))]


def write_arm(folder, text, name):
    trimesh.creation.box((0.05, 0.1, 0.04)).export(folder / "part.stl")
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def described_arm() -> Description:
    """Return an arm on a base: it turns, bends, has two fingers that move as one, and a flap that swings."""

    def placed(x, y, z, *turn):
        matrix = np.eye(4)
        matrix[:3, 3] = x, y, z
        matrix[:3, :3] = Rotation.from_rotvec(turn or (0, 0, 0)).as_matrix()
        return matrix

    def part(link, mesh, x=0.0, y=0.0, z=0.0):
        mesh.apply_translation((x, y, z))
        return Part(link, mesh_from_arrays(mesh.vertices, mesh.faces, name=f"link {link}"))

    axis = np.array([0.0, 1.0, 0.2]) / np.hypot(1.0, 0.2)
    frames = [
        RobotFrame(-1, np.eye(4)),
        RobotFrame(0, placed(0, 0, 0.1), "revolute", (0, 0, 1), "turn"),
        RobotFrame(1, placed(0, 0.01, 0.5, 0.3, -0.2, 0.7), "revolute", tuple(axis), "bend"),
        RobotFrame(2, placed(0, 0, 0.42, 0, 0, 1)),
        RobotFrame(3, placed(0, 0, 0.05), "prismatic", (0, 1, 0), "grip"),
        RobotFrame(3, placed(0, 0, 0.05), "prismatic", (0, 1, 0), "grip", -1.0, -0.04),
        RobotFrame(2, placed(0.05, 0, 0.2), "revolute", (0, 1, 0), "swing"),
    ]
    make, names = trimesh.creation, ("base", "upper", "fore", "flange", "left", "right", "flap")
    parts = [
        part(0, make.cylinder(0.1, 0.2, sections=16)),
        part(1, make.torus(0.2, 0.04, 24, 8), z=0.3),
        part(2, make.box((0.06, 0.06, 0.36)), z=0.2),
        part(4, make.icosphere(subdivisions=2, radius=0.03)),
        part(5, make.icosphere(subdivisions=2, radius=0.03)),
        part(6, make.capsule(height=0.25, radius=0.02, count=(8, 8)), z=0.1),
    ]
    joints = dict(zip(("turn", "bend", "grip", "swing"), LIMITS))
    return Description(frames, joints, {name: k for k, name in enumerate(names)}, parts, {frozenset(("base", "fore"))})


def described_chain(mesh, *joints) -> Description:
    """Return links in a row and a mesh on the last: joints are (kind, axis, place, scale), of a value each."""
    frames = [RobotFrame(-1, np.eye(4))]
    for k, (kind, axis, place, scale) in enumerate(joints):
        origin = np.eye(4)
        origin[:3, 3] = place
        frames.append(RobotFrame(k, origin, kind, axis, None if kind == "fixed" else f"joint {k}", scale))
    limits = {frame.joint: (-np.inf, np.inf) for frame in frames if frame.joint is not None}
    part = Part(len(joints), mesh_from_arrays(mesh.vertices, mesh.faces, name="last"))
    return Description(frames, limits, {f"link {k}": k for k in range(len(frames))}, [part])


def pose_frames(description, row) -> np.ndarray:
    """Return the pose of each frame at a configuration, one product after the other, (frames, 4, 4)."""
    values, poses = dict(zip(description.joints, row)), []
    for frame in description.frames:
        moved = np.eye(4)
        value = 0.0 if frame.joint is None else frame.scale * values[frame.joint] + frame.offset
        if frame.kind == "revolute":
            moved[:3, :3] = Rotation.from_rotvec(value * np.array(frame.axis)).as_matrix()
        elif frame.kind == "prismatic":
            moved[:3, 3] = value * np.array(frame.axis)
        before = np.eye(4) if frame.parent < 0 else poses[frame.parent]
        poses.append(before @ frame.origin @ moved)
    return np.array(poses)


def random_configurations(count, limits=LIMITS, seed=0):
    low, high = np.array(limits).T
    return np.random.default_rng(seed).uniform(np.maximum(low, -20), np.minimum(high, 20), (count, len(limits)))


def asked_pairs(robot):
    names = [robot.link_names[k] for k in robot.model_link]
    return {frozenset((names[i], names[j])) for i, j in robot.pairs}


def pairs_of(*names):
    return {frozenset(pair.split()) for pair in names}


class InFcl:
    """The links of a robot, of a part each, and what stands around it in FCL: (model, pose) by name."""

    def __init__(self, robot, **around):
        self.robot, names = robot, [robot.link_names[k] for k in robot.model_link]
        self.parts = [fcl_object(*model.mesh_at(model.lod_max)[:2]) for model in robot.models]
        moving = [pair for pair, k in zip(zip(names, self.parts), robot.model_link) if k not in robot.mounted]
        others = [(name, fcl_object(*model.mesh_at(model.lod_max)[:2], pose)) for name, (model, pose) in around.items()]
        self.pairs = [((names[i], names[j]), self.parts[i], self.parts[j]) for i, j in robot.pairs]
        self.pairs += [((a, b), part, other) for a, part in moving for b, other in others]

    def distances(self, poses):
        """Return the distance of each tested pair of names, 0 where it intersects, at poses of links (n, 4, 4)."""
        import fcl

        def distance(a, b):
            return 0.0 if fcl.collide(a, b) else fcl.distance(a, b, fcl.DistanceRequest(), fcl.DistanceResult())

        for part, matrix in zip(self.parts, poses[self.robot.model_link]):
            part.setTransform(fcl.Transform(matrix[:3, :3], matrix[:3, 3]))
        return {names: distance(a, b) for names, a, b in self.pairs}
