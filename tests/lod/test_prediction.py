"""The selection by a predicted budget against plain Python."""

import math

import numpy as np
import pytest
from helpers.bodies import strewn

from warp_abtree.lod.controllers import PredictiveController
from warp_abtree.lod.selection import tolerance_scale


def plain_level(selection, i, position, offset):
    part, levels = (i * 2654435761 % 2**32) >> 30, tolerance_scale(selection.ladder)
    level = min(max((position - offset + part), 0) // 4, len(levels) - 1)
    errors = selection.ladder.error[selection.view.scene.object_model[i]]
    return int(np.argmax(errors <= levels[level])) if level else 0


def plain_nodes(model, ladder, k, now, then):
    """Nodes of equation 1 for an object that goes from one level to another."""
    n = model.face_count
    entries = abs(int(np.subtract(*model.progressive.split_start[ladder.lod[k, [now, then]]])))
    if entries == 0:
        return 0
    if entries > n / 2:
        return 2 * n - 1
    faces = max(entries / 2, 1)
    return math.floor(min(faces * (math.log2(n) - math.log2(faces) + 2), 2 * n - 1))


@pytest.mark.usefixtures("half_refitted_in_part")
def test_prediction_is_that_of_plain_python(device):
    rng = np.random.default_rng(4)
    scene = strewn(50, device)
    selection = PredictiveController(scene, 10.0, steps=25, loosest=16.0, hold_frames=2)
    level, ways, model_of = np.zeros(50, int), set(), np.array(scene.object_model)
    # Where objects are more than levels, each level has a tree state, and nothing is refitted.
    refits = [np.sum(model_of == m) <= len(set(lods)) for m, lods in enumerate(selection.ladder.lod.tolist())]
    assert set(refits) == {True, False}
    for frame in range(24):
        if frame % 8 == 0:
            focus = rng.uniform(0, 1, 50)
            selection.view.focus.assign(focus)
        tests = rng.integers(0, 10**12, 50) * (rng.uniform(size=50) < 0.7)
        up, down = rng.uniform(0.2, 1.2, 2)
        # Dear and cheap frames by turns, so that the position climbs, falls, stays and holds.
        rate = [1.0, {10: 1.8e-12, 5: 8e-13, 2: 8e-13}.get(frame % 12, 2e-13), [1e-3, 0.1][frame // 6 % 2], up, down]
        position, waited = map(int, selection.scale.numpy())
        selection.rate.assign(rate)
        selection.tests.assign(tests)
        selection.launch()
        offset = selection.offset.numpy()
        loose = np.minimum(np.array(scene.object_importance) / np.maximum(focus, 1e-9), 16.0)
        assert (offset <= np.floor(16 * np.log2(loose) + 1e-9)).all() and (offset >= 16 * np.log2(loose) - 6).all()
        steps = selection.changes
        assert steps[:-2] == sorted(steps[:-2], reverse=True) and steps[-2] == -selection.position_max
        lasting, moving, totals = [], [], []
        for k, step in enumerate(steps):
            then = np.array([plain_level(selection, i, position + step, offset[i]) for i in range(50)])
            then = level if k == len(steps) - 1 else then
            faces = selection.ladder.faces[scene.object_model]
            ratio = faces[np.arange(50), then] / faces[np.arange(50), level]
            # A pair's tests are counted for both of its objects.
            total = 0.5 * float(np.sum(np.minimum(tests * ratio ** np.where(ratio > 1, up, down), 2.0**40)))
            moves = [(m, a, b) for m, a, b in zip(model_of.tolist(), level.tolist(), then.tolist()) if refits[m]]
            nodes = sum(plain_nodes(scene.models[m], selection.ladder, m, a, b) for m, a, b in moves)
            assert selection.prediction.work.numpy()[k] == pytest.approx(2 * total, rel=1e-9)
            assert selection.prediction.nodes.numpy()[k] == pytest.approx(nodes, abs=2)
            totals.append(total)
            lasting.append(rate[0] + rate[1] * total)
            moving.append(rate[2] * nodes)
        way, chosen, waited = plain_choice(lasting, moving, steps.index(0), position, selection, waited)
        ways.add(way)
        assert int(selection.choice.numpy()[0]) == chosen, frame
        assert selection.choice.numpy()[3:5].tolist() == pytest.approx([totals[chosen], totals[-1]], rel=1e-9)
        position = min(max(position + steps[chosen], 0), selection.position_max)
        assert selection.scale.numpy().tolist() == [position, waited]
        if chosen < len(steps) - 1:
            level = np.array([plain_level(selection, i, position, offset[i]) for i in range(50)])
        assert selection.level.numpy().tolist() == level.tolist()
        assert selection.lods.numpy().tolist() == selection.ladder.lod[scene.object_model, level].tolist()
    assert ways == {"fall", "hold", "follow late", "climb", "wait", "climb late", "stay"}


def plain_choice(lasting, moving, stay, position, selection, waited):
    """The rule as its docstring has it; return its name, the candidate, and how many frames a move has waited."""
    budget, held = selection.budget_ms, len(lasting) - 1
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
