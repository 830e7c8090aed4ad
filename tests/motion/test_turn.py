"""Sines, turns and their axes, against the mathematical functions of Python."""

import math

import numpy as np
import pytest
import warp as wp
from helpers.questions import launch
from helpers.samples import random_quaternions
from oracles.triangle import quaternion_matrix

from warp_abtree.kernels.motion.turn import shortest_turn, sin_cos_half, turn_matrix

U = 2.0**-53


@wp.kernel(module="unique", module_options={"fuse_fp": False})
def halves_kernel(angle: wp.array(dtype=wp.float64), out: wp.array2d(dtype=wp.float64)):
    i = wp.tid()
    s, c = sin_cos_half(angle[i])
    out[i, 0] = s
    out[i, 1] = c


@wp.kernel(module="unique", module_options={"fuse_fp": False})
def turn_kernel(turn: wp.array(dtype=wp.mat33d), out: wp.array2d(dtype=wp.float64)):
    i = wp.tid()
    axis, angle, _ = shortest_turn(turn[i])
    back = turn_matrix(axis, angle)
    out[i, 0] = angle
    for j in range(9):
        out[i, 1 + j] = back[j / 3, j % 3]


def test_sines_are_those_of_float64(device):
    angles = np.linspace(0, math.pi, 20001)
    found = launch(halves_kernel, device, len(angles), angles, columns=2)
    truth = np.array([[math.sin(0.5 * x), math.cos(0.5 * x)] for x in angles])
    assert np.abs(found - truth).max() <= 4 * U


@pytest.mark.parametrize("angle", [3.14159, 3.0, 1.0, 1e-3, 1e-9, 1e-15, 0.0])
def test_turns_are_found_again(device, angle):
    axes = np.random.default_rng(1).normal(size=(200, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    turns = np.array([quaternion_matrix([*(math.sin(angle / 2) * axis), math.cos(angle / 2)]) for axis in axes])
    found = launch(turn_kernel, device, len(turns), turns, columns=10)
    assert np.abs(found[:, 0] - angle).max() <= 40 * U
    assert np.abs(found[:, 1:].reshape(-1, 3, 3) - turns).max() <= 40 * U


def test_half_revolutions_are_none(device):
    turns = np.array([quaternion_matrix([*q[:3], 0]) for q in random_quaternions(np.random.default_rng(2), 50)])
    assert (launch(turn_kernel, device, len(turns), turns, columns=10)[:, 0] == -1).all()
