"""The frame loop: select LODs, refine, move, find candidate pairs, intersect them, respond; each stage timed.

LODs come from a controller (`warp_abtree.lod.controllers`), or from a function of time. Everything but that function,
and a motion in Python, runs on the device: on a GPU as one graph, after which the host reads a few numbers.

Source: Liu et al. 2006, Algorithm 4.
"""

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import positive
from warp_abtree.checks.device_memory import DeviceMemory
from warp_abtree.checks.regime import current_regime
from warp_abtree.kernels.lod import frame_summary as words
from warp_abtree.lod.controllers import Controller, Feedback
from warp_abtree.lod.timing import STAGES, Timer
from warp_abtree.query.request import check_request
from warp_abtree.query.result import Result
from warp_abtree.scene.scene import Scene
from warp_abtree.simulate.budget_report import budget_report, cost_at_coarsest
from warp_abtree.simulate.frame_file import FrameFile
from warp_abtree.simulate.frame_row import FrameRow, LodColumns
from warp_abtree.simulate.frame_stages import FrameStages
from warp_abtree.simulate.motion import Kinematic
from warp_abtree.simulate.rigid_bodies import SteppedMotion
from warp_abtree.state.work_lists import full_refit_fraction


def load_update_kernels(scene: Scene):
    """Launch all kernels of LOD changes on a copy of the smallest model that uses them all.

    These are a partial refit from a copied state, one in place, and a full refit. Very small models always have full
    refits.
    """
    share, copy = full_refit_fraction(scene.device), Scene(device=scene.device)
    models = sorted((model for model in scene.models if model.lod_max), key=lambda model: model.face_count)
    if not models:
        return
    spans = [np.diff(model.progressive.split_start) for model in models]
    used = (i for i, model in enumerate(models) if spans[i].min() <= share * model.face_count)
    place = next(used, 0)
    chosen, step = models[place], int(spans[place].argmin())
    for _ in range(2):
        copy.add(chosen, lod=step)
    for lods in ((step, step + 1), (step + 1, step), (0, chosen.lod_max), (chosen.lod_max, chosen.lod_max)):
        copy.set_lods(lods)


class Frame(DeviceMemory):
    """Runs a scene frame by frame and keeps a `FrameRow` on each.

    On a GPU, and without a clock of its own, a frame is the replay of one graph, captured at the second frame and
    again after a buffer grew: a frame that finds more than its buffers hold is finished with larger ones, at the cost
    of its time.

    A motion has a length, the number of objects, and these methods, called in this order in every frame:

    - `poses(time, out)` returns the poses at a time [s], float64 (n, 7), in `out` or an array of its own, or None if
      it has set the poses of the scene itself
    - `answer(result, time_step)`, optional, takes the result, and moves on by the time to the next frame [s]

    Args:
        scene: `Scene` with all its objects.
        motion: `Kinematic`, or anything with the methods above; `Dynamics.motion()` for rigid bodies; None leaves the
            objects where they are.
        lods: A controller of `warp_abtree.lod.controllers`, which serves objects from states of its ladder's levels
            (`LevelStates`); or a function from time [s] to the LOD of every object, int (n,); None leaves them.
        output: Output of the query: "any", "count", "faces" or "contacts".
        time_step: Time between frames [s], above 0.
        clock: Returns seconds; read between stages when the device has finished. A clock with a method `charge` is
            first told the counted work of the stage (`WorkClock`). None is the host's clock, on a GPU CUDA events.

    Attributes:
        history: One `FrameRow` a frame run.

    Raises:
        ValueError: A motion of another number of objects, a time step that is not above 0 and finite, an unknown
            output, LODs that are neither a controller nor a function, or a clock that cannot be called.
    """

    def __init__(
        self,
        scene: Scene,
        motion: Any = None,
        lods: Any = None,
        output: str = "count",
        time_step: float = 1 / 60,
        clock: Callable[[], float] | None = None,
    ):
        if motion is not None and len(motion) != scene.object_count:
            raise ValueError(f"the motion is of {len(motion)} objects, the scene has {scene.object_count}")
        if not (lods is None or callable(lods) or isinstance(lods, Controller)):
            raise ValueError(f"lods: a {type(lods).__name__} is neither a controller nor a function of time")
        if not (clock is None or callable(clock)):
            raise ValueError(f"clock: a {type(clock).__name__} cannot be called")
        check_request("faces" if output == "contacts" else output, "exact")
        self.scene = scene
        self.motion = motion
        self.lods = lods
        self.output = output
        self.time_step = positive(time_step, "time_step")
        self.history: list[FrameRow] = []
        self._files: list[FrameFile] = []
        self._timer = Timer(scene.device, clock)
        captures = current_regime().captures_frames
        self._captures = clock is None and (scene.device.is_cuda if captures is None else captures)
        self._feedback = Feedback(0.0)
        self._poses = np.empty((scene.object_count, 7))
        self._stages: Any = None
        # Graphs and the marks that they make, by what is in them, all captured with the same arrays.
        self._graphs: dict[tuple, tuple] = {}
        self._given: tuple = ()
        # Frames that the device has counted; time and LOD changes of a frame that is not recorded yet while its graph
        # runs, and whether its buffers were too small.
        self._seen, self._is_short = 0, False
        self._open: tuple | None = None
        # A time and a motion, and its poses then.
        self._ahead: tuple = (None, None)
        self._direction = np.zeros(scene.object_count, np.int8)
        self._lods = scene.batch().lods
        self._measure_lods()

    @property
    def _stepped(self) -> SteppedMotion | None:
        return self.motion if isinstance(self.motion, SteppedMotion) else None

    def warm_up(self):
        """Run every stage once and keep no row, so that no row times the loading of kernels.

        Nothing moves, and LODs stay as they are, but that those off a controller's ladder go to its next finer level:
        changes of them are launched on copies. Waits for the device.
        """
        stages = self._ready()
        if isinstance(self.lods, Controller):
            self.lods.next_lods(self._feedback)
        if self.lods is not None:
            load_update_kernels(self.scene)
        if self._stepped is not None:
            self._stepped.warm_up(self.time_step)
        stages.warm_up()
        wp.synchronize_device(self.scene.device)

    def step(self) -> Result:
        """Run the next frame, append its row, and return what the query found. Waits for the device."""
        self._advance()
        self._write_rows()
        return self._result()

    def run(self, frames: int, progress=None) -> list[FrameRow]:
        """Run a number of frames and return the whole history; progress(done, total) is called after each."""
        for done in range(1, frames + 1):
            self._advance()
            self._write_rows()
            if progress is not None:
                progress(done, frames)
        return self.history

    def _result(self):
        query = self._stages.query
        return query.result() if self._stepped is None else query.result(with_points=False)

    def _ready(self) -> FrameStages:
        """Return the stages of the frame, made anew where scene, controller or output are others."""
        controller = self.lods if isinstance(self.lods, Controller) else None
        if self._stages is None or not self._stages.serves(self.scene, controller, self.output):
            self._open, self._is_short = None, False
            self._graphs.clear()
            dynamics = None if self._stepped is None else self._stepped.dynamics
            moves = self.motion is not None
            self._stages = FrameStages(self.scene, controller, dynamics, self.output, self.time_step, moves)
            self._seen = 0
            self._lods = self.scene.batch().lods
            self._measure_lods()
        return self._stages

    def _advance(self):
        """Run the next frame and append its row; only finish it where it was interrupted while its graph ran."""
        stages = self._ready()
        if self._open is not None and (self._is_short or stages.read()[words.FRAMES] != self._seen):
            self._finish(stages, *self._open)
            return
        self._open, self._is_short = None, False
        time, rests = len(self.history) * self.time_step, self._rests()
        self._timer.begin()
        if isinstance(self.lods, Controller):
            self.lods.prepare(replace(self._feedback, time=time), rests)
            changes = None
        else:
            changes = self._choose(time)
            stages = self._ready()
        if self._captures and self.history:
            self._replay(stages, time, changes, rests)
        else:
            stages.launch_selection(self._timer.mark, rests)
            stages.launch_query(self._timer.mark, self._place(stages, time))
        self._finish(stages, time, changes)

    def _rests(self) -> bool:
        """Return whether the controller's LODs are known to stay, after a frame in which they did."""
        if not (isinstance(self.lods, Controller) and self.history and self._seen):
            return False
        last = self.history[-1]
        return not (last.lods_changed or last.nodes_refitted) and self.lods.rests(self._feedback)

    def _choose(self, time):
        """Bring objects to the LODs of a function of time; return the `LodUpdate`, None where nothing changes."""
        wanted = None if self.lods is None else np.asarray(self.lods(time))
        self._timer.mark("select_ms", lambda: {"selected": 0 if wanted is None else self.scene.object_count})
        changes = None
        if wanted is not None and not np.array_equal(wanted, self.scene.lods):
            changes = self.scene.set_lods(wanted)
        work = {"lod_change": int(changes is not None)}
        self._timer.mark("refine_ms", lambda: work | {"node_refitted": _refitted(changes)})
        return changes

    def _place(self, stages, time) -> bool:
        """Bring the poses of a time to the device; return whether there are any that the motion has not set itself."""
        known, rows = self._ahead
        if known != (time, self.motion) and hasattr(self.motion, "poses"):
            rows = self._find_rows(stages, time)
        self._ahead = None, None
        if self._stepped is not None:
            self._stepped.aim(time + self.time_step)
        if rows is not None:
            stages.take_rows(rows)
        return rows is not None

    def _find_rows(self, stages, time):
        """Return the poses of a time, (n, 7), or None if the motion has set those of the scene."""
        poses = self.motion.poses(time, out=self._poses)
        return None if poses is None else stages.check_rows(poses)

    def _replay(self, stages, time, changes, rests):
        """Run a frame as a graph, captured anew where arrays were replaced since."""
        timer = self._timer
        if isinstance(self.lods, Controller):
            timer.mark("select_ms")
        places = self._place(stages, time)
        timer.mark("move_ms")
        if stages.arrays() != self._given:
            self._graphs.clear()
            self._given = stages.arrays()
        if (places, rests) in self._graphs:
            graph, marks = self._graphs[places, rests]
            timer.replay(marks)
        else:
            before = len(timer.marks())
            with wp.ScopedCapture(self.scene.device) as capture:
                stages.launch_selection(timer.mark, rests)
                stages.launch_query(timer.mark, places)
            graph = capture.graph
            self._graphs[places, rests] = graph, timer.marks()[before:]
        self._open = time, changes
        wp.capture_launch(graph)
        timer.mark("answer_ms" if timer.uses_events else "query_ms")
        # The host's part of the next frame, while the device works on this one.
        following = (len(self.history) + 1) * self.time_step
        if isinstance(self.lods, Controller):
            with suppress(Exception):  # a camera that there is none of raises when its frame comes
                self.lods.look_ahead(following)
        if isinstance(self.motion, Kinematic):
            self._ahead = (following, self.motion), self._find_rows(stages, following)

    def _finish(self, stages, time, changes):
        """Answer a frame that was launched, and append its row. Waits for the device."""
        timer, answers = self._timer, hasattr(self.motion, "answer")
        if not answers and timer.marks()[-1] != "answer_ms":
            timer.mark("answer_ms")
        if self._is_short or not stages.is_whole(stages.read()):
            self._is_short = True
            stages.find()
            stages.respond(timer.mark)
            self._is_short = False
        stages.finish_bodies()
        if answers:
            self.motion.answer(self._result(), self.time_step)
        if answers or timer.marks()[-1] != "answer_ms":
            timer.mark("answer_ms")
        self._record(stages, time, changes, stages.read())
        self._open = None

    def _record(self, stages, time, changes, summary):
        """Append the row of a frame, and keep what the next selection is told."""
        stage_ms, node_tests = self._timer.stage_ms(), int(summary[words.NODE_TESTS])
        triangle_tests, refitted = int(summary[words.TRIANGLE_TESTS]), int(summary[words.REFITTED])
        changed, oscillations = int(summary[words.CHANGED]), int(summary[words.TURNED])
        if changes is not None:
            refitted, (changed, oscillations) = _refitted(changes), self._measure_lods()
        elif changed:
            self._lod_columns = stages.table.columns(summary[words.HEAD :])
        tests = node_tests + int(words.TRIANGLE_WORK) * triangle_tests
        self._feedback = Feedback(time, stage_ms, refitted, float(tests))
        self._seen = int(summary[words.FRAMES])
        self.history.append(
            FrameRow(
                frame=len(self.history),
                time=time,
                objects=self.scene.object_count,
                pairs=int(summary[words.PAIRS]),
                intersecting=int(summary[words.INTERSECTING]),
                hits=None if stages.query.output == "any" else int(summary[words.HITS]),
                lods_changed=changed,
                oscillations=oscillations,
                nodes_refitted=refitted,
                node_tests=node_tests,
                triangle_tests=triangle_tests,
                budget_ms=getattr(self.lods, "budget_ms", None),
                **self._lod_columns,
                **stage_ms,
            )
        )

    def summary(self, after: float = 1.0) -> dict:
        """Return mean, min and max of the counts, the range of LODs, and mean, p95 and total of stages [ms].

        Args:
            after: `budget`, the result of `budget_report`, leaves out frames before this time [s]. A budget below
                `coarsest_ms` (`cost_at_coarsest`) is impossible.

        Raises:
            ValueError: No frame has run.
        """
        if not self.history:
            raise ValueError("a summary is of frames, and none has run")
        rows = [row.as_dict() for row in self.history]
        found: dict[str, Any] = {"frames": len(rows), "objects": self.scene.object_count, "stages": {}}
        counts = "states", "pairs", "intersecting", "hits", "faces", "nodes_refitted", "node_tests", "triangle_tests"
        for name in (*counts, "error_mean", "error_max"):
            values = np.array([math.nan if row[name] is None else row[name] for row in rows], np.float64)
            found[name] = {"mean": float(values.mean()), "min": float(values.min()), "max": float(values.max())}
        for name in (*STAGES, "total_ms"):
            values = np.array([row[name] for row in rows])
            p95 = float(np.percentile(values, 95))
            found["stages"][name] = {"mean": float(values.mean()), "p95": p95, "total": float(values.sum())}
        found["lod_min"] = min(row["lod_min"] for row in rows)
        found["lod_max"] = max(row["lod_max"] for row in rows)
        found["budget_ms"] = rows[-1]["budget_ms"]
        found["coarsest_ms"] = None if found["budget_ms"] is None else cost_at_coarsest(self.history)
        found["budget"] = budget_report(self.history, after=after)
        return found

    def record(self, path):
        """Write the history to a .json file, or as CSV to any other, and every further row as it comes.

        The file replaces what stood there with the first row, and can be read after each, whatever ends the run.

        Raises:
            OSError: The file cannot be written; `step` and `run` raise it too, when the frame is over.
        """
        self._files.append(FrameFile(path))
        self._write_rows()

    def _write_rows(self):
        for file in self._files:
            file.append(self.history)

    def _measure_lods(self):
        """Measure the LODs as they stand; return how many changed, and how many of these reversed their direction."""
        scene, lods = self.scene, self.scene.lods.astype(np.int64)
        direction = np.sign(lods - self._lods).astype(np.int8)
        changed = int(np.count_nonzero(direction))
        oscillations = int(np.count_nonzero(direction * self._direction < 0))
        self._direction = np.where(direction == 0, self._direction, direction)
        self._lods = lods
        keys, repeats = np.unique((np.array(scene.object_model, np.int64) << 32) + lods, return_counts=True)
        self._lod_columns = LodColumns(scene.models, keys >> 32, keys & (2**32 - 1)).columns(repeats)
        return changed, oscillations


def _refitted(changes) -> int:
    return 0 if changes is None else int(np.sum(changes.nodes_refitted, dtype=np.int64))
