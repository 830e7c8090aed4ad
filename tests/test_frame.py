"""Kinematic motion against closed forms and a bouncing point; frames against fresh scenes and an injected clock."""

import csv
import json
import math

import numpy as np
import pytest
import trimesh

import warp_abtree as ab
from warp_abtree.dynamics import multiply_quaternions, quaternions_about


def rotate(quaternion, vector):
    """Turn a vector by a quaternion x y z w as the product q v q*."""
    x, y, z, w = quaternion
    turned = multiply_quaternions(multiply_quaternions(quaternion, [*vector, 0.0]), [-x, -y, -z, w])
    assert abs(turned[3]) < 1e-12
    return turned[:3]


def rodrigues(axis, angle, vector):
    axis, vector = np.asarray(axis) / np.linalg.norm(axis), np.asarray(vector)
    along = axis * (axis @ vector)
    return along + (vector - along) * math.cos(angle) + np.cross(axis, vector) * math.sin(angle)


def bounce(start, way, period, phase, time, steps=20_000):
    """Walk from one end to the other and back in small steps, turning round at the ends."""
    s, direction = 0.0, 1.0
    for _ in range(round(steps * (time / period + phase))):
        s += direction * 2.0 / steps
        if s >= 1.0 - 1e-9 or s <= 1e-9:
            direction = -direction
    return np.asarray(start) + s * np.asarray(way)


@pytest.fixture(scope="module")
def models():
    ring = trimesh.creation.torus(major_radius=0.5, minor_radius=0.15, major_sections=24, minor_sections=12)
    return ab.Model.load(ring), ab.Model.load(trimesh.creation.icosphere(subdivisions=2, radius=0.4))


def make_scene(models, device="cpu"):
    scene = ab.Scene(device=device)
    for model in (models[0], models[1], models[0]):
        scene.add(model)
    return scene


def make_motion():
    return ab.Kinematic(
        position=[[0.0, 0.0, 0.0], [0.7, 0.0, 0.0], [0.0, 0.3, 0.0]],
        velocity=[[0.0, 0.0, 0.0], [-0.5, 0.0, 0.0], [0.1, 0.0, 0.0]],
        axis=[1.0, 2.0, -1.0],
        rate=[0.0, 1.0, 2.5],
    )


# Motion.


def test_motion_in_a_straight_line():
    motion = ab.Kinematic(position=[[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]], velocity=[[1.0, 0.0, -2.0], [0.0, 0.5, 0.0]])
    assert np.allclose(motion.poses(4.0), [[5, 2, -5, 0, 0, 0, 1], [0, 2, 0, 0, 0, 0, 1]])
    assert np.allclose(motion.poses(-1.0)[:, :3], [[0, 2, 5], [0, -0.5, 0]])


def test_turning_follows_rodrigues():
    rng = np.random.default_rng(1)
    axis, rate = rng.normal(size=(8, 3)), rng.uniform(-3, 3, 8)
    start = rng.normal(size=(8, 4))
    start /= np.linalg.norm(start, axis=1, keepdims=True)
    motion = ab.Kinematic(position=np.zeros((8, 3)), rotation=start, axis=axis, rate=rate)
    for time in (0.0, 0.3, 7.7, -2.0):
        poses = motion.poses(time)
        assert np.allclose(np.linalg.norm(poses[:, 3:], axis=1), 1.0, atol=1e-15)
        for i in range(8):
            vector = rng.normal(size=3)
            expected = rodrigues(axis[i], rate[i] * time, rotate(start[i], vector))
            assert np.allclose(rotate(poses[i, 3:], vector), expected, atol=1e-12)


def test_quarter_turn_is_right_handed():
    assert np.allclose(rotate(quaternions_about([0, 0, 1], np.pi / 2), [1, 0, 0]), [0, 1, 0])


@pytest.mark.parametrize("time", [0.0, 0.4, 1.0, 1.3, 2.0, 5.9])
def test_shuttle_reflects_at_its_ends(time):
    start, way = [0.5, 0.0, 1.0], [1.0, -2.0, 0.5]
    motion = ab.Kinematic(position=[start], shuttle=way, period=2.0, phase=0.25)
    assert np.allclose(motion.poses(time)[0, :3], bounce(start, way, 2.0, 0.25, time), atol=1e-3)


def test_poses_write_into_a_buffer():
    motion = make_motion()
    out = np.empty((3, 7))
    assert motion.poses(0.7, out=out) is out
    assert np.array_equal(out, motion.poses(0.7))


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
    with pytest.raises(ValueError, match=next(iter(wrong))):
        ab.Kinematic(**{"position": np.zeros((3, 3)), **wrong})


# LODs.


def test_sweep_goes_down_and_up_in_equal_ratios(models):
    sweep = ab.LodSweep([(models[0], np.array([0, 2]))], 1.0, 0.04, 4.0)
    assert [sweep.fraction(t) for t in (0, 1, 2, 3, 4)] == pytest.approx([1.0, 0.2, 0.04, 0.2, 1.0])
    lods = np.array([7, 7, 7])
    sweep.apply(0.5, lods)
    assert lods.tolist() == [models[0].lod_for(fraction=0.5), 7, models[0].lod_for(fraction=0.5)]


def test_lod_wishes(models):
    model = models[0]
    for wish, lod in (
        ("finest", model.lod_max),
        ("coarsest", 0),
        (17, 17),
        ("17", 17),
        (0.25, model.lod_for(fraction=0.25)),
        ("0.25", model.lod_for(fraction=0.25)),
        (1.0, model.lod_max),
        ("1", 1),
        ("tol:1e30", model.lod_for(tolerance=1e30)),
        ("tol:0", model.lod_for(tolerance=0)),
    ):
        assert ab.resolve_lod(model, wish) == lod, wish
    for wish in ("", "fine", "tol:", "tol:x", "tol:-1", "tol:nan", "nan", 0.0, 1.5, -1, model.lod_max + 1, "2.0"):
        with pytest.raises(ValueError):
            ab.resolve_lod(model, wish)


# Frames.


def test_rows_are_what_a_fresh_scene_finds(models, device):
    def lods_at(time):
        return np.array([models[0].lod_max, 60, 40] if time < 0.25 else [50, 60, 50])

    motion = make_motion()
    frame = ab.Frame(make_scene(models, device), motion, lods_at, output="faces", time_step=0.1)
    for number in range(5):
        time = number * 0.1
        result = frame.step()
        fresh = make_scene(models, device)
        fresh.set_lods(lods_at(time))
        fresh.set_poses(motion.poses(time))
        expected = fresh.intersect(output="faces")
        assert np.array_equal(result.pairs, expected.pairs) and np.array_equal(result.faces, expected.faces)
        row = frame.history[-1]
        assert (row.frame, row.time, row.objects) == (number, pytest.approx(time), 3)
        assert (row.pairs, row.touching, row.hits) == (len(expected.pairs), expected.any.sum(), len(expected.faces))
        assert (row.lod_min, row.lod_max) == (lods_at(time).min(), lods_at(time).max())
        model_of = (models[0], models[1], models[0])
        assert row.faces == sum(len(m.mesh_at(lod)[2]) for m, lod in zip(model_of, lods_at(time)))
        assert row.states == (3 if number < 3 else 2)
        # Trees are refitted in the first frame and where LODs change, and at no other time.
        assert (row.nodes_refitted > 0) == (number in (0, 3)), row
    assert max(row.hits for row in frame.history) > 0


def test_lods_are_set_only_where_they_change(models, monkeypatch):
    scene, calls = make_scene(models), []
    frame = ab.Frame(scene, lods=lambda time: np.array([scene.lods[0], 60, 40 if time < 0.45 else 50]), time_step=0.1)
    set_lods = scene.set_lods
    monkeypatch.setattr(scene, "set_lods", lambda lods: calls.append(len(frame.history)) or set_lods(lods))
    frame.run(8)
    assert calls == [0, 5]
    lods = scene.lods
    frame.warm_up()
    assert np.array_equal(scene.lods, lods) and len(frame.history) == 8


def test_stages_are_timed_apart(models):
    ticks = iter(np.cumsum([100.0, 0.001, 0.020, 0.300, 4.0, 50.0, 0.002, 0.030, 0.400, 5.0]))
    frame = ab.Frame(make_scene(models), make_motion(), output="any", clock=lambda: next(ticks))
    frame.warm_up()
    rows = frame.run(2)
    stages = [(row.refine_ms, row.move_ms, row.broad_ms, row.query_ms) for row in rows]
    assert stages == [pytest.approx((1, 20, 300, 4000)), pytest.approx((2, 30, 400, 5000))]
    assert rows[1].total_ms == pytest.approx(5432)
    assert rows[0].hits is None
    summary = frame.summary()
    assert summary["stages"]["query_ms"] == pytest.approx({"mean": 4500, "p95": 4950, "total": 9000})
    assert summary["frames"] == 2 and summary["objects"] == 3


def test_history_is_recorded(models, tmp_path):
    frame = ab.Frame(make_scene(models), make_motion())
    seen = []
    frame.run(3, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(1, 3), (2, 3), (3, 3)]
    frame.record(tmp_path / "rows.json")
    frame.record(tmp_path / "rows.csv")
    expected = [row.as_dict() for row in frame.history]
    assert json.loads((tmp_path / "rows.json").read_text()) == expected
    with open(tmp_path / "rows.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ab.FrameRow.names()
    assert [{key: float(value) for key, value in row.items()} for row in rows] == expected
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rows.csv", "rows.json"]


def test_frame_refuses(models):
    with pytest.raises(ValueError, match="scene has 3"):
        ab.Frame(make_scene(models), ab.Kinematic(position=[[0.0, 0.0, 0.0]]))
    with pytest.raises(ValueError, match="time_step"):
        ab.Frame(make_scene(models), time_step=np.nan)
    with pytest.raises(ValueError, match="no motion"):
        ab.Frame(make_scene(models)).poses_at(0.0)
