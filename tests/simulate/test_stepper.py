"""The stepper as a program: repeatable to the bit however it runs, room that grows, frames, and what it refuses."""

from functools import cache

import numpy as np
import pytest
from helpers import refused
from helpers.bodies import CUBE, FLOOR, GROUND, bits, box, heap, make, on_ground, run
from helpers.questions import captured
from helpers.samples import grid

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.kernels.bodies import graph_coloring

pytestmark = pytest.mark.slow


@cache
def fall(device):
    return run(heap(device), 80)


@pytest.mark.parametrize("warps", [1, None])
def test_a_heap_falls_the_same_again_however_it_is_relaxed(device, warps):
    with testing.regime(relaxing_warps=warps):
        dynamics = heap(device)
    assert np.array_equal(run(dynamics, 80), fall(device))
    assert dynamics.query.manifolds.count.numpy().sum() > 8


def test_a_body_in_more_contacts_than_colors(device):
    cube = box(0.3, 0.3, 0.3)
    cubes = [(cube, (0.6 * x - 1.5, 0.6 * y - 1.5, 0.2495 + 0.1, 0, 0, 0, 1)) for x in range(6) for y in range(6)]
    plate = box(4, 4, 0.2)
    found = []
    for warps in (1, None):
        with testing.regime(relaxing_warps=warps):
            dynamics = on_ground(device, (plate, (0, 0, 0.0995, 0, 0, 0, 1)), *cubes)
        run(dynamics, 10)
        used, count = dynamics.constraints.color.numpy(), int(graph_coloring.COLOR_COUNT)
        assert (used == count).sum() == 36 + 1 - count
        found.append(bits(dynamics))
    assert np.array_equal(*found)
    assert np.abs(found[0][:, 7:]).max() < 0.02


def test_launches_of_a_graph_do_what_steps_do(device):
    dynamics = heap(device, capacity=ab.Buffers(4096, pairs=256))
    run(dynamics, 1)
    replay = captured(dynamics, 1 / 120)
    for _ in range(79):
        replay()
        dynamics.check()
    assert np.array_equal(bits(dynamics), fall(device))


def test_capacity_grows_in_steps_and_is_refused_in_launches(device):
    assert np.array_equal(run(heap(device, capacity=ab.Buffers(1, pairs=1)), 80), fall(device))
    short = heap(device, capacity=ab.Buffers(4096, pairs=1))
    with pytest.raises(ab.CapacityError, match="pairs="):
        for _ in range(80):
            short.launch(1 / 120)
            short.check()


def test_bad_use_is_refused():
    dynamics = on_ground("cpu", (CUBE, (0, 0, 2, 0, 0, 0, 1)))
    before = bits(dynamics)
    for dt in (0, -1, np.nan, np.inf):
        refused(ValueError, "dt", dynamics.step, dt)
    refused(ValueError, "targets", dynamics.step, 0.01, np.zeros((3, 7)))
    refused(ValueError, "targets: 1 given for 2", dynamics.step, 0.01, [[0, 0, 0, 0, 0, 0, 1]])
    assert np.array_equal(bits(dynamics), before)
    sheet = ab.Model.from_arrays(*grid(1))
    make("cpu", (sheet, (0, 0, 2, 0, 0, 0, 1), True), (CUBE, (0, 0, 5, 0, 0, 0, 1))).step(0.01)
    dynamics.scene.add(CUBE)
    refused(RuntimeError, "objects were added", dynamics.step, 0.01)


def test_a_scene_without_bodies_stands(device):
    still = make(device, (GROUND, FLOOR, True), (GROUND, FLOOR, True))
    assert np.isinf(still.mass).all()
    assert np.array_equal(run(still, 3)[:, :7], np.tile(FLOOR, (2, 1)))
