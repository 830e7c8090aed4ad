"""Least distances of surfaces, nearest points and depths: `DistanceQuery`.

The distance of an object pair is the least distance of a point of one surface, at its LOD, from a point of the other.
It is 0 if and only if the surfaces intersect, which the exact test decides. For each pair, in the order in which it
names its objects:

* distance [world units]: of a pair of points, one of each surface; with the default tolerance the least there is but
  for rounding. 0 where the surfaces intersect, infinite where they are proved farther apart than `beyond`.
* bracket [world units]: lower and upper bound between which the least distance lies, proven for the poses as real
  numbers and all rounding (`warp_abtree.kernels.distance.frame`): the bounds are within about 1e-13 of the sizes of
  models and poses from `distance`, or within what the tolerance asks if that is more. (0, 0) where the surfaces
  intersect, (`beyond`, infinite) where they are proved farther apart.
* points [world units]: the nearest points. Where the surfaces intersect, one point of both, twice: the middle of what
  two faces share, as accurate as a contact (`query.stages.contacts`).
* point_faces: the faces that they lie on. Of equally near face pairs the one with the lowest face of the object with
  the smaller index, then of the other; where the surfaces intersect, some pair that does.
* gradient: the derivative of the distance with respect to the translation [-] and the rotation vector [world units]
  about its origin, world axes, of the first object and of the second: of both nearest points as if they stayed on their
  objects, (-n, -(p - c) x n) and (n, (q - c) x n), n the unit vector from the first to the second. Where other points
  are as near it is an element of the generalised gradient (Clarke's), between the slopes to either side. Zero where the
  distance is 0, or infinite, as it is where it stays so; touching surfaces are also a minimum of the distance there.

With `signed`, a pair of which one object lies inside the other, a solid (`Scene.add`), by some of its points has a
negative distance. The depth of a point is its distance from the other's surface; looked at are corners of faces,
middles of edges and centroids of faces, of both objects if both are solids. The greatest depth is that of the pair:

* distance is minus the depth; bracket holds it as above.
* points are the point inside and the point of the other surface that is nearest to it, in the order of the pair, and
  point_faces the faces that they lie on. From the point inside to the other is its way out.
* gradient as above, n then the other way, so that its opposite leads out; zero where distance is 0.

Depth is a lower bound of the penetration depth, the length of the shortest motion that frees the objects, however many
faces are submerged, and that length for a body pressed into a flat floor or a peg that is too thick for its hole. Where
solids cross and none of these points is inside, distance is 0. Pairs of which no object is a solid are refused.

With the default tolerance, all of this is the same, bit for bit, on CPU and CUDA, whatever the search has started from.
With a tolerance points, faces and distance may also depend on what the last launch found.

With `originals=True` (`Scene.intersect`, `sweep`) all of this, `any` too, is of the original meshes, whatever the LODs
of their objects, as the finest LODs answer it: tree states there are made at the first such query, and stay.
"""

import math
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import flag, to_numpy
from warp_abtree.checks.cpu_threads import launch_on_cores
from warp_abtree.checks.kernel_loading import loading
from warp_abtree.checks.regime import current_regime
from warp_abtree.kernels.base.lanes import WARP_SIZE
from warp_abtree.kernels.distance import crossing, frame, gradient, report, search, search_simd
from warp_abtree.kernels.inside.containment import report_contained_kernel
from warp_abtree.kernels.inside.depth import find_depth_kernel
from warp_abtree.kernels.search import mean_slabs
from warp_abtree.query.commands import Commands
from warp_abtree.query.operator import Operator
from warp_abtree.query.request import check_within, refuse_signed
from warp_abtree.query.result import DISTANCES, Found
from warp_abtree.query.stage import Array, PairDistance, Rooms, Stage, fields
from warp_abtree.query.stages.inside import InsideStage
from warp_abtree.query.stages.intersect import IntersectStage
from warp_abtree.query.staging import first_rows

# Pairs that make a further core worth its while, which costs some 50 us.
PAIRS_A_CORE = 4
NOT_BEYOND = np.array(np.inf)  # one for all, so that it is known again at once
NOT_BEYOND.flags.writeable = False
ANSWER_FIELDS = {"point_faces": "faces"}  # of `report.Distances`, where a result's name is another
CROSSING_KERNELS = [crossing.search_crossing_kernel, crossing.report_crossing_kernel]


def check_beyond(beyond, pair_count=None) -> np.ndarray:
    """Return distances that end a search, as `check_within`; `NOT_BEYOND` for None."""
    if beyond is None or (isinstance(beyond, np.ndarray) and beyond.shape == () and beyond == np.inf):
        return NOT_BEYOND
    return check_within(beyond, pair_count, "beyond")


def check_tolerances(tolerance=0.0, relative=0.0) -> tuple[float, float]:
    """Return the tolerances of a search; raise ValueError for no number from 0 up, a relative one below 1."""
    for name, asked, most in (("tolerance", tolerance, math.inf), ("relative", relative, 1.0)):
        # Plain numbers, as most are, in a tenth of the time.
        value = asked if type(asked) is float else to_numpy(asked, name)
        if np.ndim(value) or not 0 <= value < most:
            raise ValueError(f"{name}: {asked!r} is no number of 0 or more, below {most}")
    return float(tolerance), float(relative)


def check_distance_options(options: dict) -> tuple[dict, bool, bool]:
    """Return tolerances, whether distances are signed, and whether of originals; of options that are given.

    Raises ValueError for a bad one, or where depths of originals are asked: depths are those of LODs.
    """
    signed, originals = (flag(options.get(name, False), name) for name in ("signed", "originals"))
    if signed and originals:
        raise ValueError("signed means nothing beside originals; ask at the finest LODs")
    tolerances = {name: options[name] for name in ("tolerance", "relative") if name in options}
    check_tolerances(**tolerances)
    return tolerances, signed, originals


class DistanceStage(Stage):
    """Find the distances of the pairs that do not intersect, and points of those that do.

    Args:
        beyond, tolerances: When the search of a pair ends, as `check_beyond` and `check_tolerances` return them.
        signed: Whether pairs have depths.
        inside: `InsideStage`, the stage before; None for surfaces alone.
        with_points: Whether pairs that intersect have points.
    """

    memory: wp.array  # of each thread of the CPU
    asked_tolerances: tuple = ()

    def __init__(
        self, beyond, tolerances=(0.0, 0.0), signed=False, inside: InsideStage | None = None, with_points=True
    ):
        self._signed, self._inside, self._with_points = signed, inside, with_points
        self._tolerances = frame.Tolerances()
        self.take_tolerances(tolerances)
        self.distances, self.found, self.slabs = report.Distances(), frame.NearestFound(), mean_slabs.Slabs()
        self.distance = PairDistance("beyond", beyond, self.found, check_beyond)
        self._views: dict = {}
        self._made_for: tuple = ()

    def attach(self, operator: Operator):
        """Take the operator."""
        super().attach(operator)
        refuse_signed(self._signed, operator.batch.has_solid(operator.given))
        self.slabs.due_count = wp.zeros(1, dtype=wp.int32, device=operator.device)

    def kernels(self, device) -> list:
        """Return what searches and reports."""
        with_warps = current_regime().uses_warps(device)
        kernels = [search.search_warp_kernel if with_warps else search_simd.search_thread_kernel]
        kernels += CROSSING_KERNELS if device.is_cuda and self._with_points else []  # on the CPU where pairs cross
        kernels += [report.report_distance_kernel, frame.start_distance_kernel] if with_warps else []
        kernels += [gradient.find_gradient_kernel] if self._with_points else []
        making = [(mean_slabs.make_slabs_kernel, mean_slabs.SLAB_THREADS)] if with_warps else []
        return [*[(kernel, WARP_SIZE) for kernel in kernels], *making]

    def arrays(self, rooms: Rooms) -> list[Array]:
        """Return what has an entry a pair, a thread, or a node of the tree states that there are now."""
        pairs, operator, found = rooms.pairs, self.operator, self.found
        warps = operator.uses_warps()
        return [
            *fields(found, pairs, distance=wp.float64, scaling=frame.SearchScale, beyond=wp.float64),
            Array(found, "faces", wp.int64, pairs, int(frame.NO_FACES)),
            Array(found, "upper", wp.vec2, pairs if warps else 0),
            *fields(self.distances, pairs, distance=wp.float64, bracket=wp.vec2d),
            *fields(self.distances, pairs, points=report.two_points, faces=wp.vec2i),
            *fields(self.distances, pairs if self._with_points else 0, gradient=report.two_twists),
            Array(self.slabs, "states", wp.vec2i, pairs),
            Array(self, "memory", wp.float32, (operator.threads(pairs), search_simd.NEAREST_WORDS)),
            *self._slab_arrays(),
        ]

    def _slab_arrays(self) -> list[Array]:
        """Return the slabs of all tree states: one array notes what is made in another, so all are new at once."""
        nodes, states = self._state_rooms()
        stale = not self.fits_states()
        return [
            Array(self.slabs, "record", wp.vec4, nodes if self.operator.regime.slabs else 0, None, stale),
            Array(self.slabs, "made", wp.vec3i, states, wp.vec3i(-1), stale),
            *(Array(self.slabs, name, wp.int32, states, 0, stale) for name in ("uses", "ended")),
            Array(self.slabs, "due", wp.int32, states, None, stale),
        ]

    def _state_rooms(self) -> tuple[int, int]:
        """Return how many nodes, and how many tree states there is room for."""
        pool = self.operator.batch.states.pool
        return len(pool.node_box), len(pool.lod)

    def fits_states(self) -> bool:
        """Return whether there are slabs of all nodes."""
        return self._state_rooms() == self._made_for

    def take_tolerances(self, tolerances: tuple[float, float]) -> bool:
        """Take other tolerances, checked, and return whether they are others."""
        if tolerances == self.asked_tolerances:
            return False
        self.asked_tolerances = self._tolerances.tolerance, self._tolerances.relative = tolerances
        return True

    def link(self):
        """Forget views of arrays, and note what slabs there are."""
        self._views, self._made_for = {}, self._state_rooms()

    def search(self):
        """Find the distances. Launches only."""
        operator = self.operator
        if operator.device.is_capturing:
            operator.launch_all("distances", self._make_distances)
        else:
            cores = operator.cores(PAIRS_A_CORE, len(self.memory))
            given = cores == 1, *operator.guard.given()
            *first, last = operator.commands.find("distances", given, self._make_distances)
            for command in first:
                command.launch()
            launch_on_cores(last.launch, cores)
        # On the CPU what is launched outside a graph is done.
        waits = operator.device.is_cuda or operator.device.is_capturing
        if self._with_points and (waits or operator.readout.views.any_hit.any()):
            operator.launch_all("crossings", self._make_crossings)
        if operator.batch.solids is not None and self._inside is not None:
            operator.launch_all("inside", self._make_inside)
        if self._with_points:
            inputs = [operator.batch.trees, operator.pair_batch, self.distances]
            operator.launch_kernel(gradient.find_gradient_kernel, operator.rooms.pairs, inputs, WARP_SIZE)

    def _make_crossings(self, launch) -> list:
        """Make the launches that find points of pairs that intersect, see `Commands.find`."""
        operator, device, room = self.operator, self.operator.device, self.operator.rooms.pairs
        with loading(device, [(kernel, WARP_SIZE) for kernel in CROSSING_KERNELS]):
            pass
        posed = [operator.batch.trees, operator.pair_batch]
        inputs = [operator.traversal.stack_length(), *posed, operator.hits, self.found]
        search_kernel, report_kernel = CROSSING_KERNELS
        searching = launch(search_kernel, dim=room * operator.lanes, inputs=inputs, block_dim=WARP_SIZE, device=device)
        inputs = [*posed, self.found, operator.hits, self.distances]
        return [searching, launch(report_kernel, dim=room, inputs=inputs, block_dim=WARP_SIZE, device=device)]

    def _make_inside(self, launch) -> list:
        """Make the launches that report pairs of which one is inside the other."""
        operator, room, inside = self.operator, self.operator.rooms.pairs, self._inside
        assert inside is not None and operator.batch.solids is not None
        posed = [operator.batch.trees, operator.pair_batch]
        inputs = [*posed, operator.hits, inside.contained, self.distances]
        made = [launch(report_contained_kernel, dim=room, inputs=inputs, device=operator.device)]
        if self._signed:
            inputs = [operator.traversal.stack_length(), posed[0], operator.batch.solids.pool, posed[1]]
            inputs += [operator.hits, self.distances]
            threads = {"dim": room * operator.lanes, "block_dim": WARP_SIZE, "device": operator.device}
            made.append(launch(find_depth_kernel, inputs=inputs, **threads))
        return made

    def _make_distances(self, launch) -> list:
        """Make the launches that find distances, after the exact test, see `Commands.find`."""
        operator, device, room = self.operator, self.operator.device, self.operator.rooms.pairs
        posed, hits, found, slabs = [operator.batch.trees, operator.pair_batch], operator.hits, self.found, self.slabs
        traversal, work = operator.traversal, operator.traversal.work
        if not operator.uses_warps():
            made, alone = [], operator.cores(PAIRS_A_CORE, len(self.memory)) == 1
            for steps in [(True, True)] if alone else [(True, False), (False, True)]:
                request = search_simd.SearchRequest()
                request.tolerances, (request.refreshes, request.searches) = self._tolerances, steps
                inputs = [request, *posed, work.counter, slabs, found, hits, self.distances, self.memory]
                made.append(launch(search_simd.search_thread_kernel, dim=1, inputs=inputs, device=device))
            return made
        threads = {"block_dim": WARP_SIZE, "device": device}
        block, blocks = (mean_slabs.SLAB_THREADS, device.sm_count) if device.is_cuda else (1, 1)
        making = {"dim": blocks * block, "block_dim": mean_slabs.SLAB_THREADS, "device": device}
        searched = [traversal.stack_length(), self._tolerances, *posed, slabs, found, hits, work]
        searching = {"dim": traversal.warp_count() * operator.lanes, **threads}
        started = {"dim": max(room, len(work.flag)), **threads}
        reported = [self._tolerances, *posed, found, hits, self.distances]
        return [
            launch(frame.start_distance_kernel, inputs=[*posed, slabs, found, work], **started),
            launch(mean_slabs.make_slabs_kernel, inputs=[block, blocks, posed[0], slabs], **making),
            launch(search.search_warp_kernel, inputs=searched, **searching),
            launch(report.report_distance_kernel, inputs=reported, dim=room, **threads),
        ]

    def read(self, found: Found, device: bool, with_rows: bool):
        """Read the distances."""
        n, on_host = len(found.pairs), self.operator.device.is_cpu and not device
        for name in ("gradient", *DISTANCES, "points"):
            rows = getattr(self.distances, ANSWER_FIELDS.get(name, name))
            if on_host:
                if name not in self._views:
                    self._views[name] = rows.numpy()
                setattr(found, name, self._views[name][:n].copy())
                continue
            rows = rows if len(rows) == n else first_rows(rows, n)
            # The largest part, which few ask for, comes to the host when it is read: see `Result.gradient`.
            stays = device or name == "gradient"
            setattr(found, name, wp.clone(rows) if stays else rows.numpy().copy())


class DistanceQuery(Operator):
    """Least distances of many object pairs as an operator: allocates once, launches many times.

    As `Query` otherwise. The faces that a launch finds are where the next one starts, so that objects which move little
    from launch to launch take less time. What each answer is stands in `query.stages.distance`.

    Args:
        scene, pairs, capacity: As for `Query`. The broad phase finds overlapping boxes only.
        tolerance: Width of the bracket that ends the search of a pair [world units].
        relative: The same as a fraction of the distance, below 1; the wider one counts.
        beyond: Distance [world units] that ends the search of a pair which is proved farther apart: one for all pairs,
            or (p,) beside given pairs; None for none.
        signed: Whether pairs of which one is a solid that holds corners of the other have their depth, negative.

    Attributes:
        distances: The last launch's answers, device arrays (pair capacity,) of `kernels.distance.report.Distances`.

    Raises:
        ValueError: As `Query`; a tolerance or distance that is negative, infinite or no number; or depths are asked of
            pairs of which no object is a solid.
        RuntimeError: A graph is being captured.
    """

    _distance: Any

    def __init__(self, scene, pairs=None, capacity=None, tolerance=0.0, relative=0.0, beyond=None, signed=False):
        count = None if pairs is None else len(np.atleast_1d(to_numpy(pairs, "pairs")))
        stages = self.plan(check_tolerances(tolerance, relative), check_beyond(beyond, count), signed)
        *_, self._distance = stages
        self.distances, self._signed = self._distance.distances, signed
        super().__init__(scene, stages, pairs, capacity)

    @staticmethod
    def plan(tolerances=(0.0, 0.0), beyond: np.ndarray = NOT_BEYOND, signed=False) -> list[Stage]:
        """Return the stages of a query, of tolerances and distances that are checked."""
        inside = InsideStage()
        return [IntersectStage(), inside, DistanceStage(beyond, tolerances, flag(signed, "signed"), inside)]

    def set_pairs(self, pairs, beyond=None):
        """Query other pairs from now on, in the room there is if they fit; beyond None keeps the distances.

        Raises:
            ValueError: Bad pairs or distances, a query that runs the broad phase, or signed and no object of the pairs
                is a solid.
        """
        if self.broad_phase is None:
            refuse_signed(self._signed, self.batch.has_solid(self.batch.check_pairs(pairs)))
        self.ask_pairs(pairs, beyond=beyond)

    def set_tolerance(self, tolerance=0.0, relative=0.0):
        """Take other tolerances from the next launch on; a captured graph keeps its own.

        Raises:
            ValueError: One that is negative, infinite or no number.
        """
        if self._distance.take_tolerances(check_tolerances(tolerance, relative)):
            self.commands = Commands()

    def forget(self):
        """Let the next launch start anew, and not from the faces that the last one found. Launches only."""
        self._distance.found.faces.fill_(int(frame.NO_FACES))
