"""The frame loop: select LODs, refine, move, find candidate pairs, intersect them, respond; each stage timed.

LODs come from a controller (`warp_abtree.lod.controllers`), or from a function of time. Everything but that function,
and a motion in Python, runs on the device: on a GPU as one graph, after which the host reads a few numbers.

Source: Liu et al. 2006, Algorithm 4.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from operator import call
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import positive
from warp_abtree.checks.device_memory import DeviceMemory
from warp_abtree.checks.regime import current_regime
from warp_abtree.kernels.lod.frame_summary import TRIANGLE_WORK
from warp_abtree.lod.controllers import Controller, Feedback
from warp_abtree.lod.timing import Timer
from warp_abtree.query.request import check_request
from warp_abtree.query.result import Result
from warp_abtree.scene.posed_objects import expect_scene
from warp_abtree.scene.scene import Scene
from warp_abtree.simulate.budget_report import summarise_rows
from warp_abtree.simulate.frame_file import FrameFile
from warp_abtree.simulate.frame_row import ROW_FIELDS, FrameRow, LodTracker
from warp_abtree.simulate.frame_stages import FrameStages
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


@dataclass
class OpenFrame:
    """A frame from its start until its row is appended: where it is interrupted, it is finished from this."""

    time: float  # in the scene [s]
    rests: bool = False  # whether all LODs are known to stay, so that none are selected
    changes: Any = None  # `LodUpdate` of LODs that a function of time has changed
    is_short: bool = False  # whether its buffers were too small, and it is launched again

    @property
    def refitted(self) -> int:
        """Nodes refitted by these changes."""
        return 0 if self.changes is None else int(np.sum(self.changes.nodes_refitted, dtype=np.int64))


def check_motion(motion, scene: Scene):
    """Raise ValueError for a motion of another number of objects, or of bodies of another scene."""
    if motion is not None and not hasattr(type(motion), "__len__"):
        raise TypeError(f"motion: a {type(motion).__name__} is no motion of so many objects")
    if motion is not None and len(motion) != scene.object_count:
        raise ValueError(f"the motion is of {len(motion)} objects, the scene has {scene.object_count}")
    if isinstance(motion, SteppedMotion) and motion.dynamics.scene is not scene:
        raise ValueError("the motion is of the bodies of another scene")


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
        output: Output of the query: "any", which costs least, "count", "faces" or "contacts".
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
        output: str = "any",
        time_step: float = 1 / 60,
        clock: Callable[[], float] | None = None,
    ):
        check_motion(motion, expect_scene(scene))
        if not (lods is None or callable(lods) or isinstance(lods, Controller)):
            raise ValueError(f"lods: a {type(lods).__name__} is neither a controller nor a function of time")
        if not (clock is None or callable(clock)):
            raise ValueError(f"clock: a {type(clock).__name__} cannot be called")
        if isinstance(lods, Controller) and isinstance(motion, SteppedMotion):
            motion.warn_of_coarse_lods()
        check_request("faces" if isinstance(output, str) and output == "contacts" else output, "exact")
        self.scene, self.motion, self.lods, self.output = scene, motion, lods, output
        self.time_step = positive(time_step, "time_step")
        self.history: list[FrameRow] = []
        self._files: list[FrameFile] = []
        self._timer = Timer(scene.device, clock)
        captures = current_regime().captures_frames
        self._captures = clock is None and (scene.device.is_cuda if captures is None else captures)
        self._feedback = Feedback(0.0)
        self._lods = LodTracker(scene)
        self._stages: Any = None
        self._open: OpenFrame | None = None

    def warm_up(self):
        """Run every stage once and keep no row, so that no row times the loading of kernels.

        Nothing moves, and LODs stay as they are, but that those off a controller's ladder go to its next finer level:
        changes of them are launched on copies. Waits for the device.
        """
        stages = self._ready()
        if stages.controller is not None:
            stages.controller.next_lods(self._feedback)
        if self.lods is not None:
            load_update_kernels(self.scene)
        stages.warm_up()
        wp.synchronize_device(self.scene.device)

    def step(self) -> Result:
        """Run the next frame, append its row, and return what the query found. Waits for the device."""
        self._advance()
        return self._stages.result()

    def run(self, frames: int, progress=None) -> list[FrameRow]:
        """Run a number of frames and return the whole history; progress(done, total) is called after each."""
        for done in range(1, frames + 1):
            self._advance()
            if progress is not None:
                progress(done, frames)
        return self.history

    def _ready(self) -> FrameStages:
        """Return the stages of the frame, made anew where scene, motion, controller or output are others."""
        asked = self.scene, self.motion, self.lods if isinstance(self.lods, Controller) else None, self.output
        if self._stages is None or not self._stages.serves(*asked):
            check_motion(self.motion, self.scene)
            self._open = None
            self._stages = FrameStages(*asked, self.time_step, self._timer)
            self._lods.restart(self.scene)
        return self._stages

    def _advance(self):
        """Run the next frame and append its row; of one that was interrupted while its graph ran, do the rest."""
        stages, timer, frame = self._ready(), self._timer, self._open
        if frame is None or not (frame.is_short or stages.summary()["frames"] != stages.seen):
            self._open, frame = None, OpenFrame(len(self.history) * self.time_step)
            captures, launches = self._captures and bool(self.history), []
            launch = launches.append if captures else call
            stages = self._select(stages, frame, captures)
            launch(partial(stages.select, frame.rests))
            places = stages.bring_poses(frame.time)
            launch(partial(stages.arrange, frame.rests, places))
            launch(stages.find)
            launch(stages.respond)
            if captures:
                timer.mark("move_ms")
                graph = stages.find_graph((frame.rests, places), launches)
                self._open = frame
                wp.capture_launch(graph)
                timer.mark("answer_ms" if timer.uses_events else "query_ms")
                stages.look_ahead((len(self.history) + 1) * self.time_step)
        if stages.answer is None and timer.marks[-1] != "answer_ms":
            timer.mark("answer_ms")
        found = stages.summary()
        if frame.is_short or not stages.has_room(found):
            frame.is_short = True
            stages.grow()
            stages.respond_again()
            found = stages.summary()
            frame.is_short = False
        stages.finish_bodies()
        if stages.answer is not None:
            stages.answer(stages.result(), self.time_step)
        if stages.answer is not None or timer.marks[-1] != "answer_ms":
            timer.mark("answer_ms")
        self._record(stages, frame, found)
        self._open = None
        for file in self._files:
            file.append(self.history)

    def _select(self, stages, frame, captures) -> FrameStages:
        """Do the host's part of the selection; return the stages, anew where a function of LODs changed the scene."""
        timer, controller, scene = self._timer, stages.controller, self.scene
        if controller is not None:
            last = self.history[-1] if self.history and stages.seen else None
            stayed = last is not None and not (last.lods_changed or last.nodes_refitted)
            frame.rests = stayed and controller.rests(self._feedback)
            timer.begin()
            controller.prepare(replace(self._feedback, time=frame.time), frame.rests)
            if captures:
                timer.mark("select_ms")
            return stages
        timer.begin()
        wanted = None if self.lods is None else np.asarray(self.lods(frame.time))
        timer.mark("select_ms", lambda: {"selected": 0 if wanted is None else scene.object_count})
        if wanted is not None and not np.array_equal(wanted, scene.lods):
            frame.changes = scene.set_lods(wanted)
        timer.mark("refine_ms", lambda: {"lod_change": int(frame.changes is not None), "node_refitted": frame.refitted})
        return stages if self.lods is None else self._ready()

    def _record(self, stages, frame, found):
        """Append the row of a frame of which a summary was found, and keep what the next selection is told."""
        stage_ms = self._timer.stage_ms()
        if frame.changes is not None:
            found |= {**self._lods.measure(self.scene), "nodes_refitted": frame.refitted}
        elif found["lods_changed"]:
            self._lods.columns = stages.table.columns(found["levels"])
        tests = found["node_tests"] + int(TRIANGLE_WORK) * found["triangle_tests"]
        row = found | self._lods.columns | stage_ms
        row |= {"frame": len(self.history), "time": frame.time, "objects": int(self.scene.present.sum())}
        row["budget_ms"] = getattr(self.lods, "budget_ms", None)
        if stages.query.output == "any":
            row["hits"] = None
        self._feedback = Feedback(frame.time, stage_ms, found["nodes_refitted"], float(tests))
        made = FrameRow(**{name: row[name] for name in ROW_FIELDS})
        stages.seen = found["frames"]
        self.history.append(made)

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
        return summarise_rows(self.history, after)

    def record(self, path):
        """Write the history to a .json file, or as CSV to any other, and every further row as it comes.

        The file replaces what stood there with the first row, and can be read after each, whatever ends the run.

        Raises:
            OSError: The file cannot be written; `step` and `run` raise it too, when the frame is over.
        """
        self._files.append(FrameFile(path))
        self._files[-1].append(self.history)
