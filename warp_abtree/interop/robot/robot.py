"""`Robot`: the links of a URDF or MJCF file, posed and checked at many configurations.

A configuration holds a value of each of `joint_names` [rad, or the file's unit of length]. Frames are those of the
file: poses of links are in that of its root, and what surrounds the robot is placed in it.
"""

from pathlib import Path

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import (
    check_device,
    flag,
    is_device_array,
    to_numpy,
    whole_number,
    wrap_array,
)
from warp_abtree.interop.robot.check import RobotQuery, check_edges
from warp_abtree.interop.robot.description import Description, RobotError
from warp_abtree.interop.robot.mjcf import read_mjcf
from warp_abtree.interop.robot.surroundings import make_surroundings
from warp_abtree.interop.robot.urdf import read_disabled_pairs, read_urdf
from warp_abtree.kernels.base.arrays import NONE_REFUSED
from warp_abtree.kernels.robot import forward
from warp_abtree.model.model import Model
from warp_abtree.query.distance import check_beyond
from warp_abtree.scene.scene import Scene

ENDINGS = {".urdf": read_urdf, ".xml": read_mjcf, ".mjcf": read_mjcf}
# Configurations of a launch: fewer where few are given.
ROOMS = {"cpu": (16, 256, 4096), "cuda": (1024, 8192, 65536)}
# Stretches of an edge at a time, for the room of a chunk.
STRETCHES = 16
KEPT = 4  # surroundings whose arrays stay on the device


class Robot:
    """A robot on a device; `Robot.load` makes one of a file.

    Attributes:
        joint_names: Names of the joints that a configuration sets, in its order.
        limits: Least and greatest value of each, float64 (n, 2); infinite where there is none.
        link_names: Names of all links, in the order of `forward`.
        models: `Model` of each part: the mesh of a link, in the link's frame.
        model_link: Index into `link_names` of each model, int (m,).
        pairs: Pairs of models that are tested against one another, int (p, 2).
        mounted: Indices into `link_names` of the links that are not tested against what surrounds the robot.
        description: What the file says, `warp_abtree.interop.robot.description.Description`.
    """

    def __init__(self, description: Description, device=None, mounted=()):
        self.device = Scene(device).device
        self.description = description
        self.joint_names, self.link_names = tuple(description.joints), tuple(description.links)
        self.limits = np.array(list(description.joints.values()), np.float64).reshape(-1, 2)
        if not description.parts:
            raise RobotError("the robot has no link with a mesh")
        # Only the finest LOD is asked, so there is nothing to collapse.
        meshes = [part.mesh for part in description.parts]
        self.models = [Model.load(mesh, base_faces=len(mesh.faces)) for mesh in meshes]
        self.model_link = np.array([part.link for part in description.parts])
        self.pairs = np.array(description.allowed_pairs(), np.int64).reshape(-1, 2)
        if isinstance(mounted, str):
            raise TypeError(f"mounted: {mounted!r} is a name, not a list of names of links")
        unknown = set(mounted) - set(self.link_names)
        if unknown:
            raise ValueError(f"mounted: the robot has no link {sorted(unknown)[0]!r}")
        self.mounted = [self.link_names.index(name) for name in mounted]
        self._chain = description.make_chain(self.device)
        self._links = wp.array(np.array(list(description.links.values()), np.int32), device=self.device)
        self._kept: dict[tuple, RobotQuery] = {}

    @classmethod
    def load(cls, path, geometry="collision", device=None, mounted=(), srdf=None, neutral=None) -> "Robot":
        """Load a robot from a URDF (.urdf, by yourdfpy) or MJCF file (.xml, by MuJoCo).

        Joints may be fixed, revolute, continuous, prismatic, and mimic others. Of URDF, revolute and prismatic ones
        must have limits, 0 where one of two is not given. Tested against one another are all links but those that are
        rigidly joined, that a joint joins, or that the file (MJCF: `contact/exclude`, contype and conaffinity) or the
        SRDF excludes.

        Args:
            geometry: "collision" or "visual" meshes; boxes, cylinders and the like are tessellated. Of MJCF, "visual"
                are the geoms of groups 0 to 2, and meshes have vertices in float32, as MuJoCo compiles them.
            device: Warp device; None for Warp's default.
            mounted: Names of links that are never tested against what surrounds the robot, as a base that stands on it.
            srdf: Path of an SRDF file, whose `disable_collisions` exclude links.
            neutral: Configuration in which links that intersect are excluded, too; None for none.

        Raises:
            ImportError: The extra `robot` is not installed.
            ValueError: A file that is missing or unreadable, a joint or shape of another kind, a bad option; the
                message names it.
        """
        path = Path(path)
        if path.suffix.lower() not in ENDINGS:
            raise RobotError(f"{path}: a robot is a .urdf or .xml file")
        if geometry not in ("collision", "visual"):
            raise ValueError(f"geometry {geometry!r} is neither 'collision' nor 'visual'")
        for file in (path, *([] if srdf is None else [Path(srdf)])):
            if not file.is_file():
                raise RobotError(f"{file}: no such file")
        description = ENDINGS[path.suffix.lower()](path, geometry)
        if srdf is not None:
            description.excluded |= read_disabled_pairs(Path(srdf), set(description.links))
        robot = cls(description, device, mounted)
        if neutral is not None:
            robot.exclude_meeting(neutral)
        return robot

    def __repr__(self):
        faces = sum(model.face_count for model in self.models)
        return f"Robot({len(self.joint_names)} joints, {len(self.models)} models, {faces:,} faces)"

    def exclude_meeting(self, configuration):
        """Test models no more that intersect at a configuration, (n,), as neighbours may. Waits for the device."""
        poses = self.forward(np.asarray(configuration, np.float64)[None]).numpy()[0]
        scene = Scene(self.device)
        scene.add_many(self.models, poses[self.model_link])
        meet = scene.intersect(self.pairs).any
        self.pairs = self.pairs[~meet]
        self._kept.clear()

    def forward(self, configurations, limits=True) -> wp.array:
        """Return the poses of all links, device mat44d (c, links), in the frame of the root.

        Waits for the device once, for what is refused.

        Args:
            configurations: (c, n) of any framework; float64 on the robot's GPU is read where it lies.
            limits: Whether to refuse configurations out of limits.

        Raises:
            ValueError: Another shape, a number that is not finite, one out of its limits; the first is named.
        """
        check_device(self.device, "Robot.forward")
        rows = self._take(configurations, limits)
        frames = forward.Frames()
        shape = len(rows), len(self.description.frames)
        frames.rotation, frames.position = (
            wp.empty(shape, dtype=dtype, device=self.device) for dtype in (wp.mat33d, wp.vec3d)
        )
        poses = wp.empty((len(rows), len(self._links)), dtype=wp.mat44d, device=self.device)
        if len(rows):
            wp.launch(forward.forward_kernel, len(rows), [self._chain, rows, frames], device=self.device)
            wp.launch(forward.write_link_kernel, poses.shape, [self._links, frames, poses], device=self.device)
        return poses

    def check(self, configurations, world=None, output="any", beyond=None, limits=True):
        """Check whether parts intersect, each other or the world, at each configuration, or how far they are apart.

        Exactly, as `Scene.intersect`, for link poses as `forward` computes them. Waits for the device, once a chunk of
        4,096 configurations on the CPU, of 65,536 on a GPU; device arrays are kept for the next call.

        Args:
            configurations: (c, n) of any framework, see `forward`.
            world: What surrounds the robot: `Scene` of the robot's device, with the poses, LODs and solids that it has
                at the call; or a `Model`, or a list of models and pairs (model, pose); None for the robot alone.
            output: "any" or "distance".
            beyond: For "distance", what is farther apart is infinitely far [world units].
            limits: Whether to refuse configurations out of limits.

        Returns:
            For "any" bool (c,). For "distance" a structured array (c,) of distance, 0 where parts intersect; points (2,
            3), nearest on a part of the robot and on what it is nearest to, and faces (2,) that they lie on; pair (2,):
            the part's index into `models`, and that of the other one, or len(models) + object of the world. Where all
            is beyond, points are NaN and the others -1.

        Raises:
            TypeError, ValueError: Bad configurations, the first of which is named, a bad world or option.
        """
        if output not in ("any", "distance"):
            raise ValueError(f"output {output!r} is neither 'any' nor 'distance'")
        if beyond is not None and output != "distance":
            raise ValueError(f"beyond means nothing for output {output!r}")
        far = float(check_beyond(beyond))
        check_device(self.device, "Robot.check (RobotQuery.launch can)")
        rows = self._take(configurations, limits)
        return self._find_query(world, output, len(rows)).ask(rows, far)

    def check_edges(self, starts, ends, world=None, tolerance=1e-3, limits=True) -> np.ndarray:
        """Find when parts first touch on edges of a planner: all joints move evenly from start to end, in unit time.

        Stretches of an edge are proved free as wholes, with bounds on how far joints move each part from where it
        stands in the middle (`warp_abtree.kernels.robot.link_pairs`); others are halved. Waits for the device.

        Args:
            starts, ends: (e, n), as for `check`; continuous joints do not take the shorter way by themselves.
            world: As for `check`; nothing in it moves.
            tolerance: What a time may be early by, as a part of the edge, from 2^-30 up to below 1.

        Returns:
            Structured array (e,): time, from 0 to 1, parts are proved apart before; clear, whether they are for all of
            the edge; undecided, whether contact within the tolerance is neither proved nor excluded.

        Raises:
            TypeError, ValueError: As `check`.
        """
        check_device(self.device, "Robot.check_edges")
        first, last = (self._take(given, limits, what).numpy() for given, what in ((starts, "starts"), (ends, "ends")))
        if len(first) != len(last):
            raise ValueError(f"ends: {len(last)} given for {len(first)} starts")
        tolerance = to_numpy(tolerance, "tolerance")
        if tolerance.shape != () or not 2.0**-30 <= tolerance < 1:
            raise ValueError(f"tolerance: {tolerance} is no number of 2^-30 or more, below 1")
        query = self._find_query(world, "within", STRETCHES * len(first))
        return check_edges(query, first, last, float(tolerance))

    def query(self, world=None, output="any", room=4096) -> RobotQuery:
        """Return an operator for a fixed number of configurations, which a CUDA graph can capture: `RobotQuery`."""
        if output not in ("any", "distance"):
            raise ValueError(f"output {output!r} is neither 'any' nor 'distance'")
        check_device(self.device, "Robot.query")
        room = whole_number(room, "room", 1, 2**22)
        return RobotQuery(self, make_surroundings(world, self.device)[0], output, room)

    def _take(self, configurations, limits, what="configurations") -> wp.array:
        """Return configurations as device rows, float64 (c, n), checked. Waits for the device."""
        limits = flag(limits, "limits")
        width = len(self.joint_names)
        if is_device_array(configurations) and wrap_array(configurations, what).device == self.device:
            rows = wrap_array(configurations, what)
            if rows.dtype != wp.float64 and rows.dtype == wp.float32:
                rows = wp.array(rows.numpy().astype(np.float64), device=self.device)
            rows = rows if rows.is_contiguous else rows.contiguous()
        else:
            numbers = np.ascontiguousarray(to_numpy(configurations, what), np.float64)
            dims = numbers.ndim == 2
            rows = wp.array(numbers, dtype=wp.float64, device=self.device) if dims and len(numbers) else numbers
        if len(rows.shape) != 2 or rows.shape[1] != width:
            raise ValueError(f"{what}: shape {tuple(rows.shape)}, not (c, {width}), a value of each joint")
        if len(rows) == 0:
            return wp.empty((0, width), dtype=wp.float64, device=self.device)
        first = wp.full(1, NONE_REFUSED, dtype=wp.int32, device=self.device)
        inputs = [int(limits), len(rows), self._chain, rows, first]
        wp.launch(forward.check_configuration_kernel, len(rows), inputs, device=self.device)
        bad = int(first.numpy()[0])
        if bad != NONE_REFUSED:
            self._refuse(rows[bad : bad + 1].numpy()[0], bad, what)
        return rows

    def _refuse(self, row, i, what):
        """Raise ValueError about the first value of a configuration that is none."""
        for name, value, (low, high) in zip(self.joint_names, row.tolist(), self.limits.tolist(), strict=True):
            if not abs(value) < forward.ANGLE_MAX:
                raise ValueError(f"{what}: {what[:-1]} {i} has {value} for joint {name!r}")
            if not low <= value <= high:
                raise ValueError(
                    f"{what}: {what[:-1]} {i} has {value:.6g} for joint {name!r}, outside {low:.6g} .. {high:.6g} "
                    "(limits=False takes it)"
                )
        raise AssertionError("a configuration that was refused")

    def _find_query(self, world, output, count) -> RobotQuery:
        """Return a query of a room for a number of configurations: the one of before if it is of the same."""
        around, key = make_surroundings(world, self.device)
        rooms = ROOMS["cpu" if self.device.is_cpu else "cuda"]
        room = next((room for room in rooms if room >= count), rooms[-1])
        query = self._kept.pop((key, output, room), None)
        if query is None or not query.is_of(around):
            query = RobotQuery(self, around, output, room)
        self._kept[key, output, room] = query
        for old in list(self._kept)[:-KEPT]:
            del self._kept[old]
        return query
