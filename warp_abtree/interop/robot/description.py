"""Description of a robot, whatever its file format: frames and joints, links, parts, and pairs never tested."""

from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from warp_abtree.checks.arguments import to_numpy
from warp_abtree.checks.quaternions import matrices_of
from warp_abtree.checks.upload import struct_of
from warp_abtree.kernels.robot import forward
from warp_abtree.model.mesh import Mesh, load_mesh
from warp_abtree.model.model import Model
from warp_abtree.scene.objects import ALL_BITS
from warp_abtree.state.poses import check_poses

JOINT_KINDS = {"fixed": int(forward.FIXED), "revolute": int(forward.REVOLUTE), "prismatic": int(forward.PRISMATIC)}

# What a configuration sets of a joint with several values, as "joint/x" and so on; of a floating one as URDF's xyz rpy.
COORDINATES = {"planar": ("x", "y", "angle"), "floating": ("x", "y", "z", "roll", "pitch", "yaw")}


class RobotError(ValueError):
    """A robot's file that is missing, unreadable, or holds what is not supported; the message names what and where."""


@dataclass
class RobotFrame:
    """A frame: its parent's, moved by a fixed transform, then by a joint."""

    parent: int  # index of an earlier frame, -1 for none
    origin: np.ndarray  # fixed transform, float64 (4, 4), rigid [robot units]
    kind: str = "fixed"  # or "revolute" or "prismatic"
    axis: tuple = (0.0, 0.0, 1.0)  # of the joint, unit, (3,)
    joint: str | None = None  # name of the joint whose value moves it, None where it is fixed
    scale: float = 1.0  # value of this joint = scale * that of `joint` + offset
    offset: float = 0.0


@dataclass
class Part:
    """Mesh of a link, in the link's frame, and the bits of MJCF that say which others it meets."""

    link: int
    mesh: Mesh | Model  # a model if it is attached, and no link of the file
    group: int = 1
    mask: int = ALL_BITS


@dataclass
class Description:
    """A robot as its file describes it."""

    frames: list[RobotFrame] = field(default_factory=list)  # parents first
    # Limits (lower, upper) by the name of each joint that a configuration sets, in order [rad or robot units].
    joints: dict[str, tuple[float, float]] = field(default_factory=dict)
    links: dict[str, int] = field(default_factory=dict)  # index of the frame of each link, by its name
    parts: list[Part] = field(default_factory=list)  # of links: a link has none, one, or several whose bits differ
    excluded: set[frozenset] = field(default_factory=set)  # pairs of names of links that are never tested
    demanded: set[frozenset] = field(default_factory=set)  # pairs of indices of parts that are tested, whatever else
    # Links that a joint joins and that are not tested: "all", "moving" if both move against the root, "none".
    neighbours: str = "all"
    loose: set[int] = field(default_factory=set)  # frames of floating joints, which join nothing

    def add_coordinates(self, joint: str, kind: str):
        """Let a configuration set the values of a joint of `COORDINATES`, without limits."""
        self.joints |= {f"{joint}/{name}": (-np.inf, np.inf) for name in COORDINATES[kind]}

    def add_joint_frames(self, parent: int, origin: np.ndarray, joint: str, kind: str, axis=(0.0, 0.0, 1.0)):
        """Add the frames of a joint of `COORDINATES`, a slide or a turn each; the link's is the last.

        A planar joint slides along x and y, then turns, in the plane across its axis: x is what the coordinate axis
        that follows the one nearest to the axis, in the order x y z x, leaves in the plane, and y axis cross x.
        """
        if kind == "planar":
            u = np.eye(3)[(np.argmax(np.abs(axis)) + 1) % 3]
            u = unit_axis(u - np.dot(u, axis) * np.array(axis), joint)
            axes = {"x": u, "y": tuple(np.cross(axis, u)), "angle": axis}
        else:
            x, y, z = map(tuple, np.eye(3))
            axes = {"x": x, "y": y, "z": z, "yaw": z, "pitch": y, "roll": x}
        for name, along in axes.items():
            moves = "prismatic" if len(name) == 1 else "revolute"
            self.frames.append(RobotFrame(parent, origin, moves, along, f"{joint}/{name}"))
            parent, origin = len(self.frames) - 1, np.eye(4)
        if kind == "floating":
            self.loose.add(parent)

    def bodies(self) -> np.ndarray:
        """Return the rigid body of each frame, int (frames,): the frame from which on no joint moves it."""
        body = np.arange(len(self.frames))
        for f, frame in enumerate(self.frames):
            if frame.kind == "fixed":
                body[f] = body[frame.parent] if frame.parent >= 0 else -1
        return body

    def place(self, base: np.ndarray):
        """Move all roots by a rigid transform (4, 4): frames are then in the world that it places the robot in."""
        for frame in self.frames:
            if frame.parent < 0:
                frame.origin = base @ frame.origin

    def lock(self, values: dict[str, float]):
        """Fix joints at values, and what mimics them. Pairs stay: a locked joint joins its links as one that moves."""
        for frame in self.frames:
            if frame.joint in values:
                frame.offset, frame.joint = frame.offset + frame.scale * values[frame.joint], None
        self.joints = {name: limits for name, limits in self.joints.items() if name not in values}

    def attached(self) -> tuple[str, ...]:
        """Return the names of links that are attached models."""
        return tuple(list(self.links)[part.link] for part in self.parts if isinstance(part.mesh, Model))

    def with_model(self, name: str, model: Model, link: str, pose: np.ndarray) -> "Description":
        """Return it with a model that is fixed to a link, a link itself, the last."""
        frames, links = [*self.frames, RobotFrame(self.links[link], pose)], self.links | {name: len(self.frames)}
        return replace(self, frames=frames, links=links, parts=[*self.parts, Part(len(self.links), model)])

    def without_model(self, name: str) -> "Description":
        """Return it without an attached model; raise ValueError if there is none, or others are attached to it."""
        if name not in self.attached():
            raise ValueError(f"detach: no attached model has the name {name!r}")
        for other in self.attached():
            if self.frames[self.links[other]].parent == self.links[name]:
                raise ValueError(f"detach: {other!r} is attached to {name!r}")
        f, k = self.links[name], list(self.links).index(name)
        frames = [replace(frame, parent=frame.parent - (frame.parent > f)) for frame in self.frames]
        parts = [replace(part, link=part.link - (part.link > k)) for part in self.parts if part.link != k]
        links = {other: at - (at > f) for other, at in self.links.items() if other != name}
        return replace(self, frames=frames[:f] + frames[f + 1 :], links=links, parts=parts)

    def path(self, f: int) -> list[int]:
        """Return a frame and those that it hangs on, up to a root."""
        found = []
        while f >= 0:
            found.append(f)
            f = self.frames[f].parent
        return found

    def allowed_pairs(self) -> list[tuple[int, int]]:
        """Return the pairs of parts that are tested: neither rigidly joined nor of links that a joint joins.

        Links without a joint between them are one body; what the file excludes, or its bits forbid, is not tested. What
        it demands is, all the same.
        """
        body, names = self.bodies(), list(self.links)
        frames = [self.links[names[part.link]] for part in self.parts]

        with_links = {-1, *(body[f] for f in self.links.values())}

        def holder(b):  # body that a body's joint hangs on; joints in a row, without links between them, are one
            if b in self.loose:
                return None
            parent = self.frames[b].parent
            while parent >= 0 and body[parent] not in with_links:
                parent = self.frames[body[parent]].parent
            return body[parent] if parent >= 0 else -1

        found = []
        for i, a in enumerate(self.parts):
            for j in range(i):
                b = self.parts[j]
                x, y = body[frames[i]], body[frames[j]]
                joined = (x >= 0 and holder(x) == y) or (y >= 0 and holder(y) == x)
                exempt = self.neighbours == "none" or (self.neighbours == "moving" and min(x, y) < 0)
                told = frozenset((names[a.link], names[b.link])) in self.excluded
                tested = x != y and (exempt or not joined) and not told and (a.group & b.mask or b.group & a.mask)
                if tested or frozenset((i, j)) in self.demanded:
                    found.append((j, i))
        return found

    def make_chain(self, device) -> forward.Chain:
        """Return the frames as device arrays."""
        columns, frames = {name: k for k, name in enumerate(self.joints)}, self.frames
        origins, limits = np.array([frame.origin for frame in frames]), np.array([*self.joints.values()], np.float64)
        lower, upper = limits.reshape(-1, 2).T
        return struct_of(
            forward.Chain,
            device,
            parent=[frame.parent for frame in frames],
            kind=[JOINT_KINDS[frame.kind] for frame in frames],
            column=[-1 if frame.joint is None else columns[frame.joint] for frame in frames],
            scale=[frame.scale for frame in frames],
            offset=[frame.offset for frame in frames],
            axis=[frame.axis for frame in frames],
            rotation=origins[:, :3, :3],
            position=origins[:, :3, 3],
            lower=lower,
            upper=upper,
        )


def unit_axis(axis, what: str) -> tuple:
    """Return an axis of unit length; raise RobotError for one without a length, or that is not finite."""
    axis = np.asarray(axis, np.float64)
    size = np.linalg.norm(axis)
    if axis.shape != (3,) or not (np.isfinite(size) and size > 1e-12):
        raise RobotError(f"{what}: {axis.tolist()} is no axis")
    return tuple(axis / size)


def check_names(names: list[str], what: str, path: Path):
    """Raise RobotError where a name of links or joints comes again."""
    for name, count in Counter(names).items():
        if count > 1:
            raise RobotError(f"{path}: {count} {what} have the name {name!r}")


def check_rigid(matrix, what: str) -> np.ndarray:
    """Return a transform as float64 (4, 4), identity for None; raise RobotError if it is not rigid."""
    matrix = np.eye(4) if matrix is None else np.asarray(matrix, np.float64)
    rotation = matrix[:3, :3]
    fine = np.isfinite(matrix).all() and np.abs(rotation.T @ rotation - np.eye(3)).max() < 1e-12
    if not fine or np.linalg.det(rotation) < 0:
        raise RobotError(f"{what}: its transform is not rigid")
    return matrix


def read_pose(pose, what: str) -> np.ndarray:
    """Return a pose, 7 numbers or a matrix, as a rigid (4, 4), by the rotation nearest to a matrix within 1e-6 of one.

    Raises ValueError as `check_poses`.
    """
    (pose,), matrix = check_poses(to_numpy(pose, what)[None], what), np.eye(4)
    if pose.ndim == 1:
        matrix[:3, :3], matrix[:3, 3] = matrices_of(pose[None, 3:])[0], pose[:3]
    else:
        u, _, v = np.linalg.svd(pose[:3, :3])
        matrix[:3, :3], matrix[:3, 3] = u @ v, pose[:3, 3]
    return matrix


def join_meshes(placed, name: str) -> Mesh:
    """Return meshes (vertices, faces, transform) as one where these put them; raise MeshError if they make none."""
    import trimesh

    scene = trimesh.Scene()
    for vertices, faces, transform in placed:
        scene.add_geometry(trimesh.Trimesh(vertices, faces, process=False), transform=transform)
    return load_mesh(scene, name)
