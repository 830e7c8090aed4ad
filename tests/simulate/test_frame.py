"""Frames against fresh scenes and an injected clock; whole runs, and worlds alone and among others."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import refused
from helpers.bodies import ring_and_ball
from helpers.samples import sample
from helpers.scenes import scene_with

import warp_abtree as ab
from warp_abtree.lod.controllers import PaperController, PredictiveController, ToleranceController
from warp_abtree.lod.timing import STAGES, WorkClock
from warp_abtree.lod.view import Camera
from warp_abtree.simulate.budget_report import budget_report
from warp_abtree.simulate.frame_row import FrameRow
from warp_abtree.simulate.lod_request import LodSweep, resolve_lod

RING, BALL = ring_and_ball()
MODELS = (RING, BALL, RING)


def make_motion():
    return ab.Kinematic(
        position=[[0.0, 0.0, 0.0], [0.7, 0.0, 0.0], [0.0, 0.3, 0.0]],
        velocity=[[0.0, 0.0, 0.0], [-0.5, 0.0, 0.0], [0.1, 0.0, 0.0]],
        axis=[1.0, 2.0, -1.0],
        rate=[0.0, 1.0, 2.5],
    )


def test_sweep_goes_down_and_up_in_equal_ratios():
    sweep = LodSweep([(RING, np.array([0, 2]))], 1.0, 0.04, 4.0)
    assert [sweep.fraction(t) for t in (0, 1, 2, 3, 4)] == pytest.approx([1.0, 0.2, 0.04, 0.2, 1.0])
    lods = np.array([7, 7, 7])
    sweep.apply(0.5, lods)
    assert lods.tolist() == [RING.lod_for(fraction=0.5), 7, RING.lod_for(fraction=0.5)]


def test_lod_requests():
    top, quarter = RING.lod_max, RING.lod_for(fraction=0.25)
    requests = "finest", "coarsest", 17, "17", 0.25, "0.25", 1.0, "1", "tol:1e30", "tol:0"
    lods = [top, 0, 17, 17, quarter, quarter, top, 1, *(RING.lod_for(tolerance=x) for x in (1e30, 0))]
    assert [resolve_lod(RING, request) for request in requests] == lods
    for request in ("", "fine", "tol:", "tol:x", "tol:-1", "tol:nan", "nan", 0.0, 1.5, -1, RING.lod_max + 1, "2.0"):
        refused(ValueError, None, resolve_lod, RING, request)


def test_stages_are_timed_apart():
    steps = [100.0, 0.5, 0.001, 0.020, 0.300, 4.0, 60.0, 50.0, 0.6, 0.002, 0.030, 0.400, 5.0, 70.0]
    ticks = iter(np.cumsum(steps))
    frame = ab.Frame(scene_with("cpu", *MODELS), make_motion(), output="any", clock=lambda: next(ticks))
    frame.warm_up()
    rows = frame.run(2)
    stages = [tuple(getattr(row, stage) for stage in STAGES) for row in rows]
    assert stages == [(500, 1, 20, 300, 4000, 60000), (600, 2, 30, 400, 5000, 70000)]  # to the nanosecond
    assert rows[1].total_ms == pytest.approx(76032)
    assert rows[0].hits is None
    summary = frame.summary()
    assert summary["stages"]["query_ms"] == pytest.approx({"mean": 4500, "p95": 4950, "total": 9000})
    assert summary["frames"] == 2 and summary["objects"] == 3
    assert summary["budget"] is None and summary["budget_ms"] is None


def check_rows(path, frame, count):
    """Compare a file with the first rows of a frame's history."""
    expected = [row.as_dict() for row in frame.history[:count]]
    if path.suffix == ".json":
        assert json.loads(path.read_text()) == expected
        return True
    rows = list(csv.DictReader(path.read_text().splitlines()))
    assert list(rows[0]) == FrameRow.names()
    return [{key: float(value) if value else None for key, value in row.items()} for row in rows] == expected


@pytest.mark.parametrize("name", ["rows.csv", "rows.json"])
def test_rows_are_written_as_they_come(tmp_path, name):
    """The file is whole after each, and takes the place of another with the first; rows before `record` count too."""
    path, late, seen = tmp_path / name, tmp_path / f"late-{name}", []
    path.write_text("old")
    frame = ab.Frame(scene_with("cpu", *MODELS), make_motion())
    frame.record(path)
    assert path.read_text() == "old"
    for count in (1, 2, 3):
        frame.step()
        assert check_rows(path, frame, count)
    frame.record(late)
    assert late.read_bytes() == path.read_bytes()
    frame.run(2, progress=lambda *steps: seen.append((*steps, check_rows(path, frame, 3 + steps[0]))))
    assert seen == [(1, 2, True), (2, 2, True)] and late.read_bytes() == path.read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([name, late.name])


@pytest.mark.parametrize("name", ["rows.csv", "rows.json"])
@pytest.mark.parametrize("room", [0, 1, 100])
def test_a_full_disk_keeps_the_rows_before(tmp_path, name, room):
    """The row that does not fit is raised, and written when there is room again."""
    resource = pytest.importorskip("resource")
    path, frame = tmp_path / name, ab.Frame(scene_with("cpu", *MODELS), make_motion())
    frame.record(path)
    frame.run(2)
    before = path.read_bytes()
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) + room, limit[1]))
        refused(OSError, None, frame.run, 3)
        assert path.read_bytes() == before and len(frame.history) == 3
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    frame.step()
    assert check_rows(path, frame, 4) and [row.frame for row in frame.history] == [0, 1, 2, 3]


def test_controllers_move_lods_from_the_coarsest(device):
    for kind in (PaperController, PredictiveController):
        scene = scene_with(device, *MODELS)
        frame = ab.Frame(scene, make_motion(), kind(scene, 1e6), clock=WorkClock())
        frame.warm_up()
        assert scene.lods.tolist() == [RING.lod_max, BALL.lod_max, RING.lod_max]
        rows = frame.run(80)
        assert rows[0].lod_max == 0 and rows[0].lods_changed == 3 and rows[0].oscillations == 0
        assert scene.lods.tolist() == [RING.lod_max, BALL.lod_max, RING.lod_max]
        assert rows[-1].error_max == 0 < rows[0].error_mean <= rows[0].error_max
        summary = frame.summary()
        assert summary["budget_ms"] == 1e6 and summary["budget"] == budget_report(rows) and json.dumps(summary)
        assert summary["budget"]["frames"] == 20 and frame.summary(after=0.0)["budget"]["frames"] == 80


def test_selection_rests_while_the_finest_lods_fit(device):
    """It is left out then, and is back in the frame after one that was too long, or after LODs were set."""
    scene = scene_with(device, *MODELS)
    clock = WorkClock({"node_test": 1e-7, "triangle_test": 2e-7})
    frame = ab.Frame(scene, make_motion(), PredictiveController(scene, 1e6), "count", clock=clock)
    frame.warm_up()
    selects = np.array([row.select_ms > 0 for row in frame.run(80)])
    rests = int(np.flatnonzero(selects).max()) + 1
    assert selects[:rests].all() and 2 < rests < 60
    scene.set_lods([0, 0, 0])
    rows = frame.run(100)[80:]
    assert rows[0].select_ms > 0 and rows[0].lods_changed == 3 and rows[-1].select_ms == 0 and rows[-1].error_max == 0
    frame.lods = controller = PredictiveController(scene, 1.2 * max(row.total_ms for row in rows))
    frame.run(60)
    assert frame.history[-1].select_ms == 0 and frame.history[-1].error_max == 0
    for rate in ("node_test", "triangle_test"):
        clock.rates[rate] *= 10
    most = controller.aim * controller.budget_ms
    times = np.array([(row.select_ms > 0, row.total_ms > most) for row in frame.run(20)])
    assert times[240, 1] and (times[240:-1, 1] <= times[241:, 0]).all()
    assert frame.history[-1].error_max > 0


def test_work_is_counted_not_timed(device):
    rates = dict.fromkeys(WorkClock().rates, 0.0)
    for name, stage, count in (
        ("node_test", "query_ms", lambda row: row.node_tests),
        ("triangle_test", "query_ms", lambda row: row.triangle_tests),
        ("candidate", "broad_ms", lambda row: row.pairs),
        ("posed", "move_ms", lambda row: 3),
        ("node_refitted", "refine_ms", lambda row: row.nodes_refitted),
        ("lod_change", "refine_ms", lambda row: int(row.lods_changed > 0)),
        ("selected", "select_ms", lambda row: 3),
    ):
        lods = lambda time: np.array([40, 60, 40 + int(5 * time + 0.01)])  # noqa: E731
        clock = WorkClock({**rates, name: 1e-3})
        rows = ab.Frame(scene_with(device, *MODELS), make_motion(), lods, time_step=0.1, clock=clock).run(4)
        assert [getattr(row, stage) for row in rows] == [count(row) for row in rows], name
        assert sum(count(row) for row in rows) > 0
        assert all(row.total_ms == getattr(row, stage) for row in rows)
    refused(ValueError, "'tests' is none of", WorkClock, {"tests": 1.0})


def test_rows_tell_turns():
    lods = np.array([[10, 20, 30], [20, 20, 30], [15, 25, 30], [15, 20, 31], [20, 20, 30], [20, 20, 30]])
    rows = ab.Frame(scene_with("cpu", *MODELS), lods=lambda time: lods[round(time)], time_step=1.0).run(6)
    # Objects start at their finest, so that the first change is a fall for all.
    assert [row.lods_changed for row in rows] == [3, 1, 2, 2, 2, 0]
    assert [row.oscillations for row in rows] == [0, 1, 2, 2, 2, 0]


class Pusher:
    """Moves the third object away whenever anything touches, and sets the scene's poses itself."""

    def __init__(self, scene, log):
        self.scene, self.log, self.x = scene, log, 0.0

    def __len__(self):
        return 3

    def poses(self, time, out):
        self.log.append(("poses", time))
        out[:] = make_motion().poses(0.0)
        out[2, 0] += self.x
        self.scene.set_poses(out)

    def answer(self, result, time_step):
        self.log.append(("answer", int(result.any.sum())))
        self.x += 10.0 * time_step * result.any.any()


def test_a_motion_is_told_what_was_found(device):
    log, scene = [], scene_with(device, *MODELS)
    rows = ab.Frame(scene, Pusher(scene, log), time_step=0.25).run(3)
    assert [row.pairs for row in rows] == [3, 1, 1] and [row.intersecting for row in rows] == [3, 1, 1]
    for i, row in enumerate(rows):
        step = [("poses", 0.25 * i), ("answer", row.intersecting)]
        assert [log.pop(0) for _ in step] == step


ROOT = Path(__file__).resolve().parents[2]
WARMED_UP = """
import sys, numpy as np, trimesh, warp_abtree as ab
device, kind = sys.argv[1:]
ring = ab.Model.load(trimesh.creation.torus(0.5, 0.15, major_sections=64, minor_sections=24))
scene = ab.Scene(device=device)
for i in range(3):
    scene.add(ring, (0.3 * i, 0, 0, 0, 0, 0, 1))
top = ring.lod_max
motion = ab.Dynamics(scene).motion() if kind == "bodies" else None
steps = [(top, top - 1, 0), (top, top - 1, top - 1), (0, 1, 2), (top, top, top)]
lods = lambda time: np.array(steps[min(round(60 * time), 3)])
if kind == "budget":
    lods = ab.PredictiveController(scene, 1e6, ab.Camera.look_at((0, 0, 9), (0, 0, 0)))
frame = ab.Frame(scene, motion, lods, "count")
before = scene.lods.tolist(), scene.batch().objects.pool.position.numpy().tobytes()
frame.warm_up()
assert before == (scene.lods.tolist(), scene.batch().objects.pool.position.numpy().tobytes()) and not frame.history
print("warm", flush=True)
frame.run(8)
print(sum(row.lods_changed for row in frame.history), frame.history[-1].hits)
"""


@pytest.mark.parametrize("kind", ["bodies", "budget", "lods"])
@pytest.mark.slow
def test_nothing_is_loaded_after_the_warm_up(device, kind):
    """In a process of its own, where nothing is loaded yet; Warp says what it loads."""
    words = [sys.executable, "-c", WARMED_UP, device, kind]
    said = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    before, after = said.split("warm\n")
    assert "load on device" in before and "load on device" not in after, after
    changed, hits = map(int, after.split())
    assert changed >= 3 and hits > 0


def run_worlds(device, worlds, kind, moved):
    """Run some of three worlds with an object that is in all; return LODs, pairs and hits by world and frame."""
    rng, scene = np.random.default_rng(7), ab.Scene(device)
    rows = [(rng.uniform(-0.8, 0.8, (4, 3)), rng.uniform(-1, 1, (4, 3)), rng.uniform(1, 3, 4)) for _ in range(3)]
    place, velocity, rate = (np.concatenate([*(rows[w][k] for w in worlds), 0 * rows[0][k][:1]]) for k in range(3))
    motion = ab.Kinematic(place, velocity=velocity, axis=(1, 2, 3), rate=rate)
    for place, world in enumerate(worlds):
        for i in range(4):
            scene.add(ring_and_ball()[i % 2], world=place, importance=1 + (world + i) % 3)
    scene.add(ring_and_ball()[0], world=-1, static=True)
    scene.set_poses(motion.poses(0.0))
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), far=10.0)
    lods = PaperController(scene, 8.0, camera) if kind == "paper" else ToleranceController(scene, 0.01, camera)
    if moved == "bodies":
        motion = ab.Dynamics(scene, gravity=(0, 0, -3), velocity=motion.velocity).motion()
    ticks = np.cumsum(np.random.default_rng(3).uniform(0, 1.5e-3, 30 * (len(STAGES) + 1)))
    frame = ab.Frame(scene, motion, lods, clock=iter(ticks.tolist()).__next__, output="faces")
    found = {world: [] for world in worlds}
    for _ in range(30):
        result = frame.step()
        for place, world in enumerate(worlds):
            mine = np.append(np.arange(4 * place, 4 * place + 4), 4 * len(worlds))
            kept = np.isin(result.pairs, mine).all(1)
            pairs = np.searchsorted(mine, result.pairs[kept]).tolist()
            seen = [scene.lods[mine].tolist(), pairs, result.count[kept].tolist()]
            if scene.device.is_cpu:  # warps start a pair deeper the more of them share it
                seen.append(result.node_tests[kept].tolist())
            if result.faces is not None:
                seen.append(result.faces[kept[result.faces[:, 0]], 1:].tolist())
            found[world].append(seen)
    return found


@pytest.mark.parametrize("moved", ["as told", "bodies"])
@pytest.mark.parametrize("kind", ["paper", "tolerance"])
def test_worlds_alone_and_together_are_the_same(device, kind, moved):
    """On one clock. (A predicted budget is shared by all that is in the scene, so it is another alone.)"""
    found = run_worlds(device, (0, 1, 2), kind, moved)
    assert len({str(seen[0]) for seen in found[1]}) > (1 if kind == "tolerance" else 3), "LODs change"
    assert found[0] != found[1] and any(seen[2] for seen in found[2])
    for world in range(3):
        assert run_worlds(device, (world,), kind, moved)[world] == found[world]


@pytest.mark.parametrize("controller", [None, "tolerance"])
def test_rows_are_of_the_objects_that_are_there(device, controller):
    rows = []
    for removed in ([], [1, 3]):
        places = [(sample("ball"), (1.2 * i, 0, 0, 0, 0, 0, 1)) for i in range(3)]
        for i in removed:
            places.insert(i, (sample("box"),))
        scene = scene_with(device, *places)
        scene.remove(removed)
        frame = ab.Frame(scene, lods=controller and ab.ToleranceController(scene, 0.1), output="count")
        frame.run(2)
        rows.append([{**row.as_dict(), **dict.fromkeys([*STAGES, "total_ms"])} for row in frame.history])
    assert rows[0] == rows[1] and rows[0][-1]["objects"] == 3
    assert (rows[0][-1]["error_mean"] > 0) == bool(controller)
    scene.remove(np.flatnonzero(scene.present))
    ab.Frame(scene).run(1)


SCENE_EDITS = {
    "add": lambda scene: scene.add(sample("box")),
    "change": lambda scene: scene.change(2, importance=3),
    "remove": lambda scene: scene.remove(1),
    "another model": lambda scene: (scene.remove(1), scene.add(sample("box"))),
}


@pytest.mark.parametrize("edit", SCENE_EDITS)
def test_a_controller_is_of_the_scene_that_it_was_made_for(device, edit):
    """Whatever its objects and models are now: it says so, and another one goes on in its place."""
    scene = scene_with(device, *[(sample("ball"), (1.2 * i, 0, 0, 0, 0, 0, 1)) for i in range(3)])
    frame = ab.Frame(scene, lods=ab.ToleranceController(scene, 0.1), output="count")
    frame.step()
    SCENE_EDITS[edit](scene)
    for _ in range(2):
        refused(RuntimeError, "since this selection was made; make a new one", frame.step)
    frame.lods = ab.ToleranceController(scene, 0.1)
    assert np.array_equal(frame.step().pairs, scene.broad_phase())


def test_a_scene_or_motion_of_others(device):
    """Frames go on where objects were added; a motion of other objects is refused."""
    places = [(sample("ball"), (1.2 * i, 0, 0, 0, 0, 0, 1)) for i in range(3)]
    scene, others = scene_with(device, *places), scene_with(device, *[sample("ball")] * 4)
    frame = ab.Frame(scene)
    frame.step()
    scene.add(sample("ball"), (9, 0, 0, 0, 0, 0, 1))
    assert len(frame.step().pairs) == len(scene.broad_phase()) and frame.history[-1].objects == 4
    for motion, told in (([0] * 3, "of 3 objects, the scene has 4"), (ab.Dynamics(others).motion(), "another scene")):
        frame.motion = motion
        refused(ValueError, told, frame.step)
    frame.motion = None
    assert frame.step().any.tolist() == scene.intersect().any.tolist()
