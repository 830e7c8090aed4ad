"""`Robot`: the links of a URDF or MJCF file, posed and checked at many configurations.

A configuration holds a value of each of `joint_names` [rad, or the file's unit of length]: one is of shape (n,), many
(c, n), and answers about one have no leading axis. Poses of links are in the world, in which `base` places the frame of
the file's root, and what surrounds the robot its objects.
"""

from pathlib import Path

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import (
    check_device,
    finite_array,
    flag,
    is_device_array,
    to_numpy,
    whole_number,
    wrap_array,
)
from warp_abtree.checks.upload import zeros_of
from warp_abtree.interop.robot.check import RobotQuery, check_edges
from warp_abtree.interop.robot.description import Description, RobotError, read_pose
from warp_abtree.interop.robot.files import read_robot
from warp_abtree.interop.robot.link_parts import padding_of, tested_pairs
from warp_abtree.interop.robot.surroundings import STILL, make_surroundings
from warp_abtree.kernels.robot import forward
from warp_abtree.model.model import Model
from warp_abtree.query.stages.distance import check_beyond
from warp_abtree.scene.objects import check_models, check_object_names
from warp_abtree.scene.scene import Scene

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
        attached: Names of those of them that are attached models.
        models: `Model` of each part: the mesh of a link, in the link's frame.
        model_link: Index into `link_names` of each model, int (m,).
        pairs: Pairs of indices into `models` that are tested against one another, int (p, 2).
        mounted: Indices into `link_names` of the links that are not tested against what surrounds the robot.
        link_padding: Distances [world units] that are added to the shapes of links in `check` and `check_edges`, a dict
            by name, none at first: links meet within the sum of both, a link and an object of the world within its own.
        description: What it is made of, `warp_abtree.interop.robot.description.Description`.

    `pairs`, `mounted` and `link_padding` may be set: each call goes by what they are then. A copy, or what is
    unpickled, is made anew from the description, on the same device, with these.
    """

    def __init__(self, description: Description, device=None, mounted=()):
        self.device = Scene(device).device
        if not description.parts:
            raise RobotError("the robot has no link with a mesh")
        # Only the finest LOD is asked, so there is nothing to collapse.
        self.models = [
            part.mesh if isinstance(part.mesh, Model) else Model.load(part.mesh, base_faces=len(part.mesh.faces))
            for part in description.parts
        ]
        self.pairs = np.array(description.allowed_pairs(), np.int64).reshape(-1, 2)
        self._describe(description)
        self.mounted: list[int] = []
        self.link_padding: dict[str, float] = {}
        body = description.bodies()[list(description.links.values())]
        for k in self._find_links(mounted, "mounted"):
            fixed = [k] if k in self.model_link else np.flatnonzero(body == body[k]).tolist()
            if not np.isin(fixed, self.model_link).any():
                raise ValueError(f"mounted: no mesh is fixed to the link {self.link_names[k]!r}")
            self.mounted += [link for link in fixed if link not in self.mounted]

    def _describe(self, description: Description):
        """Go by a description from now on; queries are made anew."""
        self.description = description
        self.joint_names, self.link_names = tuple(description.joints), tuple(description.links)
        self.limits = np.array(list(description.joints.values()), np.float64).reshape(-1, 2)
        self.attached, self.model_link = description.attached(), np.array([part.link for part in description.parts])
        self._chain = description.make_chain(self.device)
        self._links = wp.array(np.array(list(description.links.values()), np.int32), device=self.device)
        self._kept: dict[tuple, RobotQuery] = {}

    @classmethod
    def load(
        cls,
        path,
        geometry="collision",
        device=None,
        mounted=(),
        srdf=None,
        neutral=None,
        strict=True,
        base=STILL,
        locked=None,
    ) -> "Robot":
        """Load a robot from a URDF (.urdf, by yourdfpy) or MJCF file (.xml, by MuJoCo).

        Joints may be fixed, revolute, continuous, prismatic, and mimic others; planar, floating and free ones have
        values "joint/x" and so on (`description.COORDINATES`). Tested against one another are all links but those that
        are rigidly joined, that a joint joins, a floating one apart, or that the file or the SRDF excludes; of MJCF,
        "collision" has MuJoCo's pairs. The guide on robots tells all that is read of the files.

        Args:
            geometry: "collision" or "visual" meshes; boxes, cylinders and the like are tessellated. Of MJCF, "visual"
                are the geoms of groups 0 to 2, and meshes have vertices in float32, as MuJoCo compiles them.
            device: Warp device; None for Warp's default.
            mounted: Names of links that are never tested against what surrounds the robot, as a base that stands on it.
                One without a mesh stands for all links that are rigidly fixed to it, of which one must have one.
            srdf: Path of an SRDF file: pairs that `disable_collisions` names are excluded, others that
                `enable_collisions` names are tested, whatever else holds, and of the rest those are excluded with a
                link of `disable_default_collisions`.
            neutral: Configuration in which links that intersect are excluded, too; None for none.
            strict: Whether to refuse an SRDF that names links which the robot has not, rather than warn.
            base: Pose of the file's root in the world, 7 numbers or a rigid (4, 4), as for `Scene.add`.
            locked: Values of joints that are fixed at them, by name, and no longer of a configuration.

        Warns of what ties links beside their joints, which is not enforced, and of elements that are not read.

        Raises:
            ImportError: The extra `robot` is not installed.
            ValueError: A file that is missing or unreadable, or has no mesh of this geometry, a joint or shape of
                another kind, a bad option; the message names it.
        """
        base = read_pose(base, "base")
        description = read_robot(Path(path), geometry, None if srdf is None else Path(srdf), flag(strict, "strict"))
        description.place(base)
        robot = cls(description, device, mounted)
        robot._lock({} if locked is None else locked)
        if neutral is not None:
            robot.exclude_meeting(neutral)
        return robot

    def _lock(self, values):
        """Fix joints at values, by name."""
        if not isinstance(values, dict):
            raise TypeError(f"locked: a {type(values).__name__} is no dict of values by the names of joints")
        row = np.clip(0.0, *self.limits.T)
        for name, value in values.items():
            if name not in self.joint_names:
                raise ValueError(f"locked: a configuration has no joint {name!r}")
            row[self.joint_names.index(name)] = finite_array(value, f"locked joint {name!r}", ())
        if fault := self._find_fault(wp.array(row[None], dtype=wp.float64, device=self.device), True):
            raise ValueError(f"locked: {fault[1]}")
        self.description.lock({name: float(row[self.joint_names.index(name)]) for name in values})
        self._describe(self.description)

    def _find_links(self, names, what: str) -> list[int]:
        """Return the indices of links of names."""
        if isinstance(names, str) or not np.iterable(names):
            kind = "a name" if isinstance(names, str) else f"a {type(names).__name__}"
            raise TypeError(f"{what}: {names!r} is {kind}, not a list of names of links")
        for name in names:
            if name not in self.link_names:
                raise ValueError(f"{what}: the robot has no link {name!r}")
        return [self.link_names.index(name) for name in names]

    def __reduce__(self):
        kept = {"pairs": self.pairs, "mounted": self.mounted, "link_padding": self.link_padding}
        return type(self), (self.description, self.device.alias), kept

    def __repr__(self):
        faces = sum(model.face_count for model in self.models)
        return f"Robot({len(self.joint_names)} joints, {len(self.models)} models, {faces:,} faces)"

    def exclude_meeting(self, configuration):
        """Test models no more that intersect at a configuration, (n,), as neighbours may. Waits for the device."""
        scene = Scene(self.device)
        self.add_to(scene, configuration)
        pairs = tested_pairs(self)
        self.pairs = pairs[~scene.intersect(pairs).any]

    def attach(self, model: Model, link: str, pose=STILL, name: str | None = None, touches=()):
        """Fix a model to a link that holds it: it is the last link then, and tested at its finest LOD.

        That is against what surrounds the robot and all links but those that are rigidly fixed to the one that holds
        it. Operators of `query` go by what was attached when they were made.

        Args:
            pose: Of the model in the link's frame, 7 numbers or a rigid (4, 4).
            name: Of the new link; None for the model's.
            touches: Names of links that it is not tested against, as the fingers that grip it.

        Raises:
            TypeError, ValueError: Bad arguments, a name that a link has; nothing is changed.
        """
        check_models(model, 1)
        name = model.name if name is None else name
        check_object_names([name], 1)
        if name in self.link_names:
            raise ValueError(f"attach: the robot has a link {name!r} already")
        self._find_links([link], "attach")
        touched, pairs = self._find_links(touches, "touches"), tested_pairs(self)
        description = self.description.with_model(name, model, link, read_pose(pose, "pose"))
        body = description.bodies()[list(description.links.values())]
        tested = np.flatnonzero((body[self.model_link] != body[-1]) & ~np.isin(self.model_link, touched))
        self.pairs = np.concatenate([pairs, np.column_stack([tested, np.full(len(tested), len(self.models))])])
        self.models = [*self.models, model]
        self._describe(description)

    def detach(self, name: str):
        """Take an attached model away; raise ValueError if there is none, or others are attached to it."""
        description, pairs = self.description.without_model(name), tested_pairs(self)
        link = self.link_names.index(name)
        k = self.model_link.tolist().index(link)
        self.mounted = [other - (other > link) for other in self.mounted if other != link]
        self.link_padding = {other: self.link_padding[other] for other in self.link_padding if other != name}
        self.models, pairs = self.models[:k] + self.models[k + 1 :], pairs[(pairs != k).all(1)]
        self.pairs = pairs - (pairs > k)
        self._describe(description)

    def add_to(self, scene: Scene, configuration) -> np.ndarray:
        """Add the links at a configuration, (n,), to a scene, and return their indices there, one of each of `models`.

        Objects have the names of links; pairs that the robot does not test are filtered there.

        Raises:
            TypeError, ValueError: No scene, or a bad configuration; nothing is added.
        """
        if not isinstance(scene, Scene):
            raise TypeError(f"add_to: a {type(scene).__name__} is no Scene")
        poses = self.forward(configuration)
        if poses.ndim != 1:
            raise ValueError(f"add_to: {len(poses)} configurations, not one of shape ({len(self.joint_names)},)")
        pairs, names = tested_pairs(self), [self.link_names[k] for k in self.model_link]
        added = scene.add_many(self.models, poses.numpy()[self.model_link], names=names)
        tested = np.eye(len(added), dtype=bool)
        tested[tuple(pairs.T)] = tested[tuple(pairs.T[::-1])] = True
        scene.filter(added[np.argwhere(~tested)])
        return added

    def forward(self, configurations, limits=True) -> wp.array:
        """Return the poses of all links in the world, device mat44d (c, links), or (links,) of one configuration.

        Waits for the device once, for what is refused.

        Args:
            configurations: (c, n) or (n,) of any framework; float64 on the robot's GPU is read where it lies.
            limits: Whether to refuse configurations out of limits. What is beyond a limit by no more than 2^-51 of the
                greater one, 2^-22 if it is a float32 number, as rounding puts it there, is within, and taken as it is.

        Raises:
            ValueError: Another shape, a number that is not finite, one out of its limits; the first is named.
        """
        check_device(self.device, "Robot.forward")
        rows, is_one = self._take(configurations, limits)
        frames = zeros_of(forward.Frames, len(rows), len(self.description.frames), self.device)
        poses = wp.empty((len(rows), len(self._links)), dtype=wp.mat44d, device=self.device)
        if len(rows):
            wp.launch(forward.forward_kernel, len(rows), [self._chain, rows, frames], device=self.device)
            wp.launch(forward.write_link_kernel, poses.shape, [self._links, frames, poses], device=self.device)
        return poses[0] if is_one else poses

    def check(self, configurations, world=None, output="any", beyond=None, limits=True, which=False):
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
            which: Whether to return, of "any", the pairs that intersect.

        Returns:
            For "any" bool (c,); with `which` a sorted list of pairs of names for each configuration, each pair once: a
            link, and a later one or an object of the world (`Scene.name`). For "distance" a structured array (c,) of
            distance, 0 where parts intersect; points (2, 3), nearest on a part of the robot and on what it is nearest
            to, and faces (2,) that they lie on; pair (2,): the part's index into `models`, and that of the other one,
            or len(models) + object of the world; and their names (2,). Where all is beyond, points are NaN, names
            empty, and the others -1.

        Raises:
            TypeError, ValueError: Bad configurations, the first of which is named, a bad world or option.
        """
        if output not in ("any", "distance"):
            raise ValueError(f"output {output!r} is neither 'any' nor 'distance'")
        if beyond is not None and output != "distance":
            raise ValueError(f"beyond means nothing for output {output!r}")
        if flag(which, "which") and output != "any":
            raise ValueError(f"which means nothing for output {output!r}")
        far = float(check_beyond(beyond))
        check_device(self.device, "Robot.check (RobotQuery.launch can)")
        rows, is_one = self._take(configurations, limits)
        answers = self._find_query(world, "pairs" if which else output, len(rows)).ask(rows, far)
        return answers[0] if is_one else answers

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
            the edge; undecided, whether contact within the tolerance of the time is neither proved nor excluded. The
            same bits for an edge alone and in any batch.

        Raises:
            TypeError, ValueError: As `check`.
        """
        check_device(self.device, "Robot.check_edges")
        (first, is_one), (last, also) = self._take(starts, limits, "starts"), self._take(ends, limits, "ends")
        if len(first) != len(last):
            raise ValueError(f"ends: {len(last)} given for {len(first)} starts")
        tolerance = to_numpy(tolerance, "tolerance")
        if tolerance.shape != () or not 2.0**-30 <= tolerance < 1:
            raise ValueError(f"tolerance: {tolerance} is no number of 2^-30 or more, below 1")
        query = self._find_query(world, "within", STRETCHES * len(first))
        rows = check_edges(query, first.numpy(), last.numpy(), float(tolerance))
        return rows[0] if is_one and also else rows

    def query(self, world=None, output="any", room=4096) -> RobotQuery:
        """Return an operator for a fixed number of configurations, which a CUDA graph can capture: `RobotQuery`."""
        if output not in ("any", "distance"):
            raise ValueError(f"output {output!r} is neither 'any' nor 'distance'")
        check_device(self.device, "Robot.query")
        room = whole_number(room, "room", 1, 2**22)
        return RobotQuery(self, make_surroundings(world, self.device)[0], output, room)

    def _take(self, configurations, limits, what="configurations") -> tuple[wp.array, bool]:
        """Return configurations as checked device rows, float64 (c, n), and whether one was given. Waits for it."""
        limits = flag(limits, "limits")
        width = len(self.joint_names)
        given = wrap_array(configurations, what) if is_device_array(configurations) else None
        if given is not None and given.device == self.device and given.dtype == wp.float64:
            numbers = given if given.is_contiguous else given.contiguous()
        else:
            numbers = np.asarray(to_numpy(configurations, what), np.float64, order="C")
        if len(numbers.shape) not in (1, 2) or numbers.shape[-1] != width:
            shape = tuple(numbers.shape)
            raise ValueError(f"{what}: shape {shape}, not (c, {width}) or ({width},), a value of each joint")
        is_one = len(numbers.shape) == 1
        rows = numbers.reshape((1, width)) if is_one else numbers
        if len(rows) == 0:
            return wp.empty((0, width), dtype=wp.float64, device=self.device), False
        if not isinstance(rows, wp.array):
            rows = wp.array(rows, dtype=wp.float64, device=self.device)
        if fault := self._find_fault(rows, limits):
            hint = " (limits=False takes it)" if "outside" in fault[1] else ""
            raise ValueError(f"{what}: {what[:-1]} {fault[0]} has {fault[1]}{hint}")
        return rows, is_one

    def _find_fault(self, rows, limits) -> tuple[int, str] | None:
        """Return the first of device rows that has a bad value, and what is wrong with it. Waits for the device."""
        first = wp.full(1, int(forward.NO_BAD_NUMBER), dtype=wp.int64, device=self.device)
        inputs = [int(limits), len(rows), self._chain, rows, first]
        wp.launch(forward.check_configuration_kernel, len(rows), inputs, device=self.device)
        bad = int(first.numpy()[0])
        if bad == int(forward.NO_BAD_NUMBER):
            return None
        i, k = divmod(bad, len(self.joint_names))
        value = float(rows[i : i + 1].numpy()[0, k])
        low, high = map(exact, self.limits[k])
        most = float(forward.ANGLE_MAX)
        wrong = f"outside {low} .. {high}" if abs(value) < most else f"no finite number within {most:.0f}"
        return i, f"{exact(value)} for joint {self.joint_names[k]!r}, {wrong}"

    def _find_query(self, world, output, count) -> RobotQuery:
        """Return a query of a room for a number of configurations: the one of before if it is of the same."""
        around, key = make_surroundings(world, self.device)
        key = (*key, tested_pairs(self).tobytes(), tuple(self.mounted), padding_of(self).tobytes())
        rooms = ROOMS["cpu" if self.device.is_cpu else "cuda"]
        room = next((room for room in rooms if room >= count), rooms[-1])
        query = self._kept.pop((key, output, room), None)
        if query is None or not query.is_of(around):
            query = RobotQuery(self, around, output, room)
        self._kept[key, output, room] = query
        for old in list(self._kept)[:-KEPT]:
            del self._kept[old]
        return query


def exact(number) -> str:
    """Return a number with the fewest digits that tell it from every other."""
    return str(float(number)).removesuffix(".0")
