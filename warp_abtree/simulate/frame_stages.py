"""The stages of a frame on the device, in arrays that are allocated once, so that a graph can capture them."""

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.upload import Upload
from warp_abtree.kernels.lod import frame_summary as words
from warp_abtree.kernels.lod.ladder import WARP
from warp_abtree.kernels.update import levels as level_kernels
from warp_abtree.kernels.update import work_lists
from warp_abtree.lod.controllers import Controller
from warp_abtree.query.stages.contacts import ContactQuery
from warp_abtree.query.stages.intersect import Query
from warp_abtree.scene.scene import Scene
from warp_abtree.simulate.frame_row import LodColumns
from warp_abtree.simulate.rigid_bodies import Dynamics
from warp_abtree.state.device_update import LevelStates, shares_levels
from warp_abtree.state.poses import check_poses, launch_place


class FrameStages:
    """Selection, LOD update, poses, broad and narrow phase, and the response of rigid bodies.

    Args:
        controller, dynamics: What selects LODs, and what responds to contacts, or None.
        output: Output of the query where no dynamics ask for contacts.
        moves: Whether anything sets poses.

    Attributes:
        query: The query of the frame.
        table: `LodColumns` of the levels of the controller; None without.
        summary: Words of `kernels.lod.frame_summary`, on the host once `read`, int64.
    """

    def __init__(
        self,
        scene: Scene,
        controller: Controller | None,
        dynamics: Dynamics | None,
        output: str,
        time_step: float,
        moves: bool,
    ):
        self.moves = moves
        self.scene, self.batch, self.device = scene, scene.batch(), scene.device
        self.controller, self.dynamics, self.time_step = controller, dynamics, time_step
        self.query = self._make_query(output) if dynamics is None else dynamics.query
        self._filter, self._output = self.batch.filter_generation.number, output
        self._levels: Any = None
        self.table: Any = None
        if controller is not None:
            self._levels = self._make_levels(controller)
            self.table = LodColumns(scene.models, self._levels.level_model, self._levels.level_lod)
        self._upload = Upload(7 * scene.object_count, self.device)
        self._rows = self._upload.array.reshape((-1, 7))
        length = int(words.HEAD) + (0 if self.table is None else len(self.table.lod))
        self._summary = self._host_summary = self._zeros(length, wp.int64)
        if self.device.is_cuda:
            self._host_summary = wp.zeros(length, dtype=wp.int64, device="cpu", pinned=True)
        self._frames = self._zeros(1, wp.int64)
        self._no_changes, self._nothing = self._zeros(2, wp.int32), self._zeros(0, wp.int32)
        tests = None if controller is None else controller.tests
        self._tests = self._zeros(0, wp.int64) if tests is None else tests

    def _make_query(self, output):
        contacts = output == "contacts"
        query = ContactQuery(self.scene, sort_pairs=True) if contacts else Query(self.scene, output, sort_pairs=True)
        query.growth = 2
        return query

    def _make_levels(self, controller):
        levels = controller.ladder.levels()
        shared = shares_levels(self.batch.object_model, levels)
        made = LevelStates(self.batch, levels, self.batch.lods, shared)
        made.wanted = controller.lods
        self.batch.follow(made)
        return made

    def _zeros(self, length, dtype):
        return wp.zeros(length, dtype=dtype, device=self.device)

    def serves(self, scene, controller, output) -> bool:
        """Return whether these stages are still those of a frame."""
        if self.batch is not scene.batch() or self.controller is not controller:
            return False
        if self._levels is not None and not self.batch.follows(self._levels):
            return False
        if self.dynamics is not None:
            return True
        return self._filter == self.batch.filter_generation.number and self._output == output

    def warm_up(self):
        """Load the kernels that no other operator has loaded, and make room for what is found; nothing moves."""
        for module in (words, level_kernels, work_lists):
            wp.load_module(module, self.device)
        self.find()

    def arrays(self) -> tuple:
        """Return a token of all arrays that launches are given: while it stands, a graph of them holds."""
        certified = None if self.dynamics is None else self.dynamics.certified
        return *self.query.guard.given(), *(() if certified is None else certified.guard.given())

    def check_rows(self, poses) -> np.ndarray:
        """Return poses of all objects, (n, 7); raise ValueError for bad ones, or another number of them."""
        rows = check_poses(poses)
        if rows.shape != self._rows.shape:
            raise ValueError(f"motion: poses of shape {rows.shape}, not {self._rows.shape}")
        return rows

    def take_rows(self, rows):
        """Bring checked poses to the device for the next launch."""
        self._upload.send(rows.ravel())

    def launch_selection(self, mark: Callable, rests: bool = False):
        """Select LODs and bring objects to them, if there is a controller. Launches only.

        Args:
            mark: Called as mark(stage, count) when the launches of a stage are over; count() returns its counted work.
            rests: Whether all LODs are known to stay, after a frame in which they did.
        """
        if self.controller is None:
            return
        self.controller.launch(rests)
        mark("select_ms", lambda: {"selected": 0 if rests else self.scene.object_count})
        if rests:
            return
        self._levels.launch()
        mark("refine_ms", lambda: {"node_refitted": int(self._marked().numpy().sum())})

    def launch_query(self, mark: Callable, places: bool):
        """Set poses if there are any, find what intersects, and let rigid bodies respond to it.

        Launches only while a graph is captured; else waits for the device, to make room where it lacks.

        Args:
            mark: As for `launch_selection`.
            places: Whether `take_rows` has brought poses.
        """
        if places:
            launch_place(self._rows, self.batch.objects.pool)
        mark("move_ms", lambda: {"posed": self.scene.object_count if self.moves else 0})
        find = self.query.launch if self.device.is_capturing else self.find
        find(lambda: mark("broad_ms", lambda: {"candidate": self.query.broad_phase.count_found()}))
        self.respond(mark)

    def _marked(self):
        plan = None if self._levels is None else self._levels.plan
        return self._nothing if plan is None else plan.marked_count

    def _summarise(self):
        self._summary.zero_()
        if len(self._tests):
            self._tests.zero_()
        query, levels = self.query, None if self._levels is None else self._levels.levels
        count = self._nothing if levels is None else levels.count
        changed = self._no_changes if levels is None else levels.changed
        inputs = [query.pair_batch, query.hits, self._marked(), changed, count]
        inputs += [self._frames, self._tests, self._summary]
        threads = max(len(query.pairs), len(self._marked()), len(count), 1)
        dim = -(-threads // WARP) * WARP
        wp.launch(words.summarise_frame_kernel, dim, inputs, device=self.device)
        if self.device.is_cuda:
            wp.copy(self._host_summary, self._summary)

    def _count_tests(self) -> dict:
        summary = self.read()
        return {
            "query": 1,
            "node_test": int(summary[words.NODE_TESTS]),
            "triangle_test": int(summary[words.TRIANGLE_TESTS]),
        }

    def read(self) -> np.ndarray:
        """Return the summary of the last frame, int64. Waits for the device."""
        if self.device.is_cuda:
            wp.synchronize_stream(wp.get_stream(self.device))
        return self._host_summary.numpy()

    def is_whole(self, summary) -> bool:
        """Return whether all buffers had room for what the frame of a summary found, and it was launched."""
        hits, room = self.query.hits, len(self.query.pairs)
        listed = self.query.output == "faces"
        return bool(
            summary[words.LAUNCHED] >= 0
            and 0 <= summary[words.PAIRS] <= room
            and (not listed or summary[words.HITS] <= len(hits.face))
            and (not len(hits.uncertain) or max(summary[[words.UNCERTAIN_PAIRS, words.APART]]) <= len(hits.uncertain))
        )

    def find(self, between=None):
        """Query with room for all that is found; calls `between` after the broad phase. Waits for the device."""
        if self.dynamics is None:
            self.query.grow(between)
        else:
            self.dynamics.find_contacts(between)

    def finish_bodies(self):
        """Finish a step of rigid bodies that lacked room, see `Dynamics.finish`."""
        if self.dynamics is not None:
            self.dynamics.finish(self.time_step)

    def respond(self, mark: Callable):
        """Summarise what the query has found, and let rigid bodies respond to it. Launches only."""
        self._summarise()
        mark("query_ms", self._count_tests)
        if self.dynamics is not None:
            self.dynamics.answer(self.time_step)
