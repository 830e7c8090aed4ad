"""Robots of MJCF files, read and compiled by MuJoCo (extra `robot`)."""

import math
import re
from pathlib import Path

import numpy as np

from warp_abtree.checks.arguments import first_line
from warp_abtree.checks.quaternions import matrices_of
from warp_abtree.interop.robot.description import (
    Description,
    Part,
    RobotError,
    RobotFrame,
    check_names,
    join_meshes,
    unit_axis,
)
from warp_abtree.interop.robot.urdf import INSTALL
from warp_abtree.model.files.found import FileSurface, MeshError, Remarks, warn_caller
from warp_abtree.model.files.read import read_file, split_file_name

MJCF_JOINTS = {"hinge": "revolute", "slide": "prismatic"}
VISUAL_GROUPS = 3  # MuJoCo shows geoms of the groups below


def read_mjcf(path: Path, geometry: str) -> Description:
    """Read a robot from an MJCF file; see `Robot.load`."""
    try:
        import mujoco
    except ImportError:
        raise ImportError(f"an MJCF file {INSTALL}") from None
    root = re.search(rb"<([A-Za-z][\w.:]*)", re.sub(rb"<!--.*?-->", b"", path.read_bytes(), flags=re.DOTALL))
    if root and root[1] == b"robot":  # MuJoCo would read it, less what it fuses
        raise RobotError(f"{path}: not read as MJCF (its root is 'robot', as of a URDF; these end in .urdf)")
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except Exception as error:
        raise RobotError(f"{path}: not read as MJCF ({first_line(error)})") from None
    _warn_of_closures(mujoco, model, path)
    description, names = Description(), [model.body(b).name or f"body {b}" for b in range(model.nbody)]
    check_names(names, "bodies", path)
    values = _joint_values(mujoco, model, path)
    for j in range(model.njnt):
        if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE:
            description.add_coordinates(values[j][0], "floating")
        elif values[j] == (model.joint(j).name or f"joint {j}", 1.0, 0.0):
            low, high = model.jnt_range[j].tolist()
            description.joints[values[j][0]] = (low, high) if model.jnt_limited[j] else (-math.inf, math.inf)
    for b, name in enumerate(names):
        if model.body_mocapid[b] >= 0:
            raise RobotError(f"{path}: body {name!r} is moved by motion capture, not by joints")
        description.links[name] = _add_body(mujoco, model, b, description, names, values, path)
    if _is_off(mujoco, model, "FILTERPARENT"):
        description.neighbours = "none"
    elif geometry == "collision":
        description.neighbours = "moving"
    _add_all_parts(mujoco, model, description, geometry, [f"{path}: body {name!r}" for name in names])
    for signature in model.exclude_signature.tolist():
        description.excluded.add(frozenset((names[signature >> 16], names[signature & 0xFFFF])))
    return description


def _joint_values(mujoco, model, path) -> list[tuple[str, float, float]]:
    """Return for each joint that which a configuration sets, and scale and offset of what this one makes of it."""
    names = [model.joint(j).name or f"joint {j}" for j in range(model.njnt)]
    check_names(names, "joints", path)
    values, leads = [(name, 1.0, 0.0) for name in names], {}
    for j, name in enumerate(names):
        kind = _kind(mujoco.mjtJoint, model.jnt_type[j])
        if kind not in (*MJCF_JOINTS, "free"):
            raise RobotError(f"{path}: joint {name!r} is {kind}; hinge, slide and free ones are supported")
    for e, kind in _equalities(mujoco, model):
        if kind != "joint":
            continue
        j, k, factors = int(model.eq_obj1id[e]), int(model.eq_obj2id[e]), model.eq_data[e, :5]
        if j in leads:
            raise RobotError(f"{path}: joint {names[j]!r} follows two others")
        if k >= 0 and factors[2:].any():
            raise RobotError(f"{path}: joint {names[j]!r} follows another by a curve; linear ones are supported")
        # y - y0 = a + b (x - x0)
        scale = float(factors[1]) if k >= 0 else 0.0
        start = model.qpos0[model.jnt_qposadr[k]] if k >= 0 else 0.0
        offset = float(model.qpos0[model.jnt_qposadr[j]] + factors[0] - scale * start)
        leads[j] = (k, scale, offset)
    for j in leads:
        scale, offset, at, seen = 1.0, 0.0, j, set()
        while at in leads and at not in seen:
            seen.add(at)
            k, by, more = leads[at]
            scale, offset, at = scale * by, offset + scale * more, k
        if at in seen:
            raise RobotError(f"{path}: joint {names[j]!r} follows itself")
        values[j] = (names[at] if at >= 0 else "", scale, offset)
    return values


def _kind(enum, number) -> str:
    """Return what a number of one of MuJoCo's enums stands for: "hinge" for mjJNT_HINGE."""
    return enum(int(number)).name.partition("_")[2].lower()


def _is_off(mujoco, model, *flags) -> bool:
    off = (int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}")) for flag in flags)
    return any(int(model.opt.disableflags) & bit for bit in off)


def _equalities(mujoco, model):
    """Yield index and kind of each equality that MuJoCo enforces from the start."""
    for e in range(0 if _is_off(mujoco, model, "EQUALITY", "CONSTRAINT") else model.neq):
        if model.eq_active0[e]:
            yield e, _kind(mujoco.mjtEq, model.eq_type[e])


def _warn_of_closures(mujoco, model, path):
    """Refuse what deforms, and warn of what ties links beside their joints, and of contacts that are disabled."""
    for f in range(model.nflex):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_FLEX, f)
        raise RobotError(f"{path}: flex {name or f!r} may deform; rigid geoms are supported")
    found = []
    for e, kind in _equalities(mujoco, model):
        if kind != "joint":
            of = mujoco.mjtObj.mjOBJ_TENDON if kind == "tendon" else mujoco.mjtObj(int(model.eq_objtype[e]))
            ends = [int(k) for k in (model.eq_obj1id[e], model.eq_obj2id[e]) if k >= 0]
            unnamed = _kind(mujoco.mjtObj, of)
            tied = " and ".join(repr(mujoco.mj_id2name(model, of, k) or f"{unnamed} {k}") for k in ends)
            name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_EQUALITY, e)
            found.append(f"equality {kind} {name or e!r} of {tied}")
    for t in [] if _is_off(mujoco, model, "LIMIT", "CONSTRAINT") else np.flatnonzero(model.tendon_limited).tolist():
        found.append(f"the limits of tendon {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_TENDON, t) or t!r}")
    if _is_off(mujoco, model, "CONTACT", "CONSTRAINT"):
        warn_caller(f"{path}: it disables contacts; Robot.check tests its pairs all the same")
    if found:
        warn_caller(f"{path}: not enforced: {', '.join(found)}; links stand where their joints alone put them")


def _pose(position, quaternion=(1.0, 0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the transform of a position and a quaternion w x y z."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = matrices_of([np.roll(quaternion, -1)])[0], position
    return matrix


def _add_body(mujoco, model, b, description, names, values, path) -> int:
    """Add the frames of a body, one for each joint and one more where a joint stands off its origin."""
    parent = -1 if b == 0 else description.links[names[model.body_parentid[b]]]
    origin = np.eye(4) if b == 0 else _pose(model.body_pos[b], model.body_quat[b])
    anchor = np.zeros(3)
    first = int(model.body_jntadr[b])
    for j in range(first, first + int(model.body_jntnum[b])):
        joint, scale, offset = values[j]
        if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE:  # the body's pose in the world, as in qpos
            description.add_joint_frames(parent, np.eye(4), joint, "floating")
            continue
        origin = origin @ _pose(model.jnt_pos[j] - anchor)
        anchor = model.jnt_pos[j]
        start = float(model.qpos0[model.jnt_qposadr[j]])
        kind = MJCF_JOINTS[_kind(mujoco.mjtJoint, model.jnt_type[j])]
        axis = unit_axis(model.jnt_axis[j], f"{path}: joint {j}")
        frame = RobotFrame(parent, origin, kind, axis, joint or None, scale, offset - start)
        description.frames.append(frame)
        parent, origin = len(description.frames) - 1, np.eye(4)
    if anchor.any() or not model.body_jntnum[b]:
        description.frames.append(RobotFrame(parent, origin @ _pose(-anchor)))
    return len(description.frames) - 1


def _add_all_parts(mujoco, model, description, geometry, where):
    """Add the meshes of all bodies, one for a body's geoms of the same bits and partners, and the pairs of partners."""
    partners: dict[int, set[int]] = {}
    for a, b in zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True):
        partners.setdefault(a, set()).add(b)
        partners.setdefault(b, set()).add(a)
    placed: dict[tuple, list] = {}
    for g, b in enumerate(model.geom_bodyid.tolist()):
        met = frozenset(partners.get(g, ()))
        bits = int(model.geom_contype[g]), int(model.geom_conaffinity[g])
        if geometry == "collision" and bits == (0, 0) and not met:
            continue
        if geometry == "visual":
            if model.geom_group[g] >= VISUAL_GROUPS:
                continue
            bits = 1, 1
        placed.setdefault((b, bits, met), []).append(g)
    part_of = {}
    for (b, bits, _), geoms in placed.items():
        part_of |= dict.fromkeys(geoms, len(description.parts))
        shapes = [(*_shape(mujoco, model, g, where[b]), _pose(model.geom_pos[g], model.geom_quat[g])) for g in geoms]
        description.parts.append(Part(b, join_meshes(shapes, model.body(b).name or f"body {b}"), *bits))
    for g, others in partners.items():
        description.demanded |= {frozenset((part_of[g], part_of[h])) for h in others if {g, h} <= part_of.keys()}


def _shape(mujoco, model, g, where):
    """Return vertices and faces of a geom, in its own frame."""
    import trimesh

    kind, size = _kind(mujoco.mjtGeom, model.geom_type[g]), model.geom_size[g]
    if kind == "mesh":
        m = int(model.geom_dataid[g])
        vertex, face = int(model.mesh_vertadr[m]), int(model.mesh_faceadr[m])
        vertices = model.mesh_vert[vertex : vertex + model.mesh_vertnum[m]].astype(np.float64)
        return vertices, _recut(model, m, vertices, model.mesh_face[face : face + model.mesh_facenum[m]], where)
    if kind == "box":
        made = trimesh.creation.box(2 * size)
    elif kind in ("sphere", "ellipsoid"):
        made = trimesh.creation.icosphere(subdivisions=3)
        made.apply_scale(size[0] if kind == "sphere" else size)
    elif kind == "cylinder":
        made = trimesh.creation.cylinder(size[0], 2 * size[1])
    elif kind == "capsule":
        made = trimesh.creation.capsule(radius=size[0], height=2 * size[1])
        made.apply_translation(-made.bounds.mean(0))
    else:
        told = f"{where}: geom {model.geom(g).name or g!r} is a {kind}, which has no mesh"
        raise RobotError(f"{told}; what surrounds the robot is given to Robot.check")
    return np.asarray(made.vertices), np.asarray(made.faces)


def _recut(model, m, vertices, faces, where):
    """Return the faces of a mesh, those of some OBJ files anew.

    MuJoCo may fold polygons over, and takes the first of several objects or groups alone. Raises RobotError where it
    has other vertices than the file.
    """
    start = int(model.mesh_pathadr[m])
    path = Path(model.paths[start : model.paths.index(b"\0", start)].decode() if start >= 0 else "")
    if split_file_name(path)[1] != "obj" or not path.is_file():
        return faces
    try:
        found = read_file(path, Remarks())
    except MeshError as error:
        raise RobotError(f"{where}: {first_line(error)}") from None
    polygons = sum(line.split(maxsplit=1)[:1] == [b"f"] for line in path.read_bytes().splitlines())
    if not isinstance(found, FileSurface) or len(found.faces) == len(faces) <= polygons:
        return faces
    # MuJoCo scales, turns and shifts the vertices, and keeps their order.
    apart, to = math.inf, np.eye(4)[:, :3]
    if len(found.vertices) == len(vertices):
        given = np.column_stack([found.vertices, np.ones(len(vertices))])
        to = np.linalg.lstsq(given, vertices, rcond=None)[0]
        apart = np.abs(given @ to - vertices).max() / np.ptp(vertices, axis=0).max()
    if not apart <= 1e-5:
        raise RobotError(f"{where}: {path.name} has vertices that are not MuJoCo's; make it one object of triangles")
    return found.faces[:, ::-1] if np.linalg.det(to[:3]) < 0 else found.faces
