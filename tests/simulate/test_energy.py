"""Energy of rigid bodies: of fast spins, free and on the floor; and thin bodies, which rest without falling through."""

import numpy as np
import pytest
from helpers import refused
from helpers.bodies import BRICK, FLOOR, GROUND, about, bits, box, make, on_ground, run
from helpers.samples import STILL

import warp_abtree as ab

ROD, SHEET = box(1, 0.02, 0.03), box(1, 1, 0.05)


def energies(dynamics):
    """Kinetic energy of each rigid body."""
    velocity, omega = (rows[dynamics.rigid] for rows in dynamics.velocities())
    momentum = dynamics.bodies.momentum.numpy()[dynamics.rigid]
    return 0.5 * (dynamics.mass[dynamics.rigid] * (velocity**2).sum(1) + (omega * momentum).sum(1))


@pytest.mark.parametrize("spin", [5.0, 60.0, 300.0, 3e3, 1e12])
def test_a_thin_rod_spins_freely_without_more_energy(device, spin):
    """From a small part of a revolution in a step to many: it keeps its angular momentum and its energy."""
    for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1), (0.3, 1, 0.2)):
        turning = spin * np.array(axis) / np.linalg.norm(axis)
        dynamics = make(device, (ROD, (0, 0, 0, *about((1, 2, 3), 0.7))), angular_velocity=turning, gravity=(0, 0, 0))
        start, momentum = energies(dynamics), dynamics.bodies.momentum.numpy()
        for _ in range(30):
            dynamics.step(1 / 60)
            np.testing.assert_allclose(energies(dynamics), start, rtol=1e-10)
        assert np.array_equal(dynamics.bodies.momentum.numpy(), momentum)


def test_a_fast_spin_is_as_far_as_it_should_be(device):
    """About an axis of inertia, by a radian a substep."""
    dynamics = make(device, (BRICK, STILL), angular_velocity=(0, 0, 480.0), gravity=(0, 0, 0))
    run(dynamics, 6, 1 / 60)
    turn = 2 * np.arctan2(*dynamics.poses()[0, 5:])
    assert abs((turn - 48 + np.pi) % (2 * np.pi) - np.pi) < 48e-3


@pytest.mark.parametrize("model", [ROD, SHEET, BRICK], ids=["rod", "sheet", "brick"])
def test_spinning_bodies_that_hit_the_floor_gain_no_energy(device, model):
    """Whatever strikes, slides and is pushed out of the floor: without gravity there is only energy of motion."""
    rng = np.random.default_rng(4)
    scene, spins = ab.Scene(device), []
    for world in range(24):
        turn, axis = rng.normal(size=4), rng.normal(size=3)
        scene.add(GROUND, FLOOR, world=world, static=True)
        scene.add(model, (0, 0, 0.7, *(turn / np.linalg.norm(turn))), world=world)
        spins += [(0, 0, 0), axis / np.linalg.norm(axis) * (1, 5, 20, 60, 300, 3e3)[world % 6]]
    dynamics = ab.Dynamics(scene, velocity=(0, 0, -2.0), angular_velocity=spins, gravity=(0, 0, 0))
    before = first = energies(dynamics)
    touched = 0
    for _ in range(60):
        dynamics.step(1 / 60)
        after = energies(dynamics)
        assert (after < before * (1 + 1e-12) + 1e-12 * first).all()
        before, touched = after, touched + int((dynamics.query.manifolds.count.numpy() > 0).sum())
    assert touched > 200 and np.median(before / first) < 0.9


@pytest.mark.parametrize("thickness", [3e-3, 1e-3, 1e-4])
def test_thin_bodies_rest_on_the_floor(device, thickness):
    """Less deep than they are thick, however they fall."""
    for turn, height, spin in ((0, 0.3, 0), (1.2, 1, 0), (0.5, 1, 8)):
        sheet = box(1, 0.8, thickness), (0, 0, height, *about((1, 0.3, 0), turn))
        dynamics = on_ground(device, sheet, angular_velocity=(spin, spin / 2, spin))
        run(dynamics, 150, 1 / 60)
        assert 0.1 * thickness < dynamics.poses()[1, 2] < 0.5 * thickness
        assert np.abs(dynamics.velocities()).max() < 1e-4


def test_steps_too_long_for_a_thin_body_are_refused():
    """It is named, and nothing is changed; shorter steps do, less gravity too, and `continuous`."""
    scene = ab.Scene("cpu")
    scene.add(GROUND, FLOOR, static=True)
    scene.add(box(1, 0.8, 1e-5), (0, 0, 0.01, 0, 0, 0, 1), name="foil")
    thin = ab.Dynamics(scene)
    before = bits(thin)
    refused(ValueError, "0.0167 .* body 'foil'.* thin.* steps of 0.0057 at most, or continuous=True", thin.step, 1 / 60)
    refused(ValueError, "'foil'", thin.launch, 1 / 60)
    assert np.array_equal(bits(thin), before)
    for dynamics, dt in ((thin, 0.0056), (ab.Dynamics(scene, continuous=True), 1 / 60)):
        run(dynamics, 60, dt)
        assert -1e-5 < dynamics.poses()[1, 2] < 2e-3
    ab.Dynamics(scene, gravity=(0, 0, -0.1)).step(1 / 60)


def throw_rod(device, friction, kind):
    """Return the dynamics of a rod 1e-4 thick after it has hit the floor, by one of two spins."""
    rng = np.random.default_rng(5)
    turn, spins = rng.normal(size=4), 0.3 * rng.normal(size=(2, 3))
    rod = box(1, 1e-4, 1e-4), (0, 0, 0.9, *(turn / np.linalg.norm(turn)))
    options = {"velocity": [[0, 0, 0], [0.1, 0, -1.0]], "angular_velocity": spins[[kind, kind]], "gravity": (0, 0, 0)}
    dynamics = make(device, (box(8, 8, 1), (0, 0, -0.5, 0, 0, 0, 1), True), rod, friction=friction, **options)
    run(dynamics, 70, 1 / 60)
    return dynamics


def test_a_thin_rod_is_not_thrown_off(device):
    """Where float32 says that a point would answer an impulse by going against it, the point has none."""
    assert np.linalg.norm(throw_rod(device, 0.5, 1).velocities()[0], axis=1).max() < 1.1


def test_friction_without_end_is_one(device):
    """More than float32 can multiply is as good as what it can."""
    assert np.array_equal(bits(throw_rod(device, 1e300, 0)), bits(throw_rod(device, 2.0**60, 0)))
