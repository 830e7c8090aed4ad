"""A robot arm among obstacles: configurations a second, self-collision included, beside python-fcl link by link.

The arm is that of the URDF or MJCF file in $ABTREE_ROBOT with its visual meshes; without, one with the joints of a
Franka Panda and links of our own, rounded tubes of about 70,000 faces together. Around it stand real meshes, joined to
one of about 190,000 faces; without these a knot.
"""

import os
import tempfile
import time
from pathlib import Path

import numpy as np
import trimesh
import warp as wp

import warp_abtree as ab
from warp_abtree.model.mesh import load_mesh

from ..meshes import mesh_file
from ..shapes import knot
from ..timing import one_core, summarise, time_call, time_rounds
from .spheres import run_spheres

FULL = {"count": 4096, "fcl": 512, "repeats": 7, "fine": 22, "spheres": (60, 250, 1000), "posed": 8192, "scale": 1}
QUICK = {"count": 24, "fcl": 24, "repeats": 1, "fine": 6, "spheres": (30,), "posed": 64, "scale": 5}
PARTS = ("any", "distance", "edges", "spheres")
AROUND = ("stanford-bunny", "rocker-arm", "homer", "fandisk", "cow", "factory-bolt-m16", "factory-gear-medium")
LONG = 2.8973
# Joint of each link: x y z and turn about x [rad] from the link before, limits; lengths in metres.
JOINTS = (
    ((0, 0, 0.333), 0.0, (-LONG, LONG)),
    ((0, 0, 0), -np.pi / 2, (-1.7628, 1.7628)),
    ((0, -0.316, 0), np.pi / 2, (-LONG, LONG)),
    ((0.0825, 0, 0), np.pi / 2, (-3.0718, -0.0698)),
    ((-0.0825, 0.384, 0), -np.pi / 2, (-LONG, LONG)),
    ((0, 0, 0), np.pi / 2, (-0.0175, 3.7525)),
    ((0.088, 0, 0), np.pi / 2, (-LONG, LONG)),
)
# Tubes of each link: two ends and a radius.
TUBES = (
    [((0, 0, 0.02), (0, 0, 0.13), 0.07), ((-0.1, 0, 0.06), (0, 0, 0.06), 0.05)],
    [((0, 0, -0.17), (0, 0, 0), 0.058), ((0, -0.05, 0), (0, 0.05, 0), 0.055)],
    [((0, 0, -0.05), (0, 0, 0.05), 0.05), ((0, 0, 0), (0, -0.17, 0), 0.052)],
    [
        ((0, 0, -0.1), (0, 0, 0), 0.055),
        ((0, 0, 0), (0.0825, 0, 0), 0.045),
        ((0.0825, -0.05, 0), (0.0825, 0.05, 0), 0.05),
    ],
    [
        ((0, 0, -0.05), (0, 0, 0.05), 0.045),
        ((0, 0, 0), (-0.0825, 0.1, 0), 0.045),
        ((-0.0825, 0.1, 0), (-0.0825, 0.13, 0), 0.05),
    ],
    [((0, 0, -0.2), (0, 0, -0.02), 0.048), ((0, -0.04, 0), (0, 0.04, 0), 0.045)],
    [((0, 0, -0.04), (0, 0, 0.04), 0.042), ((0, 0, 0), (0.088, 0, 0), 0.042)],
    [((0, 0, 0.02), (0, 0, 0.09), 0.04)],
)
HOME = (0, 0, 0, -1.57079, 0, 1.57079, -0.7853, 0.02)


def tube_mesh(tubes, fine):
    """Return capsules as one mesh; they overlap."""
    parts = []
    for start, end, radius in tubes:
        way = np.subtract(end, start)
        part = trimesh.creation.capsule(np.linalg.norm(way), radius, count=(2 * fine, 2 * fine))
        part.apply_translation(-part.bounds.mean(0))
        part.apply_transform(trimesh.geometry.align_vectors((0, 0, 1), way))
        part.apply_translation(np.add(start, end) / 2)
        parts.append(part)
    return trimesh.util.concatenate(parts)


def write_arm(folder: Path, fine) -> Path:
    """Write the arm as URDF with STL files and return its path."""
    meshes = {f"link{k}": tube_mesh(tubes, fine) for k, tubes in enumerate(TUBES)}
    meshes["hand"] = tube_mesh([((0, -0.08, 0.03), (0, 0.08, 0.03), 0.025)], fine)
    meshes["left"] = meshes["right"] = tube_mesh([((0, 0.01, 0.015), (0, 0.01, 0.045), 0.009)], fine // 2)
    lines = []
    for name, mesh in meshes.items():
        mesh.export(folder / f"{name}.stl")
        lines.append(
            f'<link name="{name}"><visual><geometry><mesh filename="{name}.stl"/></geometry></visual>'
            f'<collision><geometry><mesh filename="{name}.stl"/></geometry></collision></link>'
        )
    lines += [
        joint_text(f"joint{k + 1}", "revolute", (f"link{k}", f"link{k + 1}"), place, (turn, 0, 0), "0 0 1", limits)
        for k, (place, turn, limits) in enumerate(JOINTS)
    ]
    lines.append(joint_text("flange", "fixed", ("link7", "hand"), (0, 0, 0.107), (0, 0, -np.pi / 4)))
    for name, turn in (("left", 0.0), ("right", np.pi)):
        mimic = '<mimic joint="finger_left"/>' if name == "right" else ""
        ends = ("hand", name), (0, 0, 0.0584), (0, 0, turn), "0 1 0", (0, 0.04), mimic
        lines.append(joint_text(f"finger_{name}", "prismatic", *ends))
    path = folder / "arm.urdf"
    path.write_text(f'<robot name="arm">{"".join(lines)}</robot>', encoding="utf-8")
    return path


def joint_text(name, kind, ends, place, turn, axis="", limits=(0, 0), mimic=""):
    """Return a joint of URDF."""
    numbers = [" ".join(map(str, values)) for values in (place, turn)]
    moved = f'<axis xyz="{axis}"/><limit lower="{limits[0]}" upper="{limits[1]}" effort="1" velocity="1"/>{mimic}'
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{ends[0]}"/><child link="{ends[1]}"/>'
        f'<origin xyz="{numbers[0]}" rpy="{numbers[1]}"/>{moved if axis else ""}</joint>'
    )


def make_around(quick):
    """Return real meshes around an arm as one, each 0.35 m long, in two rings; a knot where they are not at hand."""
    files = [mesh_file(name) for name in AROUND]
    if quick or not all(files):
        mesh = trimesh.Trimesh(*knot(2000 if quick else 190_000), process=False)
        mesh.apply_translation((0.9, 0, 0.4))
        return mesh
    parts = []
    for k, file in enumerate(files):
        found = load_mesh(file)
        part = trimesh.Trimesh(found.vertices, found.faces, process=False)
        part.apply_translation(-part.bounds.mean(0))
        part.apply_scale(0.35 / part.extents.max())
        angle = 2 * np.pi * k / len(files)
        part.apply_translation((0.6 * np.cos(angle), 0.6 * np.sin(angle), 0.25 + 0.4 * (k % 2)))
        parts.append(part)
    return trimesh.util.concatenate(parts)


class FclRobot:
    """The same question to python-fcl: a BVHModel a link, pair by pair until two intersect."""

    def __init__(self, robot, around):
        import fcl

        self.fcl, self.robot = fcl, robot
        self.trees = [self.make_tree(*model.mesh_at(model.lod_max)[:2]) for model in robot.models]
        self.around = fcl.CollisionObject(self.make_tree(*around.mesh_at(around.lod_max)[:2]), fcl.Transform())
        self.parts = [fcl.CollisionObject(tree, fcl.Transform()) for tree in self.trees]
        self.moving = [k for k, link in enumerate(robot.model_link) if robot.link_names[link] != "link0"]

    def make_tree(self, vertices, faces):
        tree = self.fcl.BVHModel()
        tree.beginModel(len(vertices), len(faces))
        tree.addSubModel(vertices, faces)
        tree.endModel()
        return tree

    def any(self, poses):
        """Return whether parts meet at each of some link poses (c, links, 4, 4)."""
        return np.array([self.meets(row[self.robot.model_link]) for row in poses])

    def meets(self, matrices):
        for part, matrix in zip(self.parts, matrices):
            part.setTransform(self.fcl.Transform(matrix[:3, :3], matrix[:3, 3]))
        request = self.fcl.CollisionRequest()
        pairs = [(self.parts[k], self.around) for k in reversed(self.moving)]
        pairs += [(self.parts[i], self.parts[j]) for i, j in self.robot.pairs.tolist()]
        return any(self.fcl.collide(a, b, request, self.fcl.CollisionResult()) for a, b in pairs)


def run(device, quick=False, only=PARTS):
    """Yield a row for each output: configurations a second, of random ones within limits.

    On the CPU one thread works. Forward kinematics is part of our time, and none of python-fcl's, which asks pair by
    pair until two intersect. Answers that differ from its are counted. Last come the errors of `spheres`.
    """
    device, sizes = wp.get_device(device), QUICK if quick else FULL
    with tempfile.TemporaryDirectory() as folder:
        path = os.environ.get("ABTREE_ROBOT")
        given = {"neutral": HOME} if path is None else {}
        path = path or write_arm(Path(folder), sizes["fine"])
        robot = ab.Robot.load(path, "visual", device, mounted=["link0"], **given)
    mesh = make_around(quick)
    around = ab.Model.load(mesh, base_faces=len(mesh.faces))
    count, rng = sizes["count"] if device.is_cpu else 2**20, np.random.default_rng(0)
    configurations = rng.uniform(*robot.limits.T, (count, len(robot.joint_names)))
    about = {
        "device": device.name,
        "robot_faces": sum(model.face_count for model in robot.models),
        "world_faces": around.face_count,
        "self_pairs": len(robot.pairs),
    }
    # One thread works: its own time leaves out other processes.
    clock = time.thread_time if device.is_cpu else time.perf_counter
    with one_core():
        if "any" in only:
            yield about | run_any(device, clock, robot, around, configurations, sizes)
        if "distance" in only:
            for beyond in (None, 0.05):
                part = configurations[: max(2, count // 8)]
                yield about | run_distance(device, clock, robot, around, part, beyond)
        if "edges" in only:
            free = configurations[~robot.check(configurations, around)]
            yield about | run_edges(device, clock, robot, around, free)
    if "spheres" in only:
        for row in run_spheres(robot, mesh, around, sizes["spheres"], sizes["posed"], sizes["scale"]):
            yield about | row


def run_any(device, clock, robot, around, configurations, sizes):
    """Return the columns of yes or no, beside python-fcl."""
    fcl_robot, some = FclRobot(robot, around), configurations[: sizes["fcl"]]
    poses, found = robot.forward(some).numpy(), robot.check(configurations, around)
    runs = {
        "ours": time_call(lambda: robot.check(configurations, around), device, clock),
        "fcl": time_call(lambda: fcl_robot.any(poses), clock=clock),
    }
    times = time_rounds(runs, sizes["repeats"])
    row = {"output": "any", "configurations": len(configurations), "meet": round(float(found.mean()), 4)}
    row |= summarise(times)
    row["differ_from_fcl"] = int((fcl_robot.any(poses) != found[: len(some)]).sum())
    row["configurations_s"] = round(1e3 * len(configurations) / row["ours_ms"])
    row["fcl_configurations_s"] = round(1e3 * len(some) / row["fcl_ms"])
    return row


def run_distance(device, clock, robot, around, configurations, beyond):
    """Return the columns of least distances."""
    ask = time_call(lambda: robot.check(configurations, around, "distance", beyond), device, clock)
    row = {"output": "distance", "beyond": beyond, "configurations": len(configurations)}
    row |= summarise(time_rounds({"ours": ask}, 1))
    return row | {"configurations_s": round(1e3 * len(configurations) / row["ours_ms"])}


def run_edges(device, clock, robot, around, free):
    """Return the columns of edges between configurations that are free, a twentieth of the way to another."""
    starts = free[: len(free) // 2]
    ends = starts + 0.05 * (free[len(free) // 2 :][: len(starts)] - starts)
    rows = robot.check_edges(starts, ends, around)
    times = time_rounds({"ours": time_call(lambda: robot.check_edges(starts, ends, around), device, clock)}, 1)
    row = {"output": "edges", "configurations": len(starts), "clear": round(float(rows["clear"].mean()), 4)}
    row |= {"undecided": round(float(rows["undecided"].mean()), 4)} | summarise(times)
    return row | {"edges_s": round(1e3 * len(starts) / row["ours_ms"])}
