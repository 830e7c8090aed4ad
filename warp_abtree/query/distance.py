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
  two faces share, as accurate as a contact (`warp_abtree.query.contacts`).
* point_faces: the faces that they lie on. Of equally near face pairs the one with the lowest face of the object with
  the smaller index, then of the other; where the surfaces intersect, some pair that does.

With `signed`, a pair of which one object lies inside the other, a solid (`Scene.add`), by some of its points has a
negative distance. The depth of a point is its distance from the other's surface; looked at are corners of faces,
middles of edges and centroids of faces, of both objects if both are solids. The greatest depth is that of the pair:

* distance is minus the depth; bracket holds it as above.
* points are the point inside and the point of the other surface that is nearest to it, in the order of the pair, and
  point_faces the faces that they lie on. From the point inside to the other is its way out.

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

from warp_abtree.checks.arguments import check_device, flag, to_numpy
from warp_abtree.checks.cpu_threads import core_count, cores_for, launch_on_cores
from warp_abtree.checks.kernel_loading import loading
from warp_abtree.checks.regime import current_regime
from warp_abtree.kernels.base.lanes import WARP_SIZE
from warp_abtree.kernels.distance import crossing, frame, report, search, search_simd
from warp_abtree.kernels.inside.containment import report_contained_kernel
from warp_abtree.kernels.inside.depth import find_depth_kernel
from warp_abtree.kernels.search import mean_slabs
from warp_abtree.query.commands import Commands
from warp_abtree.query.narrow_phase import Query
from warp_abtree.query.request import check_request, check_within, refuse_options, refuse_signed
from warp_abtree.query.result import DISTANCES, Found, Result
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
    """Return the tolerances of a search."""
    return check_tolerance(tolerance, "tolerance", math.inf), check_tolerance(relative, "relative", 1.0)


def check_tolerance(tolerance, name: str, most: float) -> float:
    """Return a tolerance.

    Raises:
        ValueError: No number from 0 up to below the most.
    """
    # Plain numbers, as most are, in a tenth of the time.
    value = tolerance if type(tolerance) is float else to_numpy(tolerance, name)
    if np.ndim(value) or not 0 <= value < most:
        raise ValueError(f"{name}: {tolerance!r} is no number of 0 or more, below {most}")
    return float(value)


def check_flags(options: dict) -> tuple[bool, bool]:
    """Return whether distances are signed, and whether of originals.

    Raises:
        ValueError: One that is no bool, or both are asked: depths are those of LODs.
    """
    signed, originals = (flag(options.get(name, False), name) for name in ("signed", "originals"))
    if signed and originals:
        raise ValueError("signed means nothing beside originals; ask at the finest LODs")
    return signed, originals


def check_asked(output, precision, options):
    """Check the options of a sweep's query.

    Raises:
        TypeError: An option with another name than tolerance, relative, beyond, signed, originals and within.
        ValueError: A bad option, output or precision, or one that means nothing beside another.
    """
    unknown = set(options) - {"tolerance", "relative", "beyond", "signed", "originals", "within"}
    if unknown:
        raise TypeError(f"sweep has no option {sorted(unknown)[0]!r}")
    if output == "distance":
        refuse_options(output, {"precision": precision != "exact", "within": "within" in options})
        check_tolerances(options.get("tolerance", 0.0), options.get("relative", 0.0))
        check_beyond(options.get("beyond"))
        check_flags(options)
    else:
        taken = ("within",) if output != "faces" else ()
        refuse_options(output, {name: value for name, value in options.items() if name not in taken})
        check_request(output, precision)
        if options.get("within") is not None:
            check_within(options["within"], known="a sweep: one distance for all")


def prepare_query(query, batch, pairs: np.ndarray, beyond: np.ndarray, tolerances: dict, signed: bool = False):
    """Return a `DistanceQuery` with these options, checked: the one of before if there is one, else another."""
    if query is None:
        return DistanceQuery(batch, pairs=pairs, beyond=beyond, signed=signed, **tolerances)
    query.set_tolerance(**tolerances)
    if not query.is_asked(pairs, beyond):
        query.replace_pairs(pairs, beyond)
    return query


class DistanceQuery(Query):
    """Least distances of many object pairs as an operator: allocates once, launches many times.

    As `Query` otherwise. The faces that a launch finds are where the next one starts, so that objects which move little
    from launch to launch take less time. What each answer is stands in `warp_abtree.query.distance`.

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

    _memory: wp.array

    def __init__(self, scene, pairs=None, capacity=None, tolerance=0.0, relative=0.0, beyond=None, signed=False):
        self._signed = flag(signed, "signed")
        self._asked_tolerances = check_tolerances(tolerance, relative)
        self._tolerances = frame.Tolerances()
        self._tolerances.tolerance, self._tolerances.relative = self._asked_tolerances
        self._answer_views: tuple[int, dict] = (-1, {})
        self._asked = check_beyond(beyond, None if pairs is None else len(to_numpy(pairs, "pairs")))
        self.distances, self._found, self._slabs = report.Distances(), frame.NearestFound(), mean_slabs.Slabs()
        self._slabs.record = wp.empty(0, dtype=wp.vec4, device=scene.device)
        self._slabs.due_count = wp.zeros(1, dtype=wp.int32, device=scene.device)
        super().__init__(scene, "any", pairs, capacity)
        refuse_signed(self._signed and pairs is None, self.batch.has_solid())
        self._fit_slabs()

    def set_pairs(self, pairs, beyond=None):
        """Query other pairs from now on, in the room there is if they fit; beyond None keeps the distances.

        Raises:
            ValueError: Bad pairs or distances, a query that runs the broad phase, or signed and no object of the pairs
                is a solid.
        """
        if self.broad_phase is not None:
            raise ValueError("this query takes its pairs from the broad phase")
        check_device(self.device, "giving a query other pairs")
        pairs = self.batch.check_pairs(pairs)
        refuse_signed(self._signed, self.batch.has_solid(pairs))
        if beyond is None:
            beyond = self._asked if self._within is None else self._within
        self.replace_pairs(pairs, check_beyond(beyond, len(pairs)))

    def set_tolerance(self, tolerance=0.0, relative=0.0):
        """Take other tolerances from the next launch on; a captured graph keeps its own.

        Raises:
            ValueError: One that is negative, infinite or no number.
        """
        asked = check_tolerances(tolerance, relative)
        if asked != self._asked_tolerances:
            self._asked_tolerances = self._tolerances.tolerance, self._tolerances.relative = asked
            self._commands = Commands()

    def forget(self):
        """Let the next launch start anew, and not from the faces that the last one found. Launches only."""
        self._found.faces.fill_(int(frame.NO_FACES))

    def _fill_within(self):
        beyond = self._asked if self._within is None else self._within
        if beyond.ndim == 0:
            self._found.beyond.fill_(float(beyond))
        elif len(beyond):
            rows = wp.array(beyond, dtype=wp.float64, device="cpu", copy=False)
            wp.copy(self._found.beyond, rows, count=len(rows))

    @classmethod
    def kernels(cls, device, output, precision, with_gap: bool, with_distances: bool) -> list:
        with_warps = current_regime().uses_warps(device)
        kernels = [search.search_warp_kernel if with_warps else search_simd.search_thread_kernel]
        kernels += CROSSING_KERNELS if device.is_cuda else []  # on the CPU where pairs cross
        kernels += [report.report_distance_kernel, frame.start_distance_kernel] if with_warps else []
        searching = super().kernels(device, output, precision, with_gap, with_distances)
        making = [(mean_slabs.make_slabs_kernel, mean_slabs.SLAB_THREADS)] if with_warps else []
        return [*[(kernel, WARP_SIZE) for kernel in kernels], *making, *searching]

    def _pair_arrays(self, room: int) -> list:
        made = super()._pair_arrays(room)
        for owner, name, dtype in (
            (self._found, "distance", wp.float64),
            (self._found, "scaling", frame.SearchScale),
            (self._found, "beyond", wp.float64),
            (self.distances, "distance", wp.float64),
            (self.distances, "bracket", wp.vec2d),
            (self.distances, "points", report.two_points),
            (self.distances, "faces", wp.vec2i),
        ):
            made.append((owner, name, wp.empty(room, dtype=dtype, device=self.device)))
        uppers = room if self.uses_warps() else 0
        made.append((self._found, "upper", wp.empty(uppers, dtype=wp.vec2, device=self.device)))
        threads = 0 if self.uses_warps() else min(room, current_regime().cpu_threads or core_count())
        made.append((self._slabs, "states", wp.empty(room, dtype=wp.vec2i, device=self.device)))
        made.append(
            (self, "_memory", wp.empty((threads, search_simd.NEAREST_WORDS), dtype=wp.float32, device=self.device))
        )
        no_faces = int(frame.NO_FACES)
        return [*made, (self._found, "faces", wp.full(room, no_faces, dtype=wp.int64, device=self.device))]

    def traverse(self):
        """Decide which pairs in place intersect, and find the distances of the others. Launches only."""
        room = len(self.pairs)
        if not room:
            return
        self._fit_slabs()
        super().traverse()
        if self.device.is_capturing:
            self._launch_all("distances", self._make_distances)
            self._launch_all("crossings", self._make_crossings)
            self._report_inside()
            return
        cores = self._search_cores()
        given = (cores == 1, *self.guard.given())
        *first, last = self._commands.find("distances", given, self._make_distances)
        for command in first:
            command.launch()
        launch_on_cores(last.launch, cores)
        # On the CPU what is launched is done.
        if self.device.is_cuda or self._views.any_hit.any():
            self._launch_all("crossings", self._make_crossings)
        self._report_inside()

    def _report_inside(self):
        """Report pairs of which one is inside the other, where there are solids. Launches only."""
        if self.batch.solids is not None:
            self._launch_all("inside", self._make_inside)

    def _search_cores(self) -> int:
        """Return how many cores share the search; a graph of the CPU has one."""
        if self.uses_warps() or self.device.is_capturing:
            return 1
        return cores_for(len(self.pairs), PAIRS_A_CORE, len(self._memory))

    def _make_crossings(self, launch) -> list:
        """Make the launches that find points of pairs that intersect, see `Commands.find`."""
        with loading(self.device, [(kernel, WARP_SIZE) for kernel in CROSSING_KERNELS]):
            pass
        room, device = len(self.pairs), self.device
        posed = [self.batch.trees, self.pair_batch]
        inputs = [self._stack_length(), *posed, self.hits, self._found]
        dim = room * (WARP_SIZE if device.is_cuda else 1)
        kernel = crossing.search_crossing_kernel
        search = launch(kernel, dim=dim, inputs=inputs, block_dim=WARP_SIZE, device=device)
        inputs = [*posed, self._found, self.hits, self.distances]
        kernel = crossing.report_crossing_kernel
        return [search, launch(kernel, dim=room, inputs=inputs, block_dim=WARP_SIZE, device=device)]

    def _make_inside(self, launch) -> list:
        """Make the launches of `_report_inside`."""
        solids: Any = self.batch.solids
        inputs = [self.batch.trees, self.pair_batch, self.hits, self.contained, self.distances]
        made = [launch(report_contained_kernel, dim=len(self.pairs), inputs=inputs, device=self.device)]
        if self._signed:
            inputs = [self._stack_length(), self.batch.trees, solids.pool, self.pair_batch]
            inputs += [self.hits, self.distances]
            dim = len(self.pairs) * (WARP_SIZE if self.device.is_cuda else 1)
            made.append(launch(find_depth_kernel, dim=dim, inputs=inputs, block_dim=WARP_SIZE, device=self.device))
        return made

    def _fit_slabs(self):
        """Make room for the slabs of all tree states that there are now; a graph goes on without."""
        nodes, states = len(self.batch.states.pool.node_box), len(self.batch.states.pool.lod)
        nodes = nodes if self._regime.slabs else 0
        made = self._slabs.made
        if self.device.is_capturing or (made is not None and (len(self._slabs.record), len(made)) == (nodes, states)):
            return
        device = self.device
        self._replace(
            [
                (self._slabs, "record", wp.empty(nodes, dtype=wp.vec4, device=device)),
                (self._slabs, "made", wp.full(states, wp.vec3i(-1), dtype=wp.vec3i, device=device)),
                (self._slabs, "uses", wp.zeros(states, dtype=wp.int32, device=device)),
                (self._slabs, "due", wp.empty(states, dtype=wp.int32, device=device)),
                (self._slabs, "ended", wp.zeros(states, dtype=wp.int32, device=device)),
            ]
        )

    def _make_distances(self, launch) -> list:
        """Make the launches that find distances, after the exact test, see `Commands.find`."""
        room, lanes, device = len(self.pairs), WARP_SIZE if self.device.is_cuda else 1, self.device
        posed = [self.batch.trees, self.pair_batch]
        hits, found, length = self.hits, self._found, self._stack_length()
        threads = {"dim": room, "block_dim": WARP_SIZE, "device": device}
        reports = [self._tolerances, *posed, found, hits, self.distances]
        if not self.uses_warps():
            made = []
            for steps in [(True, True)] if self._search_cores() == 1 else [(True, False), (False, True)]:
                request = search_simd.SearchRequest()
                request.tolerances, (request.refreshes, request.searches) = self._tolerances, steps
                inputs = [request, *posed, self.work.counter, self._slabs, found, hits]
                inputs += [self.distances, self._memory]
                made.append(launch(search_simd.search_thread_kernel, dim=1, inputs=inputs, device=device))
            return made
        started = {**threads, "dim": max(room, len(self.work.flag))}
        inputs = [length, self._tolerances, *posed, self._slabs, found, hits, self.work]
        searching = {"dim": self._warp_count() * lanes, "block_dim": WARP_SIZE, "device": device}
        block = mean_slabs.SLAB_THREADS if self.device.is_cuda else 1
        blocks = self.device.sm_count if self.device.is_cuda else 1
        making = {"dim": blocks * block, "block_dim": mean_slabs.SLAB_THREADS, "device": device}
        return [
            launch(frame.start_distance_kernel, inputs=[*posed, self._slabs, found, self.work], **started),
            launch(mean_slabs.make_slabs_kernel, inputs=[block, blocks, self.batch.trees, self._slabs], **making),
            launch(search.search_warp_kernel, inputs=inputs, **searching),
            launch(report.report_distance_kernel, inputs=reports, **threads),
        ]

    def _make_result(self, found: Found, device: bool, with_rows: bool = True) -> Result:
        n, answers = len(found.pairs), self.distances
        views = self._find_views() if self.device.is_cpu and not device else {}
        for name in (*DISTANCES, "points"):
            if name in views:
                setattr(found, name, views[name][:n].copy())
                continue
            rows = getattr(answers, ANSWER_FIELDS.get(name, name))
            rows = rows if len(rows) == n else first_rows(rows, n)
            setattr(found, name, wp.clone(rows) if device else rows.numpy().copy())
        return super()._make_result(found, device, with_rows)

    def _find_views(self) -> dict:
        """Return NumPy's views of the answers, where these are the host's memory."""
        made, views = self._answer_views
        if made != self.guard.buffers.number:
            fields = {name: getattr(self.distances, ANSWER_FIELDS.get(name, name)) for name in (*DISTANCES, "points")}
            views = {name: rows.numpy() for name, rows in fields.items()}
            self._answer_views = self.guard.buffers.number, views
        return views
