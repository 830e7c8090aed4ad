"""Robots of URDF files, read by yourdfpy (extra `robot`), and pairs that an SRDF file excludes or demands."""

import gzip
import math
import os
import re
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np

from warp_abtree.checks.arguments import first_line
from warp_abtree.interop.robot.description import (
    COORDINATES,
    Description,
    Part,
    RobotError,
    RobotFrame,
    check_names,
    check_rigid,
    join_meshes,
    unit_axis,
)
from warp_abtree.model.files.found import warn_caller
from warp_abtree.model.files.read import split_file_name
from warp_abtree.model.mesh import MeshError, load_mesh

URDF_JOINTS = {"fixed": "fixed", "revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
MOVING = {name for name, kind in URDF_JOINTS.items() if kind != "fixed"}  # of one value
# Those of pairs, and what says nothing of them.
SRDF_TAGS = (
    *("disable_collisions", "enable_collisions", "disable_default_collisions", "group", "group_state", "end_effector"),
    *("virtual_joint", "passive_joint", "joint_property", "link_sphere_approximation"),
)
INSTALL = "needs the extra `robot`: pip install 'warp-abtree[robot]'"


def read_urdf(path: Path, geometry: str) -> Description:
    """Read a robot from a URDF file; see `Robot.load`."""
    try:
        import yourdfpy
    except ImportError:
        raise ImportError(f"a URDF file {INSTALL}") from None
    try:
        _check_elements(path)
        robot = yourdfpy.URDF.load(str(path), build_scene_graph=False, load_meshes=False).robot
    except (RobotError, RuntimeWarning):  # a warning where these are errors
        raise
    except Exception as error:
        told = f"an element lacks {error}" if isinstance(error, KeyError) else first_line(error)
        raise RobotError(f"{path}: not read as URDF ({told})") from None
    description, joints = Description(), {joint.child: joint for joint in robot.joints}
    names = [link.name for link in robot.links]
    coordinates = [f"{joint.name}/{name}" for joint in robot.joints for name in COORDINATES.get(joint.type, ())]
    for what, given in (("links", names), ("joints", [joint.name for joint in robot.joints] + coordinates)):
        check_names(given, what, path)
    for joint in robot.joints:
        _check_joint(joint, joints, names, path)
    roots = [name for name in names if name not in joints]
    if len(roots) > 1:
        warn_caller(f"{path}: {', '.join(map(repr, roots[1:]))} hang on no joint, and are placed where {roots[0]!r} is")
    for joint in robot.joints:  # in the file's order, as configurations are
        if joint.type in COORDINATES:
            description.add_coordinates(joint.name, joint.type)
        elif joint.type != "fixed" and joint.mimic is None:
            description.joints[joint.name] = _limits(joint, path)
    values = {joint.name: _value_of(joint, robot.joints, path) for joint in robot.joints if joint.type in MOVING}
    for name in names:
        _add_link(name, description, joints, values, path)

    # By name: frames come parents first, links as they stand in the file.
    description.links = {name: description.links[name] for name in names}
    for k, link in enumerate(robot.links):
        shapes = link.collisions if geometry == "collision" else link.visuals
        where = f"{path}: link {link.name!r}"
        placed = []
        for shape in shapes:
            vertices, faces, scale = _load_shape(shape.geometry, where, path)
            placed.append((vertices, faces, check_rigid(shape.origin, where) @ np.diag([*scale, 1.0])))
        if placed:
            try:
                description.parts.append(Part(k, join_meshes(placed, link.name)))
            except MeshError as error:
                raise RobotError(f"{where}: {first_line(error)}") from None
    return description


def _check_joint(joint, joints, names, path):
    where = f"{path}: joint {joint.name!r}"
    if joint.type not in (*URDF_JOINTS, *COORDINATES):
        raise RobotError(f"{where} is {joint.type}; {', '.join((*URDF_JOINTS, *COORDINATES))} ones are supported")
    if joint.type in COORDINATES and joint.mimic is not None:
        raise RobotError(f"{where} is {joint.type}, and mimics another; one that does has one value")
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
        told = f"{path}: joint {joint.name!r} is {joint.type} and has no limits; give <limit lower=... upper=...>"
        raise RobotError(told + (", or make it continuous" if joint.type == "revolute" else ""))
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
        if source not in named or source in seen or named[source].type not in MOVING:
            told = f"{path}: joint {joint.name!r} mimics {source!r}"
            raise RobotError(f"{told}, which is none of one value that moves by itself")
        by = 1.0 if joint.mimic.multiplier is None else float(joint.mimic.multiplier)
        offset += scale * (0.0 if joint.mimic.offset is None else float(joint.mimic.offset))
        scale *= by
        if not (math.isfinite(scale) and math.isfinite(offset)):
            raise RobotError(f"{path}: joint {joint.name!r} mimics {source!r} by numbers that are not finite")
        joint = named[source]
        seen.add(source)
    return joint.name, scale, offset


def _add_link(name, description, joints, values, path):
    """Add the frames of a link and of those that it hangs on, the first of these first."""
    above: dict[str, None] = {}
    while name is not None and name not in description.links:
        if name in above:
            raise RobotError(f"{path}: link {name!r} hangs on itself")
        above[name] = None
        name = joints[name].parent if name in joints else None
    for link in reversed(above):
        joint = joints.get(link)
        if joint is None:
            description.frames.append(RobotFrame(-1, np.eye(4)))
        else:
            where = f"{path}: joint {joint.name!r}"
            parent, origin = description.links[joint.parent], check_rigid(joint.origin, where)
            given = (1.0, 0.0, 0.0) if joint.axis is None else joint.axis
            axis = (0.0, 0.0, 1.0) if joint.type in ("fixed", "floating") else unit_axis(given, where)
            if joint.type in COORDINATES:
                description.add_joint_frames(parent, origin, joint.name, joint.type, axis)
            else:
                made = RobotFrame(parent, origin, URDF_JOINTS[joint.type], axis, *values.get(joint.name, ()))
                description.frames.append(made)
        description.links[link] = len(description.frames) - 1


def _check_elements(path):
    """Refuse what yourdfpy mends or leaves out in silence, and warn of joints that it does not read.

    Refused are lines that are no XML, another root, geometries of other than one shape, meshes of other than one.
    """
    from lxml import etree  # of yourdfpy

    parser = etree.XMLParser(recover=True)
    root = etree.parse(str(path), parser).getroot()
    _check_root(root, "URDF", path)
    for error in parser.error_log:
        if error.level == etree.ErrorLevels.FATAL:  # a namespace that is not declared is none
            raise RobotError(f"{path}: not read as URDF (line {error.line}: {error.message})")
    for odd in root.xpath("//geometry[count(*) != 1] | link/*[self::collision or self::visual][count(geometry) != 1]"):
        one = "shape" if odd.tag == "geometry" else "geometry"
        raise RobotError(f"{path}: not read as URDF (line {odd.sourceline}: a {odd.tag} has one {one})")
    _warn_of_unread([e.tag for e in root.iter() if "xacro" in str(e.tag)], path)
    found = root.xpath("//*[local-name()='gazebo']//joint | //*[contains(name(), 'loop_joint')]")
    if found:
        names = ", ".join(repr(joint.get("name")) for joint in found)
        warn_caller(f"{path}: not enforced: joints {names} of a <gazebo> or loop_joint element")


def _check_root(root, what, path):
    if root is None or root.tag != "robot":
        told = "it has none" if root is None else f"its root is {root.tag!r}, not 'robot'"
        raise RobotError(f"{path}: not read as {what} ({told})")


def _warn_of_unread(tags, path):
    if tags:
        names = ", ".join(dict.fromkeys(re.sub(r"^\{.*\}", "xacro:" if "xacro" in tag else "", tag) for tag in tags))
        told = "; xacro expands a file" if "xacro" in names else ""
        warn_caller(f"{path}: not read: elements {names}{told}")


def _find_file(name, where, path) -> Path:
    """Find the file of a mesh beside the robot's file and above it: of a package with its folder and without."""
    given = (name or "").strip().replace("\\", "/")
    tails = [re.sub("^package:/+|^[a-z]+://", "", given)]
    if given.startswith(("package:", "model:")):
        tails.append(tails[0].partition("/")[2])
    for tail in (name, *tails, *map(unquote, tails)):
        for folder in (*path.absolute().parents, Path.cwd()):
            if tail and os.path.isfile(folder / tail):
                return folder / tail
    raise RobotError(f"{where}: no mesh file {name}")


def _load_shape(geometry, where, path):
    """Return vertices and faces of a shape, and what its mesh is scaled by, (3,)."""
    import trimesh

    if geometry.mesh is not None:
        file = _find_file(geometry.mesh.filename, where, path)
        try:
            mesh = load_mesh(file)
        except MeshError as error:
            raise RobotError(f"{where}: {first_line(error)}") from None
        scale = np.asarray(1.0 if geometry.mesh.scale is None else geometry.mesh.scale, np.float64)
        if scale.shape not in ((), (1,), (3,)) or not np.isfinite(scale).all():
            raise RobotError(f"{where}: scale {scale.tolist()} of a mesh is not 3 finite numbers")
        faces = np.delete(mesh.faces, mesh.dropped_faces, axis=0)
        return mesh.vertices, faces, np.broadcast_to(scale * _unit_of(file, where), 3)
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
    return np.asarray(made.vertices), np.asarray(made.faces), np.ones(3)


def _unit_of(file: Path, where) -> float:
    """Return the unit of a Collada file [m], 1 for files of other formats; raise RobotError if it is not positive."""
    _, kind, zipped = split_file_name(file)
    if kind == "zae":
        raise RobotError(f"{where}: {file.name} is an archive; unpack the .dae of it")
    if kind != "dae":
        return 1.0
    with gzip.open(file) if zipped else open(file, "rb") as stream:
        unit = ElementTree.parse(stream).getroot().find("{*}asset/{*}unit")
    given = "1" if unit is None else unit.get("meter", "1")
    try:
        meters = float(given)
    except ValueError:
        meters = math.nan
    if not 0 < meters < math.inf:
        raise RobotError(f"{where}: {file.name} has a unit of {given!r} meters")
    return meters


def _sizes(given, count, where) -> np.ndarray:
    """Return the sizes of a box, cylinder or sphere, checked."""
    sizes = np.array(given, np.float64)
    if sizes.shape != (count,) or not np.isfinite(sizes).all() or (sizes < 0).any():
        raise RobotError(f"{where}: sizes {sizes.tolist()} of a shape are not {count} finite numbers of at least 0")
    return sizes


def apply_srdf(description: Description, path: Path, strict: bool):
    """Exclude and demand the pairs that an SRDF file does, as MoveIt: what it disables goes over what it enables, and
    this over the links that it disables by default, whatever their order. A link that the robot has not is refused if
    `strict`, else warned of.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise RobotError(f"{path}: not read as SRDF ({first_line(error)})") from None
    _check_root(root, "SRDF", path)
    _warn_of_unread([entry.tag for entry in root if entry.tag not in SRDF_TAGS], path)
    links, unknown = list(description.links), {}

    def read(tag, *attributes):
        pairs = []
        for entry in root.findall(tag):
            names = [(entry.get(attribute) or "").strip() for attribute in attributes]
            if "" in names:
                raise RobotError(f"{path}: a {tag} without {attributes[names.index('')]}")
            missing = [name for name in names if name not in description.links]
            if missing and strict:
                told = f"{tag} names {missing[0]!r}, which is no link of the robot"
                raise RobotError(f"{path}: {told} (strict=False goes on)")
            unknown.update(dict.fromkeys(missing))
            pairs.append(frozenset(names))
        return pairs

    alone = {name for names in read("disable_default_collisions", "link") for name in names}
    enabled, disabled = (set(read(f"{what}_collisions", "link1", "link2")) for what in ("enable", "disable"))
    description.excluded |= disabled | {frozenset((name, other)) for name in alone for other in links}
    for i, part in enumerate(description.parts):
        for j in range(i):
            pair = frozenset((links[part.link], links[description.parts[j].link]))
            if pair in disabled:
                description.demanded.discard(frozenset((i, j)))
            elif pair in enabled:
                description.demanded.add(frozenset((i, j)))
    if unknown:
        warn_caller(f"{path}: what is said of {', '.join(map(repr, unknown))} is left out: no links of the robot")
