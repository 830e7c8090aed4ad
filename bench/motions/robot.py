"""A robot arm among obstacles: configurations a second, self-collision included, beside python-fcl link by link.

The arm is that of the URDF or MJCF file in $ABTREE_ROBOT with its visual meshes; without, one of seven rounded tubes of
our own. Around it stand real meshes, joined to one of about 190,000 faces; without these a knot.
"""

import os
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
import trimesh

import warp_abtree as ab
from warp_abtree.model.mesh import load_mesh

from ..baselines.fcl import FclRobot
from ..meshes import mesh_file
from ..shapes import knot
from ..timing import host_clock, one_core, summarise, time_call, time_rounds

FULL = {"count": 4096, "fcl": 512, "repeats": 7, "fine": 70}
QUICK = {"count": 24, "fcl": 24, "repeats": 1, "fine": 12}
PARTS = ("any", "distance", "edges")
AROUND = ("stanford-bunny", "rocker-arm", "homer", "fandisk", "cow", "factory-bolt-m16", "factory-gear-medium")
LINKS, LENGTH, RADIUS = 7, 0.2, 0.05  # of the arm of our own [m]


def write_arm(folder: Path, fine) -> Path:
    """Write an arm as URDF and return its path: tubes on a foot, which turn about their own axis and bend in turn."""
    tube = trimesh.creation.capsule(LENGTH - 2 * RADIUS, RADIUS, count=(fine, fine))
    tube.apply_translation((0, 0, LENGTH / 2 - tube.bounds.mean(0)[2]))
    tube.export(folder / "tube.stl")
    part = '<geometry><mesh filename="tube.stl"/></geometry>'
    both = f"<visual>{part}</visual><collision>{part}</collision>"
    lines = [f'<link name="link{k}">{both}</link>' for k in range(LINKS + 1)]
    for k in range(LINKS):
        axis, limit = ("0 0 1", 2.9) if k % 2 == 0 else ("0 1 0", 1.8)
        lines.append(
            f'<joint name="joint{k + 1}" type="revolute"><parent link="link{k}"/><child link="link{k + 1}"/>'
            f'<origin xyz="0 0 {LENGTH}"/><axis xyz="{axis}"/>'
            f'<limit lower="{-limit}" upper="{limit}" effort="1" velocity="1"/></joint>'
        )
    path = folder / "arm.urdf"
    path.write_text(f'<robot name="arm">{"".join(lines)}</robot>', encoding="utf-8")
    return path


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


def run(device, quick=False, only=PARTS):
    """Yield a row for each output: configurations a second, of random ones within limits.

    On the CPU one thread works. Forward kinematics is part of our time, and none of python-fcl's. Answers that differ
    from its are counted.
    """
    sizes = QUICK if quick else FULL
    with tempfile.TemporaryDirectory() as folder:
        path = os.environ.get("ABTREE_ROBOT") or write_arm(Path(folder), sizes["fine"])
        robot = ab.Robot.load(path, "visual", device, mounted=["link0"])
    mesh = make_around(quick)
    around = ab.Model.load(mesh, base_faces=len(mesh.faces))
    count, rng = sizes["count"] if device.is_cpu else 2**20, np.random.default_rng(0)
    configurations = rng.uniform(*robot.limits.T, (count, len(robot.joint_names)))
    about = {"robot_faces": sum(model.face_count for model in robot.models)}
    about |= {"world_faces": around.face_count, "self_pairs": len(robot.pairs)}
    clock = host_clock(device)
    with one_core():
        if "any" in only:
            # Beside python-fcl, on some.
            fcl_robot, some = FclRobot(robot, around), configurations[: sizes["fcl"]]
            poses, found = robot.forward(some).numpy(), robot.check(configurations, around)
            ask, ask_fcl = partial(robot.check, configurations, around), partial(fcl_robot.any, poses)
            row = {"output": "any", "meet": found.mean(), "differ_from_fcl": (ask_fcl() != found[: len(some)]).sum()}
            row |= time_asked(device, clock, ask, configurations, sizes["repeats"], fcl=ask_fcl)
            yield about | row | {"fcl_per_s": round(1e3 * len(some) / row["fcl_ms"])}
        if "distance" in only:
            part = configurations[: max(2, count // 8)]
            for beyond in (None, 0.05):
                ask = partial(robot.check, part, around, "distance", beyond)
                yield about | {"output": "distance", "beyond": beyond} | time_asked(device, clock, ask, part)
        if "edges" in only:
            # Between configurations that are free, a twentieth of the way to another.
            free = configurations[~robot.check(configurations, around)]
            starts, others = np.array_split(free[: len(free) // 2 * 2], 2)
            ask = partial(robot.check_edges, starts, starts + 0.05 * (others - starts), around)
            rows = ask()
            row = {"output": "edges", "clear": rows["clear"].mean(), "undecided": rows["undecided"].mean()}
            yield about | row | time_asked(device, clock, ask, starts)


def time_asked(device, clock, ask, asked, repeats=1, **others):
    """Return the columns of times of a question about configurations or edges, and of others on the host."""
    runs = {name: time_call(other, clock=clock) for name, other in others.items()}
    row = summarise(time_rounds({"ours": time_call(ask, device, clock)} | runs, repeats))
    return {"asked": len(asked)} | row | {"per_s": round(1e3 * len(asked) / row["ours_ms"])}
