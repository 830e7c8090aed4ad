"""The stages of a frame, in arrays that are allocated once, so that a graph can capture what they launch."""

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.upload import Download, Upload
from warp_abtree.kernels.io import pipeline as pipeline_kernels
from warp_abtree.kernels.lod import frame_summary
from warp_abtree.kernels.lod.ladder import WARP
from warp_abtree.kernels.lod.prediction import LevelChoice
from warp_abtree.kernels.update.levels import Levels
from warp_abtree.lod.controllers import Controller
from warp_abtree.lod.timing import Timer
from warp_abtree.query.stages.contacts import ContactQuery
from warp_abtree.query.stages.intersect import Query
from warp_abtree.scene.scene import Scene
from warp_abtree.simulate.frame_row import LodColumns
from warp_abtree.simulate.motion import Kinematic
from warp_abtree.simulate.rigid_bodies import SteppedMotion
from warp_abtree.state.device_update import LevelStates, shares_levels
from warp_abtree.state.poses import check_poses

# Words of `kernels.lod.frame_summary` by name, in their order.
WORDS = (
    "frames launched pairs hits uncertain apart intersecting node_tests triangle_tests "
    "nodes_refitted lods_changed oscillations witnesses"
).split()


class FrameStages:
    """Selection, LOD update, poses, broad and narrow phase, and the response of rigid bodies: launches, in this order.

    The output is that of the query where no rigid bodies ask for contacts.

    Attributes:
        grow, result: Functions of the query, to find with room for all, and to read it; both wait for the device.
        table: `LodColumns` of the levels of the controller; None without.
        answer: The motion's own response, or None.
        seen: Frames that the device has counted, up to the last one recorded.
    """

    def __init__(
        self, scene: Scene, motion: Any, controller: Controller | None, output: str, time_step: float, timer: Timer
    ):
        self.scene, self.batch, self.device = scene, scene.batch(), scene.device
        self.motion, self.controller, self._output, self._time_step = motion, controller, output, time_step
        self._timer, self._mark, self.seen = timer, timer.mark, 0
        self._graphs: dict[tuple, tuple] = {}  # and the marks that each makes
        self._graph_arrays: tuple = ()
        self._stepped = motion if isinstance(motion, SteppedMotion) else None
        self.answer, self._find_poses = getattr(motion, "answer", None), getattr(motion, "poses", None)
        self._memory = np.empty((scene.object_count, 7))
        self._ahead: tuple = (None, False)  # a time, and whether poses of it were brought
        self._dynamics = None if self._stepped is None else self._stepped.dynamics
        if self._dynamics is None:
            contacts = output == "contacts"
            query: Any = ContactQuery(scene, sort_pairs=True) if contacts else Query(scene, output, sort_pairs=True)
            query.growth = 2
            self.result, self.grow, guards = query.result, query.grow, [query.guard]
        else:
            query = self._dynamics.query
            self.result, self.grow = partial(query.result, with_points=False), self._dynamics.find_contacts
            guards = [part.guard for part in (query, self._dynamics.certified) if part is not None]
        self.query = query
        self._guards, self._filter = guards, self.batch.filter_generation.number
        zeros = partial(wp.zeros, device=self.device)
        self._levels: Any = None
        self.table: Any = None
        self._marked = self._count = self._change = zeros(0, wp.int32)
        self._tests = zeros(0, wp.int64)
        if controller is not None:
            self._serve(controller)
        self._upload = Upload(self._memory.size, self.device)
        self._rows = self._upload.array.reshape((-1, 7))
        self._sums, self._ended = zeros(len(WORDS), wp.int64), zeros(1, wp.int32)
        self._summary = Download(len(WORDS) + len(self._count), wp.int64, self.device)

    def _serve(self, controller):
        """Let objects stand at the levels of a controller's ladder."""
        controller.view.check()  # its ladder is of the models that the scene had
        ladder = controller.ladder.levels()
        shared = shares_levels(self.batch.object_model, ladder)
        self._levels = made = LevelStates(self.batch, ladder, self.batch.lods, shared, controller.lods)
        self.batch.follow(made)
        self.table = LodColumns(self.scene, made.level_model, made.level_lod)
        self._count, self._change = made.levels.count, made.levels.change
        if made.plan is not None:
            self._marked = made.plan.marked_count
        if controller.tests is not None:
            self._tests = controller.tests

    def serves(self, scene, motion, controller, output) -> bool:
        """Return whether these stages are still those of a frame."""
        if self.batch is not scene.batch() or self.motion is not motion or self.controller is not controller:
            return False
        if self._levels is not None and not self.batch.follows(self._levels):
            return False
        asks = self._filter, self._output
        return self._stepped is not None or asks == (self.batch.filter_generation.number, output)

    def warm_up(self):
        """Load the kernels that no other operator has loaded, and make room for what is found; nothing moves."""
        if self._stepped is not None:
            self._stepped.warm_up(self._time_step)
        for module in (frame_summary, pipeline_kernels):
            wp.load_module(module, self.device)
        if self._levels is not None:
            self._levels.load()
        self.grow()

    def find_graph(self, key: tuple, launches: list[Callable]) -> wp.Graph:
        """Return the graph of what a key stands for, captured once for the arrays in use; its marks are made."""
        arrays, marks = tuple(guard.given() for guard in self._guards), self._timer.marks
        if arrays != self._graph_arrays:
            self._graphs.clear()
            self._graph_arrays = arrays
        if key in self._graphs:
            graph, made = self._graphs[key]
            marks += made
            return graph
        before = len(marks)
        with wp.ScopedCapture(self.device) as capture:
            for launch in launches:
                launch()
        self._graphs[key] = capture.graph, marks[before:]
        return capture.graph

    def bring_poses(self, time: float) -> bool:
        """Bring to the device the poses of a frame that begins at a time [s]; return whether there are any to set."""
        known, places = self._ahead
        self._ahead = None, False
        if known != time:
            places = self._send_poses(time)
        if self._stepped is not None:
            self._stepped.aim(time + self._time_step)
        return places

    def _send_poses(self, time) -> bool:
        """Bring checked poses of a time to the device; false if there are none, or the motion has set the scene's."""
        poses = None if self._find_poses is None else self._find_poses(time, out=self._memory)
        if poses is None:
            return False
        rows = check_poses(poses, removed=self.scene.batch().removed)
        if rows.shape != self._memory.shape:
            raise ValueError(f"motion: poses of shape {rows.shape}, not {self._memory.shape}")
        self._upload.send(rows.ravel())
        return True

    def look_ahead(self, time: float):
        """Do what the host can of a frame that begins at a time to come, behind the launches of this one."""
        if self.controller is not None:
            with suppress(Exception):  # a camera that there is none of raises when its frame comes
                self.controller.look_ahead(time)
        if isinstance(self.motion, Kinematic):
            self._ahead = time, self._send_poses(time)

    def select(self, rests: bool):
        """Select LODs, if there is a controller, unless all are known to stay after a frame in which they did."""
        if self.controller is not None:
            self.controller.choose(rests)
            self._mark("select_ms", lambda: {"selected": 0 if rests else self.scene.object_count})

    def arrange(self, rests: bool, places: bool):
        """Bring objects to the LODs selected, and set the poses that were brought, if there are any."""
        place = partial(self._arrange, rests, places)
        if self.controller is None or rests:
            place()
            return
        self._levels.launch(place)
        if self._levels.plan is not None:
            self._mark("refine_ms", lambda: {"node_refitted": int(self._marked.numpy().sum())})

    def _arrange(self, rests: bool, places: bool):
        controller = None if rests else self.controller
        if places or controller is not None or len(self._tests):
            levels = Levels() if controller is None else self._levels.levels
            chosen = LevelChoice() if controller is None else controller.chosen
            poses = self._rows if places else self._rows[:0]
            inputs = [poses, chosen, levels, self.batch.objects.pool, self._tests]
            wp.launch(pipeline_kernels.arrange_object_kernel, len(self._rows), inputs, device=self.device)
        self._mark("move_ms", lambda: {"posed": 0 if self.motion is None else self.scene.object_count})

    def find(self):
        """Find what intersects. Launches only while a graph is captured; else waits, to make room for all of it."""
        find = self.query.launch if self.device.is_capturing else self.grow
        find(lambda: self._mark("broad_ms", lambda: {"candidate": self.query.broad_phase.count_found()}))

    def respond(self):
        """Summarise what was found, and let rigid bodies respond to it."""

        def count():
            found = self.summary()
            return {"query": 1, "node_test": found["node_tests"], "triangle_test": found["triangle_tests"]}

        query, rows = self.query, (self.query.pairs, self._marked, self._count, self._change)
        dim = -(-max(1, *map(len, rows)) // WARP) * WARP
        inputs = [query.pair_batch, query.hits, self._marked, self._change, self._count, dim, self._sums]
        inputs += [self._ended, self._tests, self._summary.array]
        wp.launch(frame_summary.summarise_frame_kernel, dim, inputs, device=self.device)
        self._mark("query_ms", count)
        if self._dynamics is not None:
            self._dynamics.answer(self._time_step)

    def respond_again(self):
        """Do what `respond` does, once more in a frame."""
        if len(self._tests):
            self._tests.zero_()
        self.respond()

    def finish_bodies(self):
        """Finish a step of rigid bodies that lacked room, see `Dynamics.finish`."""
        if self._dynamics is not None:
            self._dynamics.finish(self._time_step)

    def summary(self) -> dict:
        """Return the last frame's WORDS by name, and as `levels` the objects at each level. Waits for the device."""
        if self.device.is_cuda:
            wp.synchronize_stream(wp.get_stream(self.device))
        values = self._summary.view
        return {**dict(zip(WORDS, values[: len(WORDS)].tolist())), "levels": values[len(WORDS) :]}

    def has_room(self, found: dict) -> bool:
        """Return whether all buffers had room for what a frame has found, of which this is the summary."""
        query, names = self.query, ("launched", "pairs", "hits", "uncertain", "apart", "witnesses")
        launched, *needed = query.readout.totals([found[name] for name in names])
        return launched >= 0 and all(need <= room for need, room in zip(needed, query.list_rooms))
