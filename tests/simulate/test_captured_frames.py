"""Frames as graphs: the bits of launched ones, whatever changes between them, and nothing lost where room runs out or
an interruption comes."""

from functools import partial

import numpy as np
import pytest
import warp as wp
from conftest import slow_rows
from helpers import refused
from helpers.bodies import bits, heap, ring_and_ball, selection_models
from helpers.faults import Interruption
from helpers.scenes import scene_with

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.lod.controllers import Feedback, PaperController, PredictiveController, ToleranceController
from warp_abtree.lod.timing import STAGES
from warp_abtree.lod.view import Camera

TIMES = {*STAGES, "total_ms"}
NO_TIME = Feedback(0.0, {"query_ms": 0.0})


def camera_at(time):
    return Camera.look_at((0, 3 * np.sin(time), 7 - 3 * time), (0, 0, 0), far=30.0)


def crowd(device, count=14, models=None):
    """Return a scene and a motion: objects that stand apart, and meet half way."""
    scene, rng = ab.Scene(device), np.random.default_rng(2)
    models = ring_and_ball() if models is None else models
    for i in range(count):
        scene.add(models[i % len(models)], importance=1 + i % 3)
    home = 4.0 * np.stack([np.arange(count) % 4, np.arange(count) // 4 % 4, np.arange(count) // 16], 1)
    motion = ab.Kinematic(home, shuttle=rng.uniform(-0.3, 0.3, (count, 3)) - home, period=2.0, axis=(1, 2, 3), rate=1.0)
    return scene, motion


def check_answer(result, scene, motion, time, removed=(), output="faces"):
    """Compare a frame's result with that of a fresh scene at its LODs and the poses of a time."""
    fresh = scene_with(scene.device, *(scene.models[m] for m in scene.object_model))
    fresh.set_lods(scene.lods)
    fresh.set_poses(motion.poses(time))
    fresh.filter(np.reshape(removed, (-1, 2)).astype(int))
    expected = fresh.intersect(output=output)
    for name in ("pairs", "count", "faces"):
        assert np.array_equal(getattr(result, name), getattr(expected, name)), name


def lods_at(scene, time):
    top = np.array([scene.models[model].lod_max for model in scene.object_model])
    return np.maximum(top - (np.arange(len(top)) % 5) * int(20 * time), 0)


CONTROLLERS = {
    "finest": lambda scene: None,
    "function": lambda scene: partial(lods_at, scene),
    "tolerance": lambda scene: ToleranceController(scene, 0.003, camera_at),
    "coarse ladder": lambda scene: ToleranceController(scene, 0.01, camera_at, steps=5),
    "paper": lambda scene: PaperController(scene, 1e9, camera_at),
    "predictive": lambda scene: PredictiveController(scene, 1e9, camera_at, steps=5, loosest=2.0),
}


def make_frame(device, kind, output, captured):
    """Return a frame, and a function of it that returns all that it has moved."""
    if output == "bodies":
        dynamics = heap(device)
        scene, motion = dynamics.scene, dynamics.motion()
    else:
        scene, motion = crowd(device)
    with testing.regime(captures_frames=captured):
        frame = ab.Frame(scene, motion, CONTROLLERS[kind](scene), "faces" if output == "bodies" else output, 1 / 30)
    poses = scene.batch().objects.pool
    return frame, lambda: [poses.rotation.numpy().copy(), poses.position.numpy().copy(), scene.lods]


def describe(frame, state, result):
    row = {name: value for name, value in frame.history[-1].as_dict().items() if name not in TIMES}
    names = ["pairs", "any", "count", "faces", "node_tests", "triangle_tests"]
    if frame.output == "any":  # warps that share a pair leave it at the first hit of any of them
        names, row = names[:2], row | {"node_tests": 0, "triangle_tests": 0}
    found = [None if getattr(result, name) is None else getattr(result, name).tolist() for name in names]
    return row, found, [array.tobytes() for array in state()]


FEW = [(kind, output) for kind in CONTROLLERS for output in ("faces", "bodies")]
FEW += [(kind, output) for kind in ("finest", "predictive") for output in ("any", "contacts")]
MORE = [(kind, output) for kind in CONTROLLERS for output in ("any", "contacts")]


@pytest.mark.parametrize(("kind", "output"), [*FEW, *slow_rows(*(row for row in MORE if row not in FEW))])
def test_captured_frames_are_launched_ones(device, kind, output):
    frames = [make_frame(device, kind, output, captured) for captured in (True, False)]
    seen, lods = [], set()
    for _ in range(30):
        captured, launched = (describe(frame, state, frame.step()) for frame, state in frames)
        assert captured == launched
        seen.append(captured[0]["intersecting"])
        lods.add(captured[2][2])
    if kind == "predictive":
        rests = [(frame.lods.rests(Feedback(0.0)), frame.lods.rests(NO_TIME)) for frame, _ in frames]
        assert all(few < many for few, many in rests)
    changes = kind in ("function", "paper", "predictive") or (kind != "finest" and output != "bodies")
    assert max(seen) > 5 and (len(lods) > 1) == changes


@pytest.mark.parametrize("camera", [None, camera_at])
def test_launches_of_a_frame_under_control(device, monkeypatch, camera):
    """Two choose a position, one arranges objects, three find pairs, four what meets, one sums up; none clears."""
    with testing.regime(captures_frames=True, warps=True):
        scene, motion = crowd(device)
        controller = PredictiveController(scene, 1e9, camera, steps=5)
        frame = ab.Frame(scene, motion, controller, "count", 1 / 30)
        frame.run(1)
        made = []
        for owner, name in ((wp, "launch"), (wp.array, "zero_"), (wp.array, "fill_"), (wp.utils, "radix_sort_pairs")):
            call = getattr(owner, name)
            monkeypatch.setattr(
                owner, name, lambda *args, _call=call, **options: made.append(1) or _call(*args, **options)
            )
        frame.run(1)
        assert len(made) == 11


@pytest.mark.parametrize("kind", ["function", "tolerance", "coarse ladder"])
def test_answers_are_those_of_a_scene_at_the_same_lods(device, kind):
    scene, motion = crowd(device, 24, selection_models())
    with testing.regime(captures_frames=True):
        frame = ab.Frame(scene, motion, CONTROLLERS[kind](scene), "faces", 1 / 30)
    refitted = set()
    for number in range(25):
        result = frame.step()
        check_answer(result, scene, motion, number / 30)
        check_answer(scene.intersect(output="faces"), scene, motion, number / 30)
        assert [scene.tree_state(i).lod for i in range(24)] == scene.lods.tolist()
        row = frame.history[-1]
        assert (row.pairs, row.hits, row.intersecting) == (len(result.pairs), len(result.faces), result.any.sum())
        assert (row.node_tests, row.triangle_tests) == (result.node_tests.sum(), result.triangle_tests.sum())
        of = [(scene.models[m], lod) for m, lod in zip(scene.object_model, scene.lods.tolist())]
        errors = [model.error_at(lod) for model, lod in of]
        assert (row.error_mean, row.error_max) == (pytest.approx(np.mean(errors)), max(errors))
        assert row.states == len(set(of)) and row.faces == sum(len(model.mesh_at(lod)[2]) for model, lod in of)
        assert (row.lod_min, row.lod_max) == (min(scene.lods), max(scene.lods))
        refitted.add(row.nodes_refitted > 0)
    # 24 objects of three models: 51 levels are more than 8 objects, 6 are fewer.
    assert refitted == ({False} if kind == "coarse ladder" else {False, True})


def test_the_tests_of_a_pair_are_told_of_both_objects(device):
    scene, motion = crowd(device)
    controller = PredictiveController(scene, 1e6, camera_at)
    frame = ab.Frame(scene, motion, controller, time_step=1 / 30)
    for _ in range(20):
        result = frame.step()
        tests = result.node_tests + 4 * result.triangle_tests
        expected = sum(np.bincount(result.pairs[:, side], tests, scene.object_count) for side in (0, 1))
        assert controller.tests.numpy().tolist() == expected.tolist()
    assert expected.any()


def test_what_changes_between_frames_is_followed(device):
    """Other LODs, outputs, controllers and filters, each in the middle of a captured run."""
    scene, motion = crowd(device)
    with testing.regime(captures_frames=True):
        frame = ab.Frame(scene, motion, None, "count", 1 / 30)
    frame.run(22)

    def check(lods=None):
        result = frame.step()
        check_answer(result, scene, motion, frame.history[-1].time, removed, frame.output)
        assert lods is None or np.array_equal(scene.lods, lods)
        return result

    removed = ()
    finest = scene.lods
    check(finest)
    scene.set_lods(finest - np.arange(14))
    check(finest - np.arange(14))
    frame.lods = ToleranceController(scene, 0.01, camera_at)
    check(), check()
    scene.set_lods(finest)
    assert (check().pairs != -1).all() and (scene.lods < finest).any(), "the controller selects anew"
    frame.lods = None
    before = scene.lods
    check(before), check(before)
    frame.output = "faces"
    removed = check().pairs[:3]
    scene.filter(removed)
    check(), check()
    frame.lods = PaperController(scene, 1e9)
    check(), check()


def test_bodies_whose_contacts_outrun_a_captured_frame_lose_none(device):
    """They do not move by some of their contacts: their bits are those of steps one after another."""
    plain, dynamics = heap(device), heap(device, capacity=ab.Buffers(1, pairs=1))
    with testing.regime(captures_frames=True):
        frame = ab.Frame(dynamics.scene, dynamics.motion(), time_step=1 / 60)
    rooms = set()
    for _ in range(60):
        plain.step(1 / 60)
        frame.step().check()
        rooms.add((len(dynamics.query.pairs), len(dynamics.query.hits.face)))
        assert np.array_equal(bits(dynamics), bits(plain))
    assert len(rooms) > 1, "room has grown in the middle"


def test_a_camera_that_ends_serves_all_its_frames(device):
    """It is asked for the next frame while one runs."""
    scene, motion = crowd(device)
    cameras = {frame / 8: camera_at(frame / 8) for frame in range(5)}
    with testing.regime(captures_frames=True):
        frame = ab.Frame(scene, motion, ToleranceController(scene, 0.01, cameras.__getitem__), "any", 1 / 8)
    assert len(frame.run(5)) == 5
    refused(KeyError, None, frame.step)
    cameras[5 / 8] = camera_at(5 / 8)
    assert len(frame.run(1)) == 6


@pytest.mark.parametrize("place", ["before", "after"])
def test_a_frame_whose_graph_is_interrupted_is_neither_lost_nor_run_twice(device, monkeypatch, place):
    """Of rigid bodies, which remember, and a controller that climbs with every frame."""

    def make():
        dynamics = heap(device, capacity=ab.Buffers(1, pairs=1))
        with testing.regime(captures_frames=True):
            lods = PaperController(dynamics.scene, 1e9)
            return dynamics, ab.Frame(dynamics.scene, dynamics.motion(), lods, time_step=1 / 60)

    def counted(row):
        return {name: value for name, value in row.as_dict().items() if name not in TIMES}

    plain, whole = make()
    whole.run(50)
    dynamics, frame = make()
    launch, turn = wp.capture_launch, [0]

    def interrupted(graph):
        turn[0] += 1
        if place == "after":
            launch(graph)
        if turn[0] % 3 == 0:
            raise KeyboardInterrupt
        if place == "before":
            launch(graph)

    monkeypatch.setattr(wp, "capture_launch", interrupted)
    hits = 0
    while len(frame.history) < 50:
        try:
            frame.run(50 - len(frame.history))
        except KeyboardInterrupt:
            hits += 1
    assert hits > 12
    monkeypatch.undo()
    assert np.array_equal(bits(dynamics), bits(plain))
    assert [counted(row) for row in frame.history] == [counted(row) for row in whole.history]


@pytest.mark.parametrize("captured", [False, True])
def test_frames_interrupted_anywhere_go_on(device, monkeypatch, captured):
    """Each launch, copy and allocation of a frame fails once: later frames, and the scene, answer as a fresh scene."""
    hits = []

    def make():
        scene, motion = crowd(device, 9, selection_models())
        with testing.regime(captures_frames=captured):
            lods = ToleranceController(scene, 0.003, camera_at)
            frame = ab.Frame(scene, motion, lods, "faces", 1 / 2)
        frame.step()
        return frame

    def check(before, frame):
        if before is None:
            return True
        scene = frame.scene
        scene.intersect(output="faces")
        for _ in range(3):
            found = frame.step()
            check_answer(found, scene, frame.motion, frame.history[-1].time)
            hits.append(len(found.faces))
        assert [row.frame for row in frame.history] == list(range(len(frame.history)))

    steps, _ = Interruption(device, monkeypatch).everywhere(make, lambda frame: frame.run(2) and None, check)
    assert steps > 10 and max(hits) > 100


@pytest.mark.parametrize("captured", [False, True])
def test_another_motion_is_followed(device, captured):
    """Poses found ahead were those of the motion before; rigid bodies take over from where it has left the objects."""
    dynamics, plain = heap(device), heap(device)
    with testing.regime(captures_frames=captured):
        frame = ab.Frame(dynamics.scene, None, None, "faces", 1 / 60)
    start = dynamics.poses()
    for offset in (0.3, 0.1, 0.0):
        frame.motion = ab.Kinematic(start[:, :3] + offset, start[:, 3:])
        frame.run(3)
        assert np.allclose(dynamics.poses()[:, :3], start[:, :3] + offset, atol=1e-12)
    plain.scene.set_poses(dynamics.poses())
    dynamics.scene.set_poses(dynamics.poses())
    frame.motion = dynamics.motion()
    for _ in range(20):
        frame.step()
        plain.step(1 / 60)
    assert np.array_equal(bits(dynamics), bits(plain)) and not np.allclose(dynamics.poses(), start)
