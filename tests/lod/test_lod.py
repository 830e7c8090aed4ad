"""Selection of LODs on the device against plain Python written from section 4.2 of the paper and from figure 4."""

import math
from itertools import pairwise

import numpy as np
import pytest
import trimesh
import warp as wp

import warp_abtree as ab
from warp_abtree.lod.selection import PaperSelection, PredictedSelection, ToleranceSelection, tolerance_scale
from warp_abtree.lod.view import Camera, View
from warp_abtree.state.ladder import Ladder

# Figure 4 by hand: g in frames 1 to 10, Case 1 until frame 5 and Case 2 from frame 6. Rows are Q1, Q2, Q3.
FIGURE_4 = [
    [1, 2, 4, 8, 16, 8, 4, 2, 1, 0],
    [0, 1, 2, 4, 8, 8, 4, 2, 1, 0],
    [0, 0, 1, 2, 4, 8, 4, 2, 1, 0],
]


@pytest.fixture(scope="module")
def models():
    ring = trimesh.creation.torus(major_radius=0.5, minor_radius=0.2, major_sections=24, minor_sections=12)
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.4)
    ball.apply_translation([0.3, -0.2, 0.1])
    return ab.Model.load(ring), ab.Model.load(ball), ab.Model.load(trimesh.creation.box(), base_faces=6)


def make_scene(models, count, device, seed=0):
    """Objects of all models and all kinds of importance, strewn about."""
    rng = np.random.default_rng(seed)
    scene = ab.Scene(device=device)
    for i in range(count):
        turn = rng.normal(size=4)
        pose = np.concatenate([rng.uniform(-4, 4, 3), turn / np.linalg.norm(turn)])
        scene.add(models[i % len(models)], pose, importance=1 + i // len(models) % 3)
    return scene


# The paper's formulas, from its text and errata alone.


def case_of(cost, budget, threshold):
    difference = cost - budget
    if difference <= -threshold:
        return 1
    return 2 if difference > 0 else 3


def g_printed(cases, i, importance, mirror=True):
    """g of section 4.2 for frame i (from 1), cases a list of all frames so far.

    j is the closest previous frame after which the case became what it is. In Case 2 both i and j are counted from the
    start of the preceding run of Case 1 (erratum); without `mirror` they are absolute, as printed.
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
    if mirror:
        end = j
        while end >= 1 and case(end) != 1:
            end -= 1
        start = end
        while case(start) == 1:
            start -= 1
        i, j = i - j + end - start, end - start
    return 2 ** (2 * j - i - 1) if 2 * j >= i + 1 else 0


def f_printed(alpha, gamma, far, wide):
    return min(max(min((far - alpha) / far, (wide - gamma) / wide), 0.0), 1.0)


@pytest.mark.parametrize("mirror", [True, False])
def test_oracle_is_figure_4(mirror):
    cases = [1] * 5 + [2] * 5
    for importance, curve in enumerate(FIGURE_4, 1):
        # The figure's climb starts at frame 1, where absolute numbers and those of the mirror are the same.
        assert [g_printed(cases, i, importance, mirror) for i in range(1, 11)] == curve


def test_printed_g2_explodes_and_the_mirror_does_not():
    cases = [3] * 20 + [1] * 5 + [2] * 4
    assert [g_printed(cases, i, 1) for i in range(26, 30)] == [8, 4, 2, 1]
    assert g_printed(cases, 26, 1, mirror=False) == 2**23


def run_paper(scene, costs, budget=10.0, threshold=None, steps=50, start=0.0, focus=None):
    """Return the levels after each cost, (frames + 1, n), and the LODs."""
    view = View(scene)
    if focus is not None:
        view.focus.assign(focus)
    selection = PaperSelection(view, budget, threshold, Ladder(scene.models, steps))
    selection.level.fill_(start)
    levels, lods = [selection.level.numpy().copy()], []
    for cost in costs:
        selection.cost.fill_(cost)
        selection.launch()
        levels.append(selection.level.numpy().copy())
        lods.append(selection.lods.numpy().copy())
    return np.array(levels), np.array(lods)


def test_figure_4(models, device):
    scene = ab.Scene(device=device)
    for importance in (1, 2, 3):
        scene.add(models[0], importance=importance)
    # Room on both sides, so that no end of the ladder hides a step.
    levels, _ = run_paper(scene, [5.0] * 5 + [15.0] * 5, steps=400, start=200.0)
    moved = np.diff(levels, axis=0).T
    assert moved[:, :5].tolist() == [curve[:5] for curve in FIGURE_4]
    assert (-moved[:, 5:9]).tolist() == [curve[5:9] for curve in FIGURE_4]
    # Erratum: the figure ends with 0, and a scene over its budget would stay so; the smallest step goes on.
    assert moved[:, 9].tolist() == [-1, -1, -1]


@pytest.mark.parametrize("threshold", [None, 4.0])
def test_selection_follows_the_paper(models, device, threshold):
    """Random times: every case follows every other, at every distance and speed."""
    rng = np.random.default_rng(5)
    scene = make_scene(models, 18, device)
    focus = rng.uniform(0, 1, 18)
    focus[:2] = 0.0, 1.0
    # Times come in runs, or a climb would never be long.
    costs = np.repeat(rng.choice([2.0, 7.0, 9.0, 9.5, 10.0, 10.5, 30.0], 60), rng.integers(1, 7, 60))
    levels, lods = run_paper(scene, costs, threshold=threshold, focus=focus)
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


def test_everything_starts_and_stays_at_the_coarsest_without_a_frame(models, device):
    scene = make_scene(models, 6, device)
    levels, lods = run_paper(scene, [math.nan, math.nan])
    assert not levels.any() and not lods.any()


# Cameras.


def see(camera, point):
    """Project by a 4x4 view matrix; return the distance, and the place on the screen or None behind the camera."""
    matrix = np.eye(4)
    matrix[:3, :3] = camera.view
    matrix[:3, 3] = -camera.view @ camera.eye
    x, y, z, _ = matrix @ [*point, 1.0]
    scale = camera.size[1] / 2 / math.tan(camera.field_of_view / 2)
    place = None if z >= 0 else np.array([scale * x / -z, scale * y / -z])
    return math.dist(point, camera.eye), place


def test_camera_looks_where_it_is_told():
    camera = Camera.look_at((0, 0, 5), (0, 0, 0), size=(200, 100), field_of_view=math.pi / 2)
    assert np.array_equal(camera.view, np.eye(3))
    assert np.allclose(see(camera, (1, 2, 0))[1], [10, 20])
    tilted = Camera.look_at((3, 1, -2), (0, 2, 7), up=(0.1, 1, 0))
    assert np.allclose(tilted.view @ (np.array([0, 2, 7]) - [3, 1, -2]), [0, 0, -math.sqrt(91)])
    assert (tilted.view @ [0.1, 1, 0])[1] > 0


@pytest.mark.parametrize(
    ("wrong", "what"),
    [
        ({"eye": (0, 0)}, "eye"),
        ({"eye": (0, 0, math.nan)}, "eye"),
        ({"view": 2 * np.eye(3)}, "view"),
        ({"view": np.diag([1.0, 1.0, -1.0])}, "view"),
        ({"field_of_view": 0.0}, "field_of_view"),
        ({"field_of_view": math.pi}, "field_of_view"),
        ({"size": (0, 10)}, "size"),
        ({"far": -1.0}, "far"),
        ({"far": math.inf}, "far"),
    ],
)
def test_camera_refuses(wrong, what):
    with pytest.raises(ValueError, match=what):
        Camera(**{"eye": (0, 0, 1), "view": np.eye(3), **wrong})


@pytest.mark.parametrize("along", [(0, 0, 0), (0, 3, 0)])
def test_camera_refuses_to_look_nowhere(along):
    with pytest.raises(ValueError, match="looks"):
        Camera.look_at((0, 0, 0), along)


def test_view_measures_distance_motion_and_focus(models, device):
    """Moving objects, a moving camera, objects beyond D, behind the eye, and passing it."""
    rng = np.random.default_rng(2)
    scene = make_scene(models, 40, device)
    view = View(scene, window=3)
    ways, last, before = [], [None] * 40, 0
    for _ in range(8):
        camera = Camera.look_at(rng.uniform(-1, 1, 3), rng.uniform(-5, 5, 3), size=(320, 240), far=3.5)
        poses = np.concatenate([rng.uniform(-4, 4, (40, 3)), rng.normal(size=(40, 4))], axis=1)
        poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
        scene.set_poses(poses)
        view.look(camera)
        view.launch()
        rotation = trimesh.transformations
        alpha, way = np.empty(40), np.zeros(40)
        for i in range(40):
            x, y, z, w = poses[i, 3:]
            turn = rotation.quaternion_matrix([w, x, y, z])[:3, :3]
            centre = scene.models[scene.object_model[i]].centre
            alpha[i], place = see(camera, turn @ centre + poses[i, :3])
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


def test_a_selection_refuses_another_scene_than_it_was_made_for(models, device):
    scene = make_scene(models, 3, device)
    view = View(scene)
    scene.add(models[0])
    with pytest.raises(RuntimeError, match="objects were added"):
        view.launch()


# Ladders.


def test_paper_ladder_has_equal_operations(models):
    ladder = Ladder(models, 50)
    for model, lods, errors, faces in zip(models, ladder.lod, ladder.error, ladder.faces):
        assert len(lods) == 51 and (lods[0], lods[-1]) == (0, model.lod_max)
        assert np.abs(lods - np.arange(51) * model.lod_max / 50).max() <= 0.5
        assert errors.tolist() == [model.error_at(int(lod)) for lod in lods]
        assert faces.tolist() == [len(model.mesh_at(int(lod))[2]) for lod in lods]


def test_ratio_ladder_has_equal_ratios(models):
    ladder = Ladder(models, 20, "ratio")
    for model, lods, faces in zip(models, ladder.lod, ladder.faces):
        assert (lods[0], lods[-1]) == (0, model.lod_max) and (np.diff(lods) >= 0).all()
        wanted = faces[0] * (faces[-1] / faces[0]) ** (np.arange(21) / 20)
        assert (faces >= wanted * (1 - 1e-9)).all()
        for level in range(1, 20):  # a coarser LOD would not do
            assert lods[level] == 0 or len(model.mesh_at(int(lods[level]) - 1)[2]) < wanted[level]


@pytest.mark.parametrize("wrong", [{"steps": 0}, {"steps": 2.5}, {"spacing": "equal"}])
def test_ladder_refuses(models, wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Ladder(models, **wrong)


# Tolerances.


def test_tolerance_gives_the_coarsest_rung_within_it(models, device):
    rng = np.random.default_rng(3)
    scene = make_scene(models, 60, device)
    view = View(scene)
    ladder = Ladder(models, 30, "ratio")
    selection = ToleranceSelection(view, 0.0, loosest=8.0, ladder=ladder)
    seen = set()
    for tolerance in (0.0, 1e-4, 2e-3, 0.01, 0.05, 1.0, 100.0):
        focus = np.round(rng.uniform(0, 1, 60), 3)
        focus[:3] = 0.0, 1.0, 0.5
        view.focus.assign(focus)
        selection.tolerance.fill_(tolerance)
        selection.launch()
        lods = selection.lods.numpy()
        for i in range(60):
            beta, model = scene.object_importance[i], scene.models[scene.object_model[i]]
            allowed = tolerance * (8.0 if focus[i] == 0 else min(beta / focus[i], 8.0))
            assert model.error_at(int(lods[i])) <= allowed
            fits = [lod for lod in ladder.lod[scene.object_model[i]].tolist() if model.error_at(lod) <= allowed]
            assert lods[i] == min(fits)
            seen.add(int(lods[i]))
    assert len(seen) > 15


@pytest.mark.parametrize(
    "make",
    [
        lambda view: PaperSelection(view, 0.0),
        lambda view: PaperSelection(view, math.nan),
        lambda view: PaperSelection(view, 8.0, threshold=-1.0),
        lambda view: ToleranceSelection(view, -1e-9),
        lambda view: ToleranceSelection(view, math.nan),
        lambda view: ToleranceSelection(view, 1.0, loosest=0.5),
        lambda view: PredictedSelection(view, -8.0),
        lambda view: PredictedSelection(view, 8.0, low=0.95, aim=0.9),
        lambda view: PredictedSelection(view, 8.0, hold_frames=-1),
        lambda view: View(view.scene, window=0),
    ],
)
def test_selections_refuse(models, make):
    view = View(make_scene(models, 3, "cpu"))
    with pytest.raises(ValueError):
        make(view)


# Prediction.


def plain_level(selection, i, position, offset):
    scene = selection.view.scene
    part = (i * 2654435761 % 2**32) >> 30
    levels = tolerance_scale(selection.ladder)
    level = min(max((position - offset + part), 0) // 4, len(levels) - 1)
    if level == 0:
        return 0
    errors = selection.ladder.error[scene.object_model[i]]
    return int(np.argmax(errors <= levels[level]))


def plain_nodes(model, ladder, k, held, wanted):
    """Nodes of equation 1 for every level wanted that nobody stands at, from the nearest that somebody does."""
    total, n = 0.0, model.face_count
    starts = [int(model.progressive.split_start[lod]) for lod in ladder.lod[k]]
    for level in wanted - held:
        entries = min(abs(starts[level] - starts[other]) for other in held)
        if entries > n / 2:
            total += 2 * n - 1
        else:
            faces = max(entries / 2, 1)
            total += min(faces * (math.log2(n) - math.log2(faces) + 2), 2 * n - 1)
    return math.floor(total)


@pytest.mark.usefixtures("half_refitted_in_part")
def test_prediction_is_that_of_plain_python(models, device):
    rng = np.random.default_rng(4)
    scene = make_scene(models, 50, device)
    view = View(scene)
    selection = PredictedSelection(view, 10.0, ladder=Ladder(models, 25, "ratio"), loosest=16.0, hold_frames=2)
    level, ways = np.zeros(50, int), set()
    for frame in range(24):
        if frame % 8 == 0:
            focus = rng.uniform(0, 1, 50)
            view.focus.assign(focus)
        work = rng.uniform(0, 100, 50) * (rng.uniform(size=50) < 0.7)
        up, down = rng.uniform(0.2, 1.2, 2)
        # Dear and cheap frames by turns, so that the position climbs, falls, stays and holds.
        rate = [1.0, {10: 9e-3, 5: 4e-3, 2: 4e-3}.get(frame % 12, 1e-3), 1.0, [1e-3, 0.1][frame // 6 % 2], up, down]
        position = int(selection.scale.numpy()[0])
        waited = int(selection.scale.numpy()[1])
        selection.rate.assign(rate)
        selection.work.assign(work)
        selection.launch()
        offset = selection.offset.numpy()
        loose = np.minimum(np.array(scene.object_importance) / np.maximum(focus, 1e-9), 16.0)
        assert (offset <= np.floor(16 * np.log2(loose) + 1e-9)).all() and (offset >= 16 * np.log2(loose) - 6).all()
        steps = selection.changes
        assert steps[:-2] == sorted(steps[:-2], reverse=True) and steps[-2] == -selection.position_max
        lasting, moving, totals = [], [], []
        for k, step in enumerate(steps):
            held = k == len(steps) - 1
            then = [level[i] if held else plain_level(selection, i, position + step, offset[i]) for i in range(50)]
            faces = selection.ladder.faces[scene.object_model]
            ratio = faces[np.arange(50), then] / faces[np.arange(50), level]
            total = float(np.sum(work * ratio ** np.where(ratio > 1, up, down)))
            nodes = 0
            for m, model in enumerate(scene.models):
                mine = np.array(scene.object_model) == m
                present, wanted = set(level[mine].tolist()), set(np.array(then)[mine].tolist())
                nodes += plain_nodes(model, selection.ladder, m, present, wanted)
            assert selection.prediction.work.numpy()[k] == pytest.approx(total, rel=1e-12)
            assert selection.prediction.moved.numpy()[k] == np.count_nonzero(np.array(then) != level)
            assert selection.prediction.nodes.numpy()[k] == pytest.approx(nodes, abs=1)
            totals.append(total)
            lasting.append(rate[0] + rate[1] * total)
            moving.append(rate[2] * (list(then) != list(level)) + rate[3] * nodes)
        way, chosen, waited = plain_choice(lasting, moving, steps.index(0), position, selection, waited)
        ways.add(way)
        assert int(selection.choice.numpy()[0]) == chosen, frame
        assert selection.choice.numpy()[3:].tolist() == pytest.approx([totals[chosen], totals[-1]], rel=1e-12)
        position = min(max(position + steps[chosen], 0), selection.position_max)
        assert selection.scale.numpy().tolist() == [position, waited]
        if chosen < len(steps) - 1:
            level = np.array([plain_level(selection, i, position, offset[i]) for i in range(50)])
        assert selection.level.numpy().tolist() == level.tolist()
        assert selection.lods.numpy().tolist() == selection.ladder.lod[scene.object_model, level].tolist()
    assert ways == {"fall", "hold", "follow late", "climb", "wait", "climb late", "stay"}


def plain_choice(lasting, moving, stay, position, selection, waited):
    """The rule as its docstring has it; return its name, the candidate, and how many frames a move has waited."""
    budget, held = selection.budget, len(lasting) - 1
    aim, low = selection.aim * budget, selection.low * budget
    cost = lasting[stay] + moving[stay]
    late = waited >= selection.hold_frames
    if lasting[held] > budget:
        return "fall", min([k for k in range(stay + 1, held) if lasting[k] <= aim], default=held - 1), 0
    if cost > budget:
        return ("follow late", stay, 0) if late else ("hold", held, waited + 1)
    if cost < low and position < selection.position_max:
        fits = [k for k in range(stay) if lasting[k] <= aim and lasting[k] + moving[k] <= budget]
        if fits:
            return "climb", min(fits), 0
        if lasting[stay - 1] <= aim:
            return ("climb late", stay - 1, 0) if late else ("wait", stay, waited + 1)
    return "stay", stay, 0


def test_without_a_frame_the_dial_stands(models, device):
    selection = PredictedSelection(View(make_scene(models, 9, device)), 10.0)
    selection.launch()
    assert selection.scale.numpy().tolist() == [0, 0] and not selection.lods.numpy().any()


# Graphs.


@pytest.mark.parametrize("kind", ["paper", "tolerance", "predicted"])
def test_selection_runs_in_a_captured_graph(models, device, kind):
    """One graph, launched again and again while cameras, poses and costs change, gives what plain launches give."""

    def make(scene):
        view = View(scene)
        if kind == "paper":
            return view, PaperSelection(view, 10.0)
        return view, ToleranceSelection(view, 0.01) if kind == "tolerance" else PredictedSelection(view, 10.0)

    def launch(view, selection):
        view.launch()
        selection.launch()

    scene = make_scene(models, 30, device)
    plain, captured = make(scene), make(scene)
    launch(*make(scene))  # loads the kernels
    with wp.ScopedCapture(device=device) as capture:
        launch(*captured)
    wp.synchronize_device(device)
    seen = []
    for frame in range(6):
        camera = Camera.look_at((0, frame, 8), (0, 0, 0), far=30.0)
        for view, selection in (plain, captured):
            view.look(camera)
            if kind == "paper":
                selection.cost.fill_([3.0, 3.0, 3.0, 20.0, 20.0, 3.0][frame])
            if kind == "predicted":
                selection.rate.assign([1.0, [1e-4, 1.0][frame == 4], 0.0, 0.0, 1.0, 0.5])
                selection.work.fill_(10.0)
        launch(*plain)
        wp.capture_launch(capture.graph)
        lods = plain[1].lods.numpy().copy()
        assert np.array_equal(captured[1].lods.numpy(), lods), frame
        assert np.array_equal(captured[0].motion.numpy(), plain[0].motion.numpy())
        seen.append(tuple(lods))
    assert len(set(seen)) > 2
