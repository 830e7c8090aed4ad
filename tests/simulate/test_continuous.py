"""Fast bodies: with `continuous` surfaces stay apart; without it bodies that look ahead stop at the surface."""

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers import refused
from helpers.bodies import BRICK, TORUS, about, bits, box, make, model_of, on_ground, run
from helpers.questions import captured
from helpers.samples import STILL
from oracles.triangle import quaternion_matrix

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.query.request import Buffers, CapacityError
from warp_abtree.simulate import continuous
from warp_abtree.simulate.body_state import mass_properties

SHEET = box(0.4, 0.4, 0.001)
BULLET = model_of(trimesh.creation.icosphere(1, 0.005))
ROD = box(0.3, 0.02, 0.03)
FREE = {"gravity": (0, 0, 0)}


def surfaces_meet(dynamics):
    return dynamics.scene.intersect(dynamics.scene.broad_phase(), output="any").any.any()


def energy(dynamics, g=9.81):
    rigid = dynamics.rigid
    velocity, angular = (rows[rigid] for rows in dynamics.velocities())
    z, momentum = dynamics.bodies.position.numpy()[rigid, 2], dynamics.bodies.momentum.numpy()[rigid]
    return 0.5 * (angular * momentum).sum() + (dynamics.mass[rigid] * (0.5 * (velocity**2).sum(1) + g * z)).sum()


@pytest.mark.parametrize("speed", [3.0, 30.0, 300.0, 1000.0])
@pytest.mark.parametrize("stands", [True, False])
def test_a_bullet_is_stopped_by_a_sheet_of_1_mm_at_60_steps_a_second(device, speed, stands):
    def shoot(continuous):
        placed = (SHEET, (0, 0, 0, 0, 0, 0, 1), stands), (BULLET, (0.03, 0.02, 0.3, 0, 0, 0, 1))
        velocity = [(0, 0, 0), (0, 0, -speed)]
        dynamics = make(device, *placed, velocity=velocity, continuous=continuous, **FREE)
        start = energy(dynamics, 0)
        for _ in range(int(np.ceil(0.35 / speed * 60)) + 3):
            dynamics.step(1 / 60)
            assert energy(dynamics, 0) < (1 + 1e-9) * start
        return dynamics

    dynamics = shoot(True)
    sheet, bullet = dynamics.poses()
    normal = trimesh.transformations.quaternion_matrix([sheet[6], *sheet[3:6]])[:3, 2]
    assert normal @ (bullet - sheet)[:3] > 0.004 and not surfaces_meet(dynamics)
    if stands and speed > 3:
        assert shoot(False).poses()[1, 2] < -0.004


def test_no_random_throw_passes_a_thin_sheet(device):
    """Spinning rods at up to 1,000 units a second, from near and far: none is ever on the other side."""
    rng, scene, count = np.random.default_rng(5), ab.Scene(device), 40
    turns = rng.normal(size=(count, 4))
    velocity, spin = [], []
    for world in range(count):
        scene.add(SHEET, static=True, world=world)
        turn = turns[world] / np.linalg.norm(turns[world])
        place = np.array([*rng.uniform(-0.05, 0.05, 2), 0.17 + rng.exponential(0.3)])
        scene.add(ROD, pose=(*place, *turn), world=world)
        aim = np.array([*rng.uniform(-0.1, 0.1, 2), 0]) - place
        speed = 10 ** rng.uniform(0, 3)
        velocity += [(0, 0, 0), aim / np.linalg.norm(aim) * speed]
        spin += [(0, 0, 0), rng.normal(size=3) * 10 ** rng.uniform(-1, 2)]
    dynamics = ab.Dynamics(scene, velocity=velocity, angular_velocity=spin, continuous=True, **FREE)
    corners = ROD.mesh_at(ROD.lod_max)[0]
    side, hits = np.ones(count, bool), np.zeros(count, bool)
    for _ in range(24):
        dynamics.step(1 / 60)
        rotation, place = dynamics.scene.batch().objects.pool.rotation, dynamics.scene.batch().objects.pool.position
        world = np.einsum("nij,vj->nvi", rotation.numpy()[1::2], corners) + place.numpy()[1::2, None]
        over = np.abs(world[..., :2]).max((1, 2)) < 0.2
        hits |= dynamics.certified.fraction.numpy()[1::2] < 1
        side &= ~over | (world[..., 2].min(1) > 0.0005)
        assert not surfaces_meet(dynamics)
    assert side.all() and hits.sum() > count // 2


def test_a_heap_falls_and_comes_to_rest_without_more_energy(device):
    rng, placed = np.random.default_rng(3), []
    for k in range(8):
        turn = rng.normal(size=4)
        place = (1.2 * (k % 2), 1.2 * (k // 2 % 2), 1 + 1.3 * (k // 4))
        placed.append(([TORUS, BRICK][k % 2], (*place, *(turn / np.linalg.norm(turn)))))
    dynamics = on_ground(device, *placed, velocity=(0, 0, -15.0), continuous=True)
    start = before = energy(dynamics)
    for _ in range(150):
        dynamics.step(1 / 60)
        after = energy(dynamics)
        assert after < before + 1e-5 * start
        before = after
    assert dynamics.certified.pair_totals()["touching"] == 0 and not surfaces_meet(dynamics)
    assert dynamics.poses()[1:, 2].min() > 0.1 and before < 0.3 * start
    # A ring may still roll.
    assert np.sort(np.abs(dynamics.velocities()[0]).max(1))[-2] < 0.5


def test_bodies_that_overlap_at_first_are_not_stopped(device):
    """Where surfaces intersect already nothing is promised, and nothing freezes."""
    placed = (SHEET, (0, 0, 0, 0, 0, 0, 1), True), (BULLET, (0, 0, 0.001, 0, 0, 0, 1))
    dynamics = make(device, *placed, velocity=(0, 0, 1.0), continuous=True, **FREE)
    dynamics.step(1 / 60)
    assert dynamics.certified.pair_totals()["touching"] == 1
    assert dynamics.poses()[1, 2] > 0.01


def test_a_kinematic_object_stops_too_and_catches_up(device):
    bricks = [(BRICK, (0, 0, z, 0, 0, 0, 1)) for z in (0.3, 1.0)]
    dynamics = on_ground(device, *bricks, kinematic=[2], continuous=True)
    for z in (0.9, 0.6, 0.4):
        dynamics.step(1 / 60, [STILL, STILL, [0, 0, z, 0, 0, 0, 1]])
    assert 0.75 < dynamics.poses()[2, 2] < 0.82 and not surfaces_meet(dynamics)
    dynamics.step(1 / 60, [STILL, STILL, [0, 0, 1.5, 0, 0, 0, 1]])
    assert dynamics.poses()[2, 2] == 1.5


def test_steps_repeat_to_the_bit_and_in_a_captured_graph(device):
    def thrown(**options):
        placed = (TORUS, (0.1, 0, 0.6, *about((1, 0, 0), 0.5))), (BRICK, (0, 0.2, 1.5, *about((0, 1, 0), 0.3)))
        return on_ground(device, *placed, velocity=(0, 0, -20.0), continuous=True, **options)

    first, second = thrown(), thrown()
    run(first, 12, 1 / 60)
    if wp.get_device(device).is_cuda:
        second.step(1 / 60)
        replay = captured(second, 1 / 60)
        for _ in range(11):
            replay()
    else:
        for _ in range(12):
            second.launch(1 / 60)
    second.certified.result().check()
    np.testing.assert_array_equal(bits(first), bits(second))


def test_a_step_without_room_for_pairs_moves_nothing_and_says_so(device):
    models = [(BRICK, (1.1 * k, 0, 0, 0, 0, 0, 1)) for k in range(4)]
    options = {"velocity": [(30.0 * (1.5 - k), 0, 0) for k in range(4)], "continuous": True, **FREE}
    dynamics = make(device, *models, capacity=Buffers(pairs=1), **options)
    dynamics.certified.make_room(hits=0)
    before = dynamics.poses()
    dynamics.query.grow()
    dynamics._grow()
    dynamics.launch(1 / 60)
    np.testing.assert_array_equal(dynamics.poses(), before)
    refused(CapacityError, "Buffers\\(pairs=", dynamics.check)
    dynamics.finish(1 / 60)
    assert not np.array_equal(dynamics.poses(), before) and not surfaces_meet(dynamics)


def test_a_search_again_begins_at_the_goals(device):
    """Where the faces of boxes that touch outnumber the room, ways are found again, not those cut short cut again."""

    def shoot(**room):
        placed = [(BRICK, (0, 0, z, 0, 0, 0, 1)) for z in (0, 0.5)]
        placed += [(SHEET, (5, 0, 0, 0, 0, 0, 1), True), (BULLET, (5.03, 0.02, 0.3, 0, 0, 0, 1))]
        dynamics = make(device, *placed, velocity=[(0, 0, 0)] * 3 + [(0, 0, -30.0)], continuous=True, **FREE)
        dynamics.certified.make_room(**room)
        before = dynamics.certified.rooms.uncertain
        dynamics.step(1 / 60)
        assert dynamics.certified.pair_totals()["touching"] == 1
        return bits(dynamics), dynamics.certified.fraction.numpy(), dynamics.certified.rooms.uncertain > before

    with testing.regime(warps=True):
        expected, fraction, grown = shoot()
        found, fraction_again, grown_again = shoot(uncertain=1)
    assert grown_again and not grown and 0 < fraction[3] < 1
    np.testing.assert_array_equal(fraction_again, fraction)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("shared", ["nothing", "a floor", "a body"])
def test_what_stays_open_holds_its_world(device, shared):
    """A row of boxes fast behind one another, the first before a wall: too many to be cut one after the other.

    A body that is in both worlds holds them together, since it was proved clear of where the held ones would be.
    """
    scene, count = ab.Scene(device), len(continuous.ROUNDS) + 2
    for k in range(count):
        scene.add(BRICK, (1.01 * k, 0, 0, 0, 0, 0, 1), world=0)
    scene.add(BRICK, (-1.01, 0, 0, 0, 0, 0, 1), world=0, static=True)
    alone = scene.add(BRICK, (0, 9, 0, 0, 0, 0, 1), world=1)
    if shared != "nothing":
        scene.add(BRICK, (0, -9, 0, 0, 0, 0, 1), world=-1, static=shared == "a floor")
    dynamics = ab.Dynamics(scene, continuous=True, **FREE)
    dynamics.step(1 / 60)
    certified, before = dynamics.certified, dynamics.poses()
    goals = certified.goals.position.numpy()
    goals[dynamics.rigid, 0] -= 0.5
    certified.goals.position.assign(goals)
    certified.launch()
    certified.end((0, 0, 0))
    assert certified.pair_totals()["held"] > 0 == certified.pair_totals()["touching"]
    moved = certified.fraction.numpy() > 0
    np.testing.assert_array_equal((scene.poses != before).any(1), moved)
    assert not moved[:count].any() and moved[alone] == (shared != "a body") and not moved[alone + 1 :].any()


def test_what_is_undecided_waits_and_is_no_error(device):
    """Ways beyond float64: nothing is proved of them, so the bodies stay where they are."""
    placed = [(BRICK, (x, 0, 0, 0, 0, 0, 1)) for x in (0, 3)]
    with np.errstate(over="ignore"):
        dynamics = make(device, *placed, velocity=[(1e308, 0, 0), (-1e308, 0, 0)], continuous=True, **FREE)
    dynamics.step(1.0)
    dynamics.check()
    assert dynamics.certified.pair_totals()["undecided"] > 0
    np.testing.assert_array_equal(dynamics.poses()[:, 0], [0, 3])
    np.testing.assert_array_equal(dynamics.certified.fraction.numpy(), 0)


@pytest.mark.parametrize("speed", [0.0, 30.0, 1e3, 1e9])
def test_a_body_that_strikes_the_floor_stays_there(device, speed):
    """About a slop above it: the impulse that stopped it is not what it rests by, and may lift it little later."""
    placed = box(0.8, 0.6, 0.4), (0, 0, 0.5, *about((0, 0, 1), 0.3))
    dynamics = on_ground(device, placed, velocity=(0, 0, -speed), continuous=True)
    slop = dynamics.bodies.bounding_radius.numpy()[1] / 512
    for step in range(60):
        dynamics.step(1 / 60)
        assert dynamics.poses()[1, 2] < 0.2 + 2 * slop or (speed == 0 and step < 20)
    assert 0.2 + 0.4 * slop < dynamics.poses()[1, 2] < 0.2 + 1.6 * slop
    assert np.abs(dynamics.velocities()[0][1]).max() < 0.01 and dynamics.certified.fraction.numpy()[1] == 1


@pytest.mark.parametrize("speed", [1e6, 1e7, 1e9, 1e11, 1e14, 1e24])
def test_bodies_meet_at_any_speed_and_gain_no_energy(device, speed):
    """The first step ends where they meet, however small a part of it that is."""
    placed = (TORUS, (-1, 0, 0, *about((1, 0, 0), 0.5))), (BRICK, (1, 0.1, 0.05, *about((0, 1, 0), 0.3)))
    dynamics = make(device, *placed, velocity=[(speed, 0, 0), (-speed, 0, 0)], continuous=True, **FREE)
    before, slop = energy(dynamics, 0), dynamics.bodies.slop.numpy().min()
    dynamics.step(1 / 60)
    assert 0 < dynamics.scene.intersect([(0, 1)], output="distance").distance[0] < 0.02 + slop
    for _ in range(20):
        dynamics.step(1 / 60)
        after = energy(dynamics, 0)
        assert after <= (1 + 1e-12) * before and not surfaces_meet(dynamics)
        before = after


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
    far = ab.ContactQuery(dynamics.scene, [(0, 1)], gap=[reach]).run()
    tested = query.hits.triangle_tests.numpy()[0]
    assert 0 < near.count[0] <= tested < far.count[0] > 1.5 * near.count[0]
