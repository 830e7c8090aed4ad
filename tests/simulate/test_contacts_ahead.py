"""Rigid bodies look ahead: what falls stops at the surface, and what stands still does not notice."""

import numpy as np
import pytest
import trimesh
from helpers.bodies import about, make, model_of, on_ground, run
from oracles.triangle import quaternion_matrix

import warp_abtree as ab
from warp_abtree.simulate.body_state import mass_properties

BOX = model_of(trimesh.creation.box((0.8, 0.6, 0.4)))
FINE_TORUS = model_of(trimesh.creation.torus(0.5, 0.2, 64, 16))
FINE_BALL = model_of(trimesh.creation.icosphere(4, 0.5))


def depth_in_floor(dynamics, model, i=1):
    """How far the lowest vertex is below the floor, in slops of the body."""
    pose = dynamics.poses()[i]
    vertices = model.mesh_at(model.lod_max)[0] @ quaternion_matrix(pose[3:]).T + pose[:3]
    return -vertices[:, 2].min() / (mass_properties(model).bounding_radius / 512)


@pytest.mark.parametrize("speed", [2.0, 6.0])
@pytest.mark.parametrize("turn", [0.0, 0.4])
def test_a_box_that_falls_stops_at_the_surface(device, speed, turn):
    """In a step it moves by up to 100 slops; it never sinks by more than a few."""
    pose = (0, 0, 1.0, *about((1, 2, 0), turn))
    dynamics = on_ground(device, (BOX, pose), velocity=(0, 0, -speed), friction=0.3)
    worst = -np.inf
    for _ in range(90):
        dynamics.step(1 / 60)
        worst = max(worst, depth_in_floor(dynamics, BOX))
    assert -0.1 < depth_in_floor(dynamics, BOX) < 2
    assert worst < (4 if turn == 0 else 30)
    assert np.abs(dynamics.velocities()[0]).max() < 0.05


@pytest.mark.parametrize("model, most", [(FINE_TORUS, 1.5), (FINE_BALL, 2.0)])
def test_fine_meshes_rest_a_few_slops_deep_at_60_steps_a_second(device, model, most):
    low = model.mesh_at(model.lod_max)[0][:, 2].min()
    dynamics = on_ground(device, (model, (0, 0, 0.3 - low, *about((0, 0, 1), 0.3))))
    run(dynamics, 90, 1 / 60)
    assert -0.1 < depth_in_floor(dynamics, model) < most


def test_bodies_that_fly_together_have_no_contacts(device):
    """Their reach is that of their relative motion, whatever the speed."""
    placed = [(BOX, (0.9 * k, 0, 0, 0, 0, 0, 1)) for k in range(3)]
    dynamics = make(device, *placed, velocity=(0, 0, 20.0), gravity=(0, 0, 0))
    run(dynamics, 3, 1 / 60)
    assert len(dynamics.query.result().points["pair"]) == 0
    np.testing.assert_allclose(dynamics.velocities()[0], [[0, 0, 20.0]] * 3)


def test_a_body_that_passes_by_is_not_touched(device):
    """Over a floor, not towards it: contacts ahead hold nothing that does not come nearer."""
    dynamics = on_ground(device, (BOX, (-2, 0, 0.205, 0, 0, 0, 1)), velocity=(6.0, 0, 0), gravity=(0, 0, 0))
    run(dynamics, 30, 1 / 60)
    np.testing.assert_allclose(dynamics.velocities()[0][1], [6.0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(dynamics.poses()[1, :3], [1.0, 0, 0.205], atol=1e-12)


def test_only_faces_about_the_nearest_are_contacts_ahead(device):
    """Of a fine ball that falls fast: as far as its distance from the floor and half a face."""
    height, speed = 0.6, 9.0
    dynamics = on_ground(device, (FINE_BALL, (0, 0, height, 0, 0, 0, 1)), velocity=(0, 0, -speed))
    dynamics.find()
    query = dynamics.query
    distance = ab.DistanceQuery(dynamics.scene, [(0, 1)]).run().bracket[0, 1]
    radius = dynamics.bodies.bounding_radius.numpy()[1]
    faces = len(FINE_BALL.mesh_at(FINE_BALL.lod_max)[1])
    gap = query.hits.gap.numpy()[0]
    np.testing.assert_allclose(gap, distance + radius * np.sqrt(np.pi / faces), rtol=1e-4)
    reach = np.linalg.norm(dynamics.bodies.reach.numpy()[1][:3])
    assert gap < reach
    near = ab.ContactQuery(dynamics.scene, [(0, 1)], gap=[gap]).run()
    assert query.hits.count.numpy()[0] == near.count[0] > 0
    far = ab.ContactQuery(dynamics.scene, [(0, 1)], gap=[reach]).run()
    assert far.count[0] > 1.5 * near.count[0]
