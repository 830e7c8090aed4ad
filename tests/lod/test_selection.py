"""Selection of LODs on the device against plain Python written from section 4.2 of the paper and from figure 4."""

import math
from itertools import pairwise

import numpy as np
import pytest
import warp as wp
from helpers import refused
from helpers.bodies import selection_models, strewn
from helpers.samples import random_poses
from helpers.scenes import scene_with
from oracles.motion import posed

from warp_abtree.lod.controllers import Feedback, PaperController, PredictiveController, ToleranceController
from warp_abtree.lod.view import Camera, View
from warp_abtree.state.ladder import Ladder

# Figure 4 by hand: g in frames 1 to 10, Case 1 until frame 5 and Case 2 from frame 6. Rows are Q1, Q2, Q3.
FIGURE_4 = [
    [1, 2, 4, 8, 16, 8, 4, 2, 1, 0],
    [0, 1, 2, 4, 8, 8, 4, 2, 1, 0],
    [0, 0, 1, 2, 4, 8, 4, 2, 1, 0],
]


# The paper's formulas, from its text and errata alone.


def case_of(cost, budget, threshold):
    difference = cost - budget
    if difference <= -threshold:
        return 1
    return 2 if difference > 0 else 3


def g_printed(cases, i, importance):
    """g of section 4.2 for frame i (from 1), cases a list of all frames so far.

    j is the closest previous frame after which the case became what it is. In Case 2 both i and j are counted from the
    start of the preceding run of Case 1 (erratum).
    """

    def case(frame):
        return cases[frame - 1] if frame >= 1 else None

    j = i - 1
    while case(j) == case(i):
        j -= 1
    if case(i) == 1:
        return 2 ** (i - j - importance) if i - j >= importance else 0
    if case(i) == 3:
        return 0
    end = j
    while end >= 1 and case(end) != 1:
        end -= 1
    start = end
    while case(start) == 1:
        start -= 1
    i, j = i - j + end - start, end - start
    return 2 ** (2 * j - i - 1) if 2 * j >= i + 1 else 0


def stages(cost):
    return {"select_ms": 0.25, "refine_ms": 0.125, "move_ms": 0.125, "query_ms": cost - 1.0, "answer_ms": 0.5}


def run_paper(scene, costs, start=0.0, focus=None, **options):
    """Return the levels after each cost, (frames + 1, n), and the LODs."""
    controller = PaperController(scene, 10.0, **options)
    if focus is not None:
        controller.view.focus.assign(focus)
    controller.level.fill_(start)
    levels, lods = [controller.level.numpy().copy()], []
    for cost in costs:
        lods.append(controller.next_lods(Feedback(0.0, stages(cost))).numpy().copy())
        levels.append(controller.level.numpy().copy())
    return np.array(levels), np.array(lods)


def test_figure_4(device):
    scene = scene_with(device, *[(selection_models()[0], {"importance": importance}) for importance in (1, 2, 3)])
    # Room on both sides, so that no end of the ladder hides a step.
    levels, _ = run_paper(scene, [5.0] * 5 + [15.0] * 5, steps=400, start=200.0)
    moved = np.diff(levels, axis=0).T
    assert moved[:, :5].tolist() == [curve[:5] for curve in FIGURE_4]
    assert (-moved[:, 5:9]).tolist() == [curve[5:9] for curve in FIGURE_4]
    # Erratum: the figure ends with 0, and a scene over its budget would stay so; the smallest step goes on.
    assert moved[:, 9].tolist() == [-1, -1, -1]


@pytest.mark.parametrize("threshold", [None, 4.0])
def test_selection_follows_the_paper(device, threshold):
    """Random times: every case follows every other, at every distance and speed."""
    rng = np.random.default_rng(5)
    scene = strewn(18, device)
    focus = rng.uniform(0, 1, 18)
    focus[:2] = 0.0, 1.0
    # Times come in runs, or a climb would never be long.
    costs = np.repeat(rng.choice([2.0, 7.0, 9.0, 9.5, 10.0, 10.5, 30.0], 60), rng.integers(1, 7, 60))
    levels, lods = run_paper(scene, costs, threshold_ms=threshold, focus=focus)
    cases = [case_of(cost, 10.0, threshold or 1.0) for cost in costs]
    assert {(a, b) for a, b in pairwise(cases)} == {(a, b) for a in (1, 2, 3) for b in (1, 2, 3)}
    level = np.zeros(18)
    for i, case in enumerate(cases, 1):
        for k in range(18):
            g = g_printed(cases, i, scene.object_importance[k])
            step = focus[k] * g if case == 1 else -max(g, 1) if case == 2 else 0.0
            level[k] = min(max(level[k] + step, 0.0), 50.0)
            lod_max = scene.models[scene.object_model[k]].lod_max
            assert abs(lods[i - 1, k] - level[k] * lod_max / 50) <= 0.5 * lod_max / 50 + 0.5
        assert np.array_equal(levels[i], level), i
    assert levels.max() == 50 and (levels[1:] == 0).any()


def test_ratio_ladder_has_equal_ratios():
    models = selection_models()
    ladder = Ladder(models, 20, "ratio")
    for model, lods, faces in zip(models, ladder.lod, ladder.faces):
        assert (lods[0], lods[-1]) == (0, model.lod_max) and (np.diff(lods) >= 0).all()
        wanted = faces[0] * (faces[-1] / faces[0]) ** (np.arange(21) / 20)
        assert (faces >= wanted * (1 - 1e-9)).all()
        for level in range(1, 20):  # a coarser LOD would not do
            assert lods[level] == 0 or len(model.mesh_at(int(lods[level]) - 1)[2]) < wanted[level]


def test_tolerance_gives_the_coarsest_level_within_it(device):
    rng = np.random.default_rng(3)
    scene = strewn(60, device)
    controller = ToleranceController(scene, 0.0, loosest=8.0, steps=30)
    ladder, seen = Ladder(selection_models(), 30, "ratio"), set()
    assert controller.budget_ms is None
    for tolerance in (0.0, 1e-4, 2e-3, 0.01, 0.05, 1.0, 100.0):
        focus = np.round(rng.uniform(0, 1, 60), 3)
        focus[:3] = 0.0, 1.0, 0.5
        controller.view.focus.assign(focus)
        controller.tolerance.fill_(tolerance)
        lods = controller.next_lods(Feedback(0.0)).numpy()
        for i in range(60):
            beta, model = scene.object_importance[i], scene.models[scene.object_model[i]]
            allowed = tolerance * (8.0 if focus[i] == 0 else min(beta / focus[i], 8.0))
            fits = [lod for lod in ladder.lod[scene.object_model[i]].tolist() if model.error_at(lod) <= allowed]
            assert lods[i] == min(fits)
            seen.add(int(lods[i]))
    assert len(seen) > 15


def test_controllers_refuse(device):
    """What cannot be, and another scene than they were made for."""
    scene = strewn(3, device)
    for kind, value, options, error, words in (
        (PaperController, 8.0, {"camera": (0, 0, 1)}, TypeError, "camera is a tuple"),
        (PaperController, 8.0, {"window": 0}, ValueError, "window 0 is outside"),
        (PaperController, 8.0, {"steps": 0}, ValueError, "steps 0 is outside"),
        (PaperController, 8.0, {"steps": 2.5}, ValueError, "steps 2.5 is not a whole number"),
        (ToleranceController, -1e-9, {}, ValueError, "tolerance -1e-09 is below 0"),
        (ToleranceController, 1.0, {"loosest": 0.5}, ValueError, "loosest 0.5 is below 1"),
        (ToleranceController, 1.0, {"spacing": "equal"}, ValueError, "spacing 'equal' is none of"),
        (PredictiveController, 8.0, {"low": 0.95}, ValueError, "low 0.95 and aim 0.9 do not rise"),
        (PredictiveController, 8.0, {"hold_frames": -1}, ValueError, "hold_frames -1 is outside"),
    ):
        refused(error, words, kind, scene, value, **options)
    controller = PaperController(scene, 8.0)
    scene.add(selection_models()[0])
    for call in (controller.view.launch, lambda: controller.next_lods(Feedback(0.0))):
        refused(RuntimeError, "objects were added", call)


@pytest.mark.parametrize("kind", [PaperController, ToleranceController, PredictiveController])
def test_selection_runs_in_a_captured_graph(device, kind):
    """One graph, launched while cameras and costs change, gives what `next_lods` gives."""

    def camera_at(time):
        return Camera.look_at((0, time, 8), (0, 0, 0), far=30.0)

    scene = strewn(30, device)
    value = 0.01 if kind is ToleranceController else 10.0
    plain, captured = kind(scene, value, camera_at), kind(scene, value)
    kind(scene, value, camera_at).next_lods(Feedback(0.0))  # loads the kernels
    with wp.ScopedCapture(device=device) as capture:
        captured.view.launch()
        captured.launch()
    wp.synchronize_device(device)
    seen = []
    for frame, cost in enumerate([3.0, 3.0, 3.0, 20.0, 20.0, 3.0]):
        captured.view.look(camera_at(frame))
        if kind is PaperController:
            captured.cost.fill_(cost)
        if kind is PredictiveController:
            for controller in (plain, captured):
                controller.rate.assign([1.0, [1e-4, 1.0][frame == 4], 0.0, 1.0, 0.5])
                controller.tests.fill_(10)
        lods = plain.next_lods(Feedback(frame, stages(cost))).numpy().copy()
        wp.capture_launch(capture.graph)
        assert np.array_equal(captured.lods.numpy(), lods), frame
        assert np.array_equal(captured.view.motion.numpy(), plain.view.motion.numpy())
        seen.append(tuple(lods))
    assert len(set(seen)) > 2


def f_printed(alpha, gamma, far, wide):
    return min(max(min((far - alpha) / far, (wide - gamma) / wide), 0.0), 1.0)


def see(camera, point):
    """Return the distance of a point, and its place on the screen or None behind the camera."""
    x, y, z = camera.view @ np.subtract(point, camera.eye)
    scale = camera.size[1] / 2 / math.tan(camera.field_of_view / 2)
    place = None if z >= 0 else np.array([scale * x / -z, scale * y / -z])
    return math.dist(point, camera.eye), place


def test_cameras_look_where_they_are_told_and_keep_up_upwards():
    camera = Camera.look_at((0, 0, 5), (0, 0, 0), size=(200, 100), field_of_view=math.pi / 2)
    assert np.array_equal(camera.view, np.eye(3))
    assert np.allclose(see(camera, (1, 2, 0))[1], [10, 20])
    tilted = Camera.look_at((3, 1, -2), (0, 2, 7), up=(0.1, 1, 0))
    assert np.allclose(tilted.view @ (np.array([0, 2, 7]) - [3, 1, -2]), [0, 0, -math.sqrt(91)])
    assert (tilted.view @ [0.1, 1, 0])[1] > 0
    for eye, up, row in (
        ((5, 0, 0), None, (0, 0, 1)),
        ((5, 0, 5), None, (-(0.5**0.5), 0, 0.5**0.5)),
        ((0, 0, -5), None, (0, 1, 0)),  # along z
        ((5, 0, 0), "-y", (0, -1, 0)),
        ((0, 0, 5), (9, 0, 0), (1, 0, 0)),
    ):
        assert np.allclose(Camera.look_at(eye, (0, 0, 0), up).view[1], row), eye


def test_cameras_refuse():
    for wrong, what in (
        ({"eye": (0, 0)}, "eye"),
        ({"eye": (0, 0, math.nan)}, "eye"),
        ({"view": 2 * np.eye(3)}, "view"),
        ({"view": np.diag([1.0, 1.0, -1.0])}, "view"),
        ({"field_of_view": 0.0}, "field_of_view"),
        ({"field_of_view": math.pi}, "field_of_view"),
        ({"size": (0, 10)}, "size"),
        ({"far": -1.0}, "far"),
        ({"far": math.inf}, "far"),
    ):
        refused(ValueError, what, Camera, **{"eye": (0, 0, 1), "view": np.eye(3), **wrong})
    for target, up, what in (
        ((0, 0, 1), None, "looks"),
        ((0, 3, 1), "-y", "looks"),
        ((0, 3, 1), "w", "up: 'w' is none of"),
        ((0, 3, 1), (0, 0, 0), "up: a direction of no length"),
    ):
        refused(ValueError, what, Camera.look_at, (0, 0, 1), target, up)


def test_view_measures_distance_motion_and_focus(device):
    """Moving objects, a moving camera, objects beyond D, behind the eye, and passing it."""
    rng = np.random.default_rng(2)
    scene = strewn(40, device)
    view = View(scene, window=3)
    ways, last, before = [], [None] * 40, 0
    for _ in range(8):
        camera = Camera.look_at(rng.uniform(-1, 1, 3), rng.uniform(-5, 5, 3), size=(320, 240), far=3.5)
        poses = random_poses(rng, 40, 4.0)
        scene.set_poses(poses)
        view.look(camera)
        view.launch()
        alpha, way = np.empty(40), np.zeros(40)
        for i in range(40):
            centre = scene.models[scene.object_model[i]].centre
            alpha[i], place = see(camera, posed(centre, poses[i]))
            if place is not None and last[i] is not None:
                way[i] = math.dist(place, last[i])
            last[i] = place
        ways.append(way)
        gamma = np.sum(ways[-3:], axis=0)
        focus = [f_printed(a, g, 3.5, 400.0) for a, g in zip(alpha, gamma)]
        assert np.allclose(view.distance.numpy(), alpha, rtol=1e-12)
        assert np.allclose(view.motion.numpy(), gamma, rtol=1e-9)
        assert np.allclose(view.focus.numpy(), focus, atol=1e-9)
        before += sum(place is None for place in last)
    assert 0 < before < 8 * 40 and (alpha > 3.5).any() and 0 < np.mean(np.array(focus) > 0) < 1
