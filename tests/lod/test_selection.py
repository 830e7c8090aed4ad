"""Selection of LODs on the device against plain Python written from section 4.2 of the paper and from figure 4."""

from itertools import pairwise

import numpy as np
import pytest
import warp as wp
from helpers import refused
from helpers.bodies import selection_models, strewn
from helpers.scenes import scene_with

from warp_abtree.lod.controllers import Feedback, PaperController, PredictiveController, ToleranceController
from warp_abtree.lod.view import Camera
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
    """Return stages that cost so much together."""
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


# Ladders.


def test_ratio_ladder_has_equal_ratios():
    models = selection_models()
    ladder = Ladder(models, 20, "ratio")
    for model, lods, faces in zip(models, ladder.lod, ladder.faces):
        assert (lods[0], lods[-1]) == (0, model.lod_max) and (np.diff(lods) >= 0).all()
        wanted = faces[0] * (faces[-1] / faces[0]) ** (np.arange(21) / 20)
        assert (faces >= wanted * (1 - 1e-9)).all()
        for level in range(1, 20):  # a coarser LOD would not do
            assert lods[level] == 0 or len(model.mesh_at(int(lods[level]) - 1)[2]) < wanted[level]


# Tolerances.


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


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda scene: PaperController(scene, 8.0, camera=(0, 0, 1)), TypeError, "camera is a tuple"),
        (lambda scene: PaperController(scene, 8.0, window=0), ValueError, "window 0 is outside"),
        (lambda scene: PaperController(scene, 8.0, steps=0), ValueError, "steps 0 is outside"),
        (lambda scene: PaperController(scene, 8.0, steps=2.5), ValueError, "steps 2.5 is not a whole number"),
        (lambda scene: ToleranceController(scene, -1e-9), ValueError, "tolerance -1e-09 is below 0"),
        (lambda scene: ToleranceController(scene, 1.0, loosest=0.5), ValueError, "loosest 0.5 is below 1"),
        (lambda scene: ToleranceController(scene, 1.0, spacing="equal"), ValueError, "spacing 'equal' is none of"),
        (lambda scene: PredictiveController(scene, 8.0, low=0.95), ValueError, "low 0.95 and aim 0.9 do not rise"),
        (lambda scene: PredictiveController(scene, 8.0, hold_frames=-1), ValueError, "hold_frames -1 is outside"),
    ],
)
def test_controllers_refuse(make, error, words):
    refused(error, words, make, strewn(3, "cpu"))


def test_a_controller_refuses_another_scene_than_it_was_made_for(device):
    scene = strewn(3, device)
    controller = PaperController(scene, 8.0)
    scene.add(selection_models()[0])
    for call in (controller.view.launch, lambda: controller.next_lods(Feedback(0.0))):
        refused(RuntimeError, "objects were added", call)


# Graphs.


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
