"""Prescribed motion against closed forms, rotations against trimesh's; reports of budgets."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import refused
from trimesh.transformations import quaternion_matrix, rotation_matrix

import warp_abtree as ab
from warp_abtree.checks.quaternions import matrices_of, quaternions_of
from warp_abtree.simulate.budget_report import budget_report, cost_at_coarsest
from warp_abtree.simulate.frame_row import FrameRow


def test_motion_in_a_straight_line():
    motion = ab.Kinematic(position=[[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]], velocity=[[1.0, 0.0, -2.0], [0.0, 0.5, 0.0]])
    assert np.allclose(motion.poses(4.0), [[5, 2, -5, 0, 0, 0, 1], [0, 2, 0, 0, 0, 0, 1]])
    assert np.allclose(motion.poses(-1.0)[:, :3], [[0, 2, 5], [0, -0.5, 0]])


def test_rotation_about_an_axis():
    rng = np.random.default_rng(1)
    axis, rate = rng.normal(size=(8, 3)), rng.uniform(-3, 3, 8)
    start = rng.normal(size=(8, 4))
    start /= np.linalg.norm(start, axis=1, keepdims=True)
    motion = ab.Kinematic(position=np.zeros((8, 3)), rotation=start, axis=axis, rate=rate)
    buffer = np.empty((8, 7))
    for time in (0.0, 0.3, 7.7, -2.0):
        poses = motion.poses(time)
        assert motion.poses(time, out=buffer) is buffer and np.array_equal(buffer, poses)
        assert np.allclose(np.linalg.norm(poses[:, 3:], axis=1), 1.0, atol=1e-15)
        for i in range(8):
            expected = rotation_matrix(rate[i] * time, axis[i]) @ quaternion_matrix(np.roll(start[i], 1))
            assert np.allclose(quaternion_matrix(np.roll(poses[i, 3:], 1)), expected, atol=1e-12)


@pytest.mark.parametrize(("time", "way"), [(0.0, 0.5), (0.5, 1.0), (0.8, 0.7), (1.5, 0.0), (1.7, 0.2), (6.5, 1.0)])
def test_shuttle_reflects_at_its_ends(time, way):
    motion = ab.Kinematic(position=[[0.5, 0.0, 1.0]], shuttle=[1.0, -2.0, 0.5], period=2.0, phase=0.25)
    assert np.allclose(motion.poses(time)[0, :3], [0.5 + way, -2.0 * way, 1.0 + 0.5 * way])


@pytest.mark.parametrize(
    "wrong",
    [
        {"position": [0.0, 0.0, 0.0]},
        {"velocity": np.zeros((2, 3))},
        {"velocity": [np.nan, 0, 0]},
        {"rotation": [0.0, 0.0, 0.0, 2.0]},
        {"axis": [0.0, 0.0, 0.0], "rate": 1.0},
        {"period": 0.0},
        {"period": np.nan},
    ],
)
def test_motion_refuses(wrong):
    refused(ValueError, next(iter(wrong)), ab.Kinematic, **{"position": np.zeros((3, 3)), **wrong})


def test_quaternions_of_all_rotations():
    q = np.random.default_rng(0).normal(size=(200, 4))
    q = np.concatenate([q, np.eye(4), [[1, 1, 0, 0], [0, 1, 1, 1e-12], [1e-9, 1, 0, 1]]])
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    expected = [quaternion_matrix(np.roll(row, 1))[:3, :3] for row in q]
    np.testing.assert_allclose(matrices_of(q), expected, atol=1e-14)
    np.testing.assert_allclose(matrices_of(quaternions_of(matrices_of(q))), expected, atol=1e-14)


def make_rows(costs, budget=10.0, step=0.5):
    rows = []
    for i, cost in enumerate(costs):
        values = dict.fromkeys(FrameRow.names()[:-1], 0)
        values |= {"frame": i, "time": i * step, "objects": 4, "oscillations": i % 2, "error_mean": float(i)}
        rows.append(FrameRow(**{**values, "budget_ms": budget, "query_ms": cost - 1.5, "answer_ms": 1.5}))
    return rows


def test_reports_count_frames_within_a_budget():
    rows = make_rows([50, 50, 10, 10.5, 11, 11.5, 12, 8, 40, 9])
    report = budget_report(rows)
    assert report == {
        "frames": 8,
        "within": 3 / 8,
        "within_110_percent": 5 / 8,
        "worst": 4.0,
        "longest_over": 2,
        "oscillations": pytest.approx(4 / 4 / 4.0),
        "error_mean": 5.5,
    }
    assert budget_report(rows, after=0.0)["within"] == 3 / 10
    assert budget_report(rows, budget_ms=20.0)["within"] == 7 / 8
    assert budget_report(rows, after=5.0) is None and budget_report(make_rows([1.0] * 9, None)) is None


def at_lods(costs, lods):
    return [replace(row, lod_max=lod) for row, lod in zip(make_rows(costs), lods, strict=True)]


def test_a_budget_below_the_cost_of_the_coarsest_lods_is_impossible():
    assert cost_at_coarsest(at_lods([99, 12, 14, 13, 9], [0, 0, 0, 0, 7])) == 13
    assert cost_at_coarsest(at_lods([99, 12, 14, 9], [0, 0, 5, 7])) is None, "it climbs from there"
    assert cost_at_coarsest(at_lods([99], [0])) is None and cost_at_coarsest([]) is None
