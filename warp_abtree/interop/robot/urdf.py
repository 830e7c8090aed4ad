"""Robots of URDF files, read by yourdfpy (extra `robot`), and pairs that an SRDF file excludes."""

import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from warp_abtree.checks.arguments import first_line
from warp_abtree.interop.robot.description import (
    Description,
    Part,
    RobotError,
    RobotFrame,
    check_names,
    check_rigid,
    join_meshes,
    unit_axis,
)
from warp_abtree.model.mesh import MeshError, load_mesh

URDF_JOINTS = {"fixed": "fixed", "revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
INSTALL = "needs the extra `robot`: pip install 'warp-abtree[robot]'"


def read_urdf(path: Path, geometry: str) -> Description:
    """Read a robot from a URDF file; see `Robot.load`."""
    try:
        import yourdfpy
    except ImportError:
        raise ImportError(f"a URDF file {INSTALL}") from None
    try:
        robot = yourdfpy.URDF.load(str(path), build_scene_graph=False, load_meshes=False).robot
    except Exception as error:
        raise RobotError(f"{path}: not read as URDF ({first_line(error)})") from None
    description, joints = Description(), {joint.child: joint for joint in robot.joints}
    names = [link.name for link in robot.links]
    for what, given in (("links", names), ("joints", [joint.name for joint in robot.joints])):
        check_names(given, what, path)
    for joint in robot.joints:
        _check_joint(joint, joints, names, path)
    for joint in robot.joints:  # in the file's order, as configurations are
        if joint.type != "fixed" and joint.mimic is None:
            description.joints[joint.name] = _limits(joint, path)
    values = {joint.name: _value_of(joint, robot.joints, path) for joint in robot.joints if joint.type != "fixed"}
    for name in names:
        _add_link(name, description, joints, values, path, ())

    def find_file(name):
        return yourdfpy.urdf.filename_handler_magic(name, dir=str(path.parent))

    # By name: frames come parents first, links as they stand in the file.
    description.links = {name: description.links[name] for name in names}
    for k, link in enumerate(robot.links):
        shapes = link.collisions if geometry == "collision" else link.visuals
        where = f"{path}: link {link.name!r}"
        placed = [
            (*_load_shape(shape.geometry, where, find_file), check_rigid(shape.origin, where)) for shape in shapes
        ]
        if placed:
            try:
                description.parts.append(Part(k, join_meshes(placed, link.name)))
            except MeshError as error:
                raise RobotError(f"{where}: {first_line(error)}") from None
    return description


def _check_joint(joint, joints, names, path):
    where = f"{path}: joint {joint.name!r}"
    if joint.type not in URDF_JOINTS:
        raise RobotError(f"{where} is {joint.type}; fixed, revolute, continuous and prismatic ones are supported")
    for end in (joint.parent, joint.child):
        if end not in names:
            raise RobotError(f"{where}: no link {end!r}")
    if joints[joint.child] is not joint:
        raise RobotError(f"{where}: another joint moves link {joint.child!r}, too")


def _limits(joint, path) -> tuple[float, float]:
    """Return the limits of a joint: URDF requires them unless it is continuous, and has 0 for one that is not given."""
    if joint.type == "continuous":
        return -math.inf, math.inf
    given = (None, None) if joint.limit is None else (joint.limit.lower, joint.limit.upper)
    if given == (None, None):
        raise RobotError(
            f"{path}: joint {joint.name!r} is {joint.type} and has no limits; give <limit lower=... upper=...>"
            + (", or make it continuous" if joint.type == "revolute" else "")
        )
    low, high = (0.0 if value is None else float(value) for value in given)
    if not low <= high:
        raise RobotError(f"{path}: joint {joint.name!r}: limits {low:g} .. {high:g} leave no value")
    return low, high


def _value_of(joint, joints, path) -> tuple[str, float, float]:
    """Return the joint that a configuration sets, and scale and offset of what this one makes of it."""
    scale, offset, seen = 1.0, 0.0, {joint.name}
    named = {other.name: other for other in joints}
    while joint.mimic is not None:
        source = joint.mimic.joint
        if source not in named or source in seen or named[source].type == "fixed":
            raise RobotError(f"{path}: joint {joint.name!r} mimics {source!r}, which is none that moves by itself")
        by = 1.0 if joint.mimic.multiplier is None else float(joint.mimic.multiplier)
        offset += scale * (0.0 if joint.mimic.offset is None else float(joint.mimic.offset))
        scale *= by
        if not (math.isfinite(scale) and math.isfinite(offset)):
            raise RobotError(f"{path}: joint {joint.name!r} mimics {source!r} by numbers that are not finite")
        joint = named[source]
        seen.add(source)
    return joint.name, scale, offset


def _add_link(name, description, joints, values, path, below):
    """Add the frame of a link, after those that it hangs on."""
    if name in description.links:
        return
    if name in below:
        raise RobotError(f"{path}: link {name!r} hangs on itself")
    joint = joints.get(name)
    if joint is None:
        frame = RobotFrame(-1, np.eye(4))
    else:
        _add_link(joint.parent, description, joints, values, path, (*below, name))
        origin = check_rigid(joint.origin, f"{path}: joint {joint.name!r}")
        frame = RobotFrame(description.links[joint.parent], origin, URDF_JOINTS[joint.type])
        if joint.type != "fixed":
            frame.joint, frame.scale, frame.offset = values[joint.name]
            axis = (1.0, 0.0, 0.0) if joint.axis is None else joint.axis
            frame.axis = unit_axis(axis, f"{path}: joint {joint.name!r}")
    description.links[name] = len(description.frames)
    description.frames.append(frame)


def _load_shape(geometry, where, find_file):
    """Return vertices and faces of a shape."""
    import trimesh

    if geometry.mesh is not None:
        file = find_file(geometry.mesh.filename)
        if not Path(file).is_file():
            raise RobotError(f"{where}: no mesh file {geometry.mesh.filename}")
        try:
            mesh = load_mesh(file)
        except MeshError as error:
            raise RobotError(f"{where}: {first_line(error)}") from None
        scale = np.asarray(1.0 if geometry.mesh.scale is None else geometry.mesh.scale, np.float64)
        if scale.shape not in ((), (1,), (3,)) or not np.isfinite(scale).all():
            raise RobotError(f"{where}: scale {scale.tolist()} of a mesh is not 3 finite numbers")
        return mesh.vertices * scale, np.delete(mesh.faces, mesh.dropped_faces, axis=0)
    if geometry.box is not None:
        made = trimesh.creation.box(_sizes(geometry.box.size, 3, where))
    elif geometry.cylinder is not None:
        made = trimesh.creation.cylinder(*_sizes([geometry.cylinder.radius, geometry.cylinder.length], 2, where))
    elif geometry.sphere is not None:
        (radius,) = _sizes([geometry.sphere.radius], 1, where)
        if radius == 0:
            raise RobotError(f"{where}: a sphere has radius 0")
        made = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    else:
        raise RobotError(f"{where}: a shape that is neither mesh, box, cylinder nor sphere")
    return np.asarray(made.vertices), np.asarray(made.faces)


def _sizes(given, count, where) -> np.ndarray:
    """Return the sizes of a box, cylinder or sphere, checked."""
    sizes = np.array(given, np.float64)
    if sizes.shape != (count,) or not np.isfinite(sizes).all() or (sizes < 0).any():
        raise RobotError(f"{where}: sizes {sizes.tolist()} of a shape are not {count} finite numbers of at least 0")
    return sizes


def read_disabled_pairs(path: Path, links: set[str]) -> set[frozenset]:
    """Return the pairs of links whose collisions an SRDF file disables.

    Raises:
        RobotError: It is unreadable, or names a link that the robot has not.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise RobotError(f"{path}: not read as SRDF ({first_line(error)})") from None
    pairs = set()
    for entry in root.iter("disable_collisions"):
        names = entry.get("link1"), entry.get("link2")
        for name in names:
            if name not in links:
                raise RobotError(f"{path}: disable_collisions names {name!r}, which is no link of the robot")
        pairs.add(frozenset(names))
    return pairs
