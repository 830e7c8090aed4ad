"""Stacks of rigid bodies: they stand, whatever their size, their masses and the length of a step."""

import numpy as np
import pytest
from helpers.bodies import CUBE, about, box, on_ground, run

from warp_abtree.simulate.body_state import mass_properties


@pytest.mark.parametrize("splits, remember", [(2, False), (0, True)])
@pytest.mark.slow
def test_a_stack_of_five_stands_for_ten_seconds(device, splits, remember):
    cube = box(1, 1, 1, splits=splits)
    placed = [(cube, (0.02 * (k % 2), 0.01 * k, 0.5 + k, 0, 0, 0, 1)) for k in range(5)]
    dynamics = on_ground(device, *placed, remember=remember)
    start = dynamics.poses()[1:]
    run(dynamics, 600, 1 / 60)
    moved = dynamics.poses()[1:] - start
    slop = mass_properties(cube).bounding_radius / 512
    assert np.abs(moved[:, :2]).max() < 0.006 and np.abs(moved[:, 3:6]).max() < 0.01
    sunk = np.diff(-moved[:, 2], prepend=0)  # of each cube into what is below
    assert sunk.min() > -0.05 * slop and sunk.max() < slop
    assert np.abs(dynamics.velocities()[0]).max() < 1e-3
    assert not remember or (dynamics.query.memory.place.numpy()[:5] >= 0).all()


@pytest.mark.parametrize("offset", [0.0, 0.02])
@pytest.mark.slow
def test_a_stack_of_ten_drifts_by_less_than_a_millimetre(device, offset):
    dynamics = on_ground(device, *((CUBE, (offset * (k % 2), 0, 0.5 + k, 0, 0, 0, 1)) for k in range(10)))
    start = dynamics.poses()[1:, :2]
    run(dynamics, 600, 1 / 60)
    assert np.linalg.norm(dynamics.poses()[1:, :2] - start, axis=1).max() < 1e-3
    assert np.abs(dynamics.velocities()[0]).max() < 1e-4


def test_contact_points_that_come_and_go_do_not_shake_a_stack(device):
    """Boxes turned against each other have more corners than points: which are chosen changes from step to step."""
    part = box(0.8, 0.6, 0.4)
    dynamics = on_ground(device, *((part, (0, 0, 0.21 + 0.41 * k, *about((0, 0, 1), 0.3 * k))) for k in range(3)))
    run(dynamics, 400, 1 / 60)
    assert np.abs(dynamics.poses()[1:, :2]).max() < 5e-4 and np.abs(dynamics.velocities()[0]).max() < 0.02


def test_small_bodies_and_long_steps_have_more_substeps(device):
    """Stacks of five of 2 cm, and of 1 unit at 10 steps a second, stand: springs give by a slop for each body borne."""
    for size, dt, least in ((1.0, 1 / 60, 8), (1.0, 0.1, 15), (0.02, 1 / 60, 16)):
        part = box(size, size, size)
        placed = [(part, (0.02 * size * (k % 2), 0, (0.5 + k) * size, 0, 0, 0, 1)) for k in range(5)]
        dynamics = on_ground(device, *placed)
        assert dynamics.substeps(dt) >= least
        run(dynamics, 60, dt)
        moved = (dynamics.poses()[1:, :3] - [place[:3] for _, place in placed]) / size
        assert np.abs(moved[:, :2]).max() < 1e-3 and -0.02 < moved[:, 2].min() <= moved[:, 2].max() < 0


def test_a_heavy_cube_stands_on_a_light_one(device):
    dynamics = on_ground(device, (CUBE, (0, 0, 0.5, 0, 0, 0, 1)), (box(4, 4, 4), (0, 0, 3, 0, 0, 0, 1)))
    run(dynamics, 240, 1 / 60)
    np.testing.assert_allclose(dynamics.poses()[1:, :3], [[0, 0, 0.5], [0, 0, 3]], atol=0.015)
