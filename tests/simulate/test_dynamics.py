"""Rigid bodies against closed forms and plain Python; prescribed motion, and reports of budgets."""

import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import trimesh
from helpers import refused
from helpers.bodies import BALL, BRICK, CUBE, FLOOR, GROUND, TORUS, about, box, make, model_of, on_ground, run
from helpers.samples import grid
from scipy.integrate import solve_ivp
from trimesh.transformations import quaternion_matrix, rotation_matrix

import warp_abtree as ab
from warp_abtree.checks.quaternions import matrices_of, quaternions_of
from warp_abtree.simulate.body_state import mass_properties
from warp_abtree.simulate.budget_report import budget_report, cost_at_coarsest
from warp_abtree.simulate.frame_row import FrameRow


@cache
def mass_of(model):
    """Mass, centre and inertia of a model, by trimesh."""
    vertices, faces, _ = model.mesh_at(model.lod_max)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    return mesh.mass, mesh.center_mass, mesh.moment_inertia


def totals(dynamics):
    """Momentum, angular momentum and kinetic energy of all bodies, from masses, poses and velocities alone."""
    velocity, omega = dynamics.velocities()
    poses = dynamics.poses()
    rotations = matrices_of(poses[:, 3:])
    momentum, angular, energy = np.zeros(3), np.zeros(3), 0.0
    for i in np.flatnonzero(np.isfinite(dynamics.mass)):
        mass, centre, inertia = mass_of(dynamics.scene.models[dynamics.scene.object_model[i]])
        inertia = rotations[i] @ inertia @ rotations[i].T
        momentum += mass * velocity[i]
        angular += np.cross(rotations[i] @ centre + poses[i, :3], mass * velocity[i]) + inertia @ omega[i]
        energy += 0.5 * mass * velocity[i] @ velocity[i] + 0.5 * omega[i] @ inertia @ omega[i]
    return momentum, angular, energy


def test_mass_properties_of_a_box_off_its_origin():
    a, b, c = 2.0, 1.0, 0.5
    mesh = trimesh.creation.box((a, b, c)).apply_translation((3, -2, 1))
    found = mass_properties(model_of(mesh))
    assert found.volume == pytest.approx(1.0)
    np.testing.assert_allclose(found.centre, [3, -2, 1], atol=1e-12)
    expected = sorted([(b * b + c * c) / 12, (a * a + c * c) / 12, (a * a + b * b) / 12])
    np.testing.assert_allclose(found.moments, expected, rtol=1e-12)
    np.testing.assert_allclose(found.axes @ found.axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found.axes) > 0
    assert found.bounding_radius == pytest.approx(np.linalg.norm([a, b, c]) / 2)
    assert found.thickness == pytest.approx(c)


def test_an_open_mesh_has_the_mass_of_its_convex_hull(monkeypatch):
    mesh = trimesh.creation.box((1, 2, 3))
    for faces in (np.delete(mesh.faces, [0, 5], axis=0), mesh.faces[:, ::-1]):
        assert mass_properties(ab.Model.from_arrays(mesh.vertices, faces)).volume == pytest.approx(6.0)
    refused(ValueError, "flat", mass_properties, ab.Model.from_arrays(*grid(1)))
    missing = trimesh.exceptions.ExceptionWrapper(ModuleNotFoundError("No module named 'scipy'"))
    monkeypatch.setattr(trimesh.convex, "ConvexHull", missing)
    model = ab.Model.from_arrays(mesh.vertices, mesh.faces[1:], name="open")
    refused(ValueError, "'open' is not closed: its convex hull needs scipy", mass_properties, model)


def tumble(moments, momentum, rotation, time):
    """Turn a free body by SciPy's Runge-Kutta steps of its rotation matrix."""

    def rate(_, numbers):
        r = numbers.reshape(3, 3)
        return np.cross(r @ ((r.T @ momentum) / moments), r.T).T.ravel()

    return solve_ivp(rate, (0, time), rotation.ravel(), "DOP853", rtol=1e-12, atol=1e-12).y[:, -1].reshape(3, 3)


def test_a_free_body_flies_and_tumbles_about_its_centre_of_mass(device):
    """About the middle axis of inertia, where motion is unstable; the error falls with the square of the step."""
    centre = np.array([5, 1, -2])
    brick = model_of(trimesh.creation.box((2, 1, 0.4)).apply_translation(centre))
    pose = (0.3, 0.2, 0.1, *about((1, 2, 3), 0.7))
    r = matrices_of([pose[3:]])[0]
    omega, errors = np.array([0.3, 5.0, 0.2]), []
    for steps in (100, 200):
        dynamics = make(device, (brick, pose), velocity=(1, 2, 3), angular_velocity=omega, gravity=(0, 0, 0))
        start = totals(dynamics)
        run(dynamics, steps, 1 / steps)
        found = totals(dynamics)
        np.testing.assert_allclose(found[0], start[0], rtol=1e-14)
        np.testing.assert_allclose(found[1], start[1], rtol=1e-11)
        assert found[2] == pytest.approx(start[2], rel=1e-13)
        end = matrices_of(dynamics.poses()[:, 3:])[0]
        np.testing.assert_allclose(dynamics.poses()[0, :3] + end @ centre, r @ centre + [1.3, 2.2, 3.1], atol=1e-12)
        moments = dynamics.mass[0] / 12 * np.array([1 + 0.16, 4 + 0.16, 4 + 1])
        errors.append(np.abs(end - tumble(moments, r @ (moments * (r.T @ omega)), r, 1.0)).max())
    assert errors[0] < 1e-5 and errors[1] < errors[0] / 3.9


def test_gravity_is_semi_implicit_euler_in_substeps(device):
    dynamics = make(device, (CUBE, (0, 0, 0, 0, 0, 0, 1)), gravity=(0, 0, -8), velocity=(0.5, 0, 1))
    run(dynamics, 10, 0.125)
    parts = dynamics.substeps(0.125)
    falls = 1 - np.cumsum(np.full(10 * parts, 8 * 0.125 / parts))
    np.testing.assert_allclose(dynamics.velocities()[0][0], [0.5, 0, 1 + 0 - 8 * 1.25], rtol=1e-14)
    np.testing.assert_allclose(dynamics.poses()[0, :3], [0.625, 0, 0.125 / parts * falls.sum()], rtol=1e-13)


@pytest.mark.parametrize(("seed", "friction"), [(1, 0), (2, 0.5), (3, 0.5)])
def test_free_collisions_keep_momentum_and_angular_momentum(device, seed, friction):
    """Six bodies that fly at each other and do not overlap at first."""
    rng = np.random.default_rng(seed)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])[rng.permutation(8)[:6]]
    turns = rng.normal(size=(6, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    placed = [(model, (*(1.1 * p), *q)) for model, p, q in zip((BRICK, BALL, TORUS) * 2, corners, turns)]
    before = -corners * rng.uniform(0.7, 1.0, (6, 1)) + rng.normal(0, 0.1, (6, 3))
    omega = rng.normal(size=(6, 3))
    dynamics = make(device, *placed, friction=friction, velocity=before, angular_velocity=omega, gravity=(0, 0, 0))
    start, touched = totals(dynamics), 0
    assert not dynamics.scene.intersect().any.any()
    size = np.abs(dynamics.mass[:, None] * before).sum()
    energies = [start[2]]
    for _ in range(150):
        dynamics.step(0.01)
        touched += int(dynamics.query.manifolds.count.numpy().sum() > 0)
        energies.append(totals(dynamics)[2])
    found = totals(dynamics)
    assert touched >= 3 and np.abs(dynamics.velocities()[0] - before).max() > 0.5
    assert np.abs(found[0] - start[0]).max() < 1e-13 * size
    assert np.abs(found[1] - start[1]).max() < 1e-13 * size
    # A free tumble swings the energy a little; impulses add none.
    assert np.diff(energies).max() < 2e-5 * start[2]
    assert found[2] < 0.99 * start[2]


def test_corrections_of_place_leave_velocity_and_energy(device):
    """A brick deep in the floor that leaves it slowly: it is lifted and rotated, but keeps its velocities."""
    pose = (0, 0, 0.4, *about((0.3, 1, 0), 0.5))
    moving = {"velocity": (0, 0, 0.3), "angular_velocity": (0, 0, 2), "gravity": (0, 0, 0)}
    dynamics = on_ground(device, (box(1.2, 0.9, 0.5), pose), **moving)
    start = totals(dynamics)
    dynamics.step(0.01)
    found = totals(dynamics)
    lifted = dynamics.poses()[1, 2] - 0.4 - 0.01 * 0.3
    assert lifted > 0.005
    np.testing.assert_allclose(found[0], start[0], rtol=1e-12, atol=1e-15)
    assert 0.99 * start[2] < found[2] < (1 + 1e-12) * start[2]


@pytest.mark.parametrize("angle, friction", [(0.3, 0.4), (0.5, 0.2), (0.4, 0.0)])
def test_a_box_on_a_slope_sticks_or_slides(device, angle, friction):
    turn = about((0, 1, 0), angle)
    r = matrices_of([turn])[0]
    placed = (GROUND, (*(r @ [0, 0, -0.5]), *turn), True), (CUBE, (*(r @ [-2, 0, 0.4983]), *turn))
    dynamics = make(device, *placed, friction=friction)
    start = dynamics.poses()[1, :3]
    run(dynamics, 120)
    slid = r.T @ (dynamics.poses()[1, :3] - start)
    pull = 9.81 * max(0.0, np.sin(angle) - friction * np.cos(angle))
    assert slid[0] == pytest.approx(0.5 * pull, rel=0.06, abs=1e-3)
    assert np.abs(slid[1:]).max() < 0.1 * abs(slid[0]) + 2e-3
    assert (np.abs(dynamics.velocities()[0]).max() < 1e-6) == (pull == 0)


def test_a_kinematic_floor_carries_and_stops(device):
    dynamics = make(device, (GROUND, FLOOR), (CUBE, (0, 0, 0.4985, 0, 0, 0, 1)), kinematic=[0])
    assert np.isinf(dynamics.mass[0]) and dynamics.mass[1] == pytest.approx(1)
    targets = dynamics.poses()
    for step in range(120):
        targets[0, 0] = 0.5 * (step + 1) / 120
        targets[0, 3:] = about((0, 0, 1), 0.4 * (step + 1) / 120)
        dynamics.step(1 / 120, targets)
    np.testing.assert_allclose(dynamics.poses()[0], targets[0], atol=1e-15)
    velocity, omega = dynamics.velocities()
    np.testing.assert_allclose(velocity[0], [0.5, 0, 0], atol=1e-9)
    np.testing.assert_allclose(omega[0], [0, 0, 0.4], atol=1e-9)
    assert omega[1, 2] == pytest.approx(0.4, abs=0.02), "friction rotates the cube along"
    run(dynamics, 120)
    assert np.abs(dynamics.velocities()).max() < 1e-6


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


def test_powers_of_two_scale_every_bit_of_a_heap(device):
    """Points are relaxed in float32, in units of their pair: scenes of any size keep as many digits."""
    found = []
    for scale in (1.0, 2.0**-40, 2.0**60):
        parts = [model_of(trimesh.creation.box((e, e, 1.0)).apply_scale(scale)) for e in (20, 1)]
        turns = [about((1, 2, 3), angle) for angle in (0.0, 0.2, 0.9, 2.0)]
        placed = [(parts[k > 0], (0.2 * k * scale, 0, (1.2 * k - 0.5) * scale, *turns[k]), k == 0) for k in range(4)]
        dynamics = make(device, *placed, gravity=(0, 0, -10 * scale))
        for _ in range(40):
            dynamics.step(1 / 64)
        found.append((dynamics.poses() / np.repeat([scale, 1.0], (3, 4))).tobytes())
    assert found[0] == found[1] == found[2]


def test_a_heavy_cube_stands_on_a_light_one(device):
    dynamics = on_ground(device, (CUBE, (0, 0, 0.5, 0, 0, 0, 1)), (box(4, 4, 4), (0, 0, 3, 0, 0, 0, 1)))
    run(dynamics, 240, 1 / 60)
    np.testing.assert_allclose(dynamics.poses()[1:, :3], [[0, 0, 0.5], [0, 0, 3]], atol=0.015)


def test_motion_in_a_straight_line_and_about_an_axis():
    rng = np.random.default_rng(1)
    axis, rate = rng.normal(size=(8, 3)), rng.uniform(-3, 3, 8)
    start = rng.normal(size=(8, 4))
    start /= np.linalg.norm(start, axis=1, keepdims=True)
    motion = ab.Kinematic(position=np.ones((8, 3)), velocity=axis, rotation=start, axis=axis, rate=rate)
    buffer = np.empty((8, 7))
    for time in (0.0, 0.3, 7.7, -2.0):
        poses = motion.poses(time)
        assert motion.poses(time, out=buffer) is buffer and np.array_equal(buffer, poses)
        assert np.allclose(np.linalg.norm(poses[:, 3:], axis=1), 1.0, atol=1e-15)
        np.testing.assert_allclose(poses[:, :3], 1 + time * axis, rtol=1e-15, atol=1e-15)
        for i in range(8):
            expected = rotation_matrix(rate[i] * time, axis[i]) @ quaternion_matrix(np.roll(start[i], 1))
            assert np.allclose(quaternion_matrix(np.roll(poses[i, 3:], 1)), expected, atol=1e-12)


@pytest.mark.parametrize(("time", "way"), [(0.0, 0.5), (0.5, 1.0), (0.8, 0.7), (1.5, 0.0), (1.7, 0.2), (6.5, 1.0)])
def test_shuttle_reflects_at_its_ends(time, way):
    motion = ab.Kinematic(position=[[0.5, 0.0, 1.0]], shuttle=[1.0, -2.0, 0.5], period=2.0, phase=0.25)
    assert np.allclose(motion.poses(time)[0, :3], [0.5 + way, -2.0 * way, 1.0 + 0.5 * way])


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


def test_controllers_warn_of_floors_that_let_bodies_through(device):
    """A crate of boxes dissolves at its coarsest LOD; with all its faces kept it does not."""
    walls = [trimesh.creation.box((4, 4, 0.4), trimesh.transformations.translation_matrix((0, 0, -0.2)))]
    walls += [trimesh.creation.box((0.2, 4, 2), trimesh.transformations.translation_matrix((x, 0, 1))) for x in (-2, 2)]
    crate, ball = trimesh.util.concatenate(walls), ab.Model.load(trimesh.creation.icosphere(1, 0.3))
    for faces, warns in ((10, True), (len(crate.faces), False)):
        scene = ab.Scene(device=device)
        model = ab.Model.load(crate, base_faces=faces)
        for world in range(3):  # one warning a model
            scene.add(model, static=True, name=("crate", None, None)[world], world=world)
        scene.add(ball, pose=(0, 0, 1, 0, 0, 0, 1))
        motion = ab.Dynamics(scene).motion()
        with warnings.catch_warnings(record=True, action="always") as caught:
            ab.Frame(scene, motion, ab.PredictiveController(scene, budget_ms=5.0))
            ab.Frame(scene, motion)
        told = [str(warning.message) for warning in caught if "fall through" in str(warning.message)]
        assert len(told) == warns and all("object 0 'crate'" in text for text in told)
