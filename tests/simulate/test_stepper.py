"""The stepper as a program: repeatable to the bit however it runs, room that grows, frames, and what it refuses."""

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers.bodies import BALL, BRICK, CUBE, FLOOR, GROUND, NO_GRAVITY, TORUS, about, bits, box, make, on_ground, run

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.kernels.dynamics import graph_coloring

pytestmark = pytest.mark.slow

SHAPES = (BRICK, TORUS, BALL)


def heap(count=9, seed=0):
    """Bodies that fall onto each other."""
    rng = np.random.default_rng(seed)
    turns = rng.normal(size=(count, 4))
    places = [*rng.uniform(-0.4, 0.4, (count, 2)).T, 0.6 + 0.5 * np.arange(count)]
    return [
        (SHAPES[i % 3], (*place, *(turn / np.linalg.norm(turn))))
        for i, (place, turn) in enumerate(zip(np.transpose(places), turns))
    ]


OPTIONS = {"restitution": 0.3, "friction": 0.6}


def test_a_heap_is_the_same_when_repeated_and_however_it_is_relaxed(device):
    found = []
    for by_color in (False, False, True):
        with testing.regime(relax_by_color=by_color):
            dynamics = on_ground(device, *heap(), **OPTIONS)
        found.append(run(dynamics, 120))
        assert dynamics.query.manifolds.count.numpy().sum() > 8
    assert np.array_equal(found[0], found[1]) and np.array_equal(found[0], found[2])


def test_a_body_in_more_contacts_than_colors(device):
    """A plate with 36 cubes: the pairs beyond the number of colors are relaxed in turn."""
    cube = box(0.3, 0.3, 0.3)
    cubes = [(cube, (0.6 * x - 1.5, 0.6 * y - 1.5, 0.2495 + 0.1, 0, 0, 0, 1)) for x in range(6) for y in range(6)]
    plate = box(4, 4, 0.2)
    found = []
    for by_color in (False, True):
        with testing.regime(relax_by_color=by_color):
            dynamics = on_ground(device, (plate, (0, 0, 0.0995, 0, 0, 0, 1)), *cubes, sleep_speed=0)
        run(dynamics, 10)
        used = dynamics._pair_color.numpy()
        assert (used == int(graph_coloring.COLOR_COUNT)).sum() == 36 + 1 - int(graph_coloring.COLOR_COUNT)
        pairs = dynamics.query.pairs.numpy()
        for c in range(int(graph_coloring.COLOR_COUNT)):
            movers = pairs[used == c].ravel()
            movers = movers[movers > 0]
            assert len(set(movers.tolist())) == len(movers)
        found.append(bits(dynamics))
    assert np.array_equal(*found)
    assert np.abs(found[0][:, 7:]).max() < 0.02


def test_worlds_alone_and_together_are_the_same(device):
    heaps = [heap(6, seed) for seed in range(3)]
    together = ab.Scene(device)
    together.add(GROUND, pose=FLOOR, static=True, world=-1)
    for bodies in zip(*heaps):
        for world, (model, pose) in enumerate(bodies):
            together.add(model, pose=pose, world=world)
    found = run(ab.Dynamics(together, **OPTIONS), 100)
    for world, bodies in enumerate(heaps):
        alone = run(on_ground(device, *bodies, **OPTIONS), 100)
        assert np.array_equal(found[1 + world :: 3], alone[1:]), world


def test_launches_of_a_graph_do_what_steps_do(device):
    stepped = on_ground(device, *heap(), **OPTIONS)
    launched = on_ground(device, *heap(), **OPTIONS, capacity=ab.Buffers(4096, pairs=256))
    run(stepped, 1), run(launched, 1)
    with wp.ScopedCapture(launched.device) as capture:
        launched.launch(1 / 120)
    for _ in range(60):
        stepped.step(1 / 120)
        wp.capture_launch(capture.graph)
        launched.check()
    assert np.array_equal(bits(stepped), bits(launched))


def test_room_grows_and_its_lack_is_told(device):
    tight = on_ground(device, *heap(), **OPTIONS, capacity=ab.Buffers(1, pairs=1))
    ample = on_ground(device, *heap(), **OPTIONS, capacity=ab.Buffers(4096, pairs=256))
    assert np.array_equal(run(tight, 80), run(ample, 80))
    short = on_ground(device, *heap(), **OPTIONS, capacity=ab.Buffers(4096, pairs=1))
    with pytest.raises(ab.CapacityError, match="pairs="):
        for _ in range(80):
            short.launch(1 / 120)
            short.check()


def test_a_frame_steps_and_reports(device):
    stepped = on_ground(device, *heap(), **OPTIONS)
    framed = on_ground(device, *heap(), **OPTIONS)
    frame = ab.Frame(framed.scene, motion=framed.motion(), time_step=1 / 120)
    for _ in range(60):
        stepped.step(1 / 120)
        result = frame.step()
        assert result.pairs.tolist() == stepped.query.result().pairs.tolist()
        assert frame.history[-1].hits == result.count.sum()
    assert np.array_equal(bits(stepped), bits(framed))
    assert max(row.intersecting for row in frame.history) > 4


def test_a_frame_drives_kinematic_objects(device):
    scene = ab.Scene(device)
    scene.add(GROUND, pose=FLOOR)
    scene.add(CUBE, pose=(0, 0, 0.4985, 0, 0, 0, 1))
    dynamics = ab.Dynamics(scene, kinematic=[True, False])
    path = ab.Kinematic(position=[FLOOR[:3], (9, 9, 9)], velocity=[(0.3, 0, 0), (0, 0, 0)])
    ab.Frame(scene, motion=dynamics.motion(path), time_step=0.01).run(50)
    np.testing.assert_allclose(dynamics.poses()[0], [0.15, 0, -0.5, 0, 0, 0, 1], atol=1e-15)
    assert dynamics.velocities()[0][1, 0] == pytest.approx(0.3, abs=0.01)


def test_poses_that_a_user_sets(device):
    dynamics = on_ground(device, (BRICK, (0, 0, 3, 0, 0, 0, 1)))
    run(dynamics, 10)
    poses = dynamics.poses()
    poses[1, :3], poses[1, 3:] = [1, 2, 5], about((1, 1, 0), 1.0)
    dynamics.scene.set_poses(poses)
    dynamics.read_poses()
    dynamics.set_velocities((0, 0, 0), (0, 0, 1))
    np.testing.assert_allclose(dynamics.velocities()[1][1], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(dynamics.poses(), poses, atol=1e-12)
    run(dynamics, 1)
    np.testing.assert_allclose(dynamics.poses()[1, :2], [1, 2], atol=1e-12)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"density": 0}, "density: 0.0 of object 0 is not above 0"),
        ({"density": [1, np.nan]}, "density: nan of object 1"),
        ({"restitution": 1.1}, "restitution: 1.1 .* at most 1"),
        ({"friction": -0.1}, "friction: -0.1"),
        ({"gravity": (0, 0, np.inf)}, "gravity"),
        ({"kinematic": [5]}, "kinematic"),
        ({"kinematic": [True]}, "kinematic"),
        ({"velocity": (np.nan, 0, 0)}, "velocity: a number is not finite"),
        ({"angular_velocity": (1, 2)}, "angular_velocity: shape"),
        ({"iterations": 0}, "iterations"),
        ({"slop": -1}, "slop"),
        ({"sleep_time": 0}, "sleep_time"),
        ({"capacity": 0}, "capacity"),
    ],
)
def test_bad_numbers_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        on_ground("cpu", (CUBE, (0, 0, 2, 0, 0, 0, 1)), **options)


def test_bad_use_is_refused():
    dynamics = on_ground("cpu", (CUBE, (0, 0, 2, 0, 0, 0, 1)))
    before = bits(dynamics)
    for dt in (0, -1, np.nan, np.inf):
        with pytest.raises(ValueError, match="dt"):
            dynamics.step(dt)
    with pytest.raises(ValueError, match="targets"):
        dynamics.step(0.01, np.zeros((3, 7)))
    with pytest.raises(ValueError, match="targets: 1 given for 2"):
        dynamics.step(0.01, [[0, 0, 0, 0, 0, 0, 1]])
    assert np.array_equal(bits(dynamics), before)
    sheet = ab.Model.from_arrays([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]], [[0, 1, 2], [0, 2, 3]])
    with pytest.raises(ValueError, match="flat"):
        on_ground("cpu", (sheet, (0, 0, 2, 0, 0, 0, 1)))
    make("cpu", (sheet, (0, 0, 2, 0, 0, 0, 1), True), (CUBE, (0, 0, 5, 0, 0, 0, 1))).step(0.01)
    dynamics.scene.add(CUBE)
    with pytest.raises(RuntimeError, match="objects were added"):
        dynamics.step(0.01)


def test_one_body_alone_and_none_at_all(device):
    alone = make(device, (TORUS, (0, 0, 0, 0, 0, 0, 1)), velocity=(1, 0, 0), **NO_GRAVITY)
    np.testing.assert_allclose(run(alone, 10, 0.1)[0, :3], [1, 0, 0], atol=1e-13)
    still = make(device, (GROUND, FLOOR, True), (GROUND, FLOOR, True))
    assert np.isinf(still.mass).all() and still.energy() == 0
    assert np.array_equal(run(still, 3)[:, :7], np.tile(FLOOR, (2, 1)))


def test_an_off_centre_mesh_turns_about_its_centre_of_mass(device):
    mesh = trimesh.creation.box((1, 0.5, 0.2)).apply_translation((5, 1, -2))
    model = ab.Model.from_arrays(mesh.vertices, mesh.faces, base_faces=4)
    dynamics = make(device, (model, (-5, -1, 2, 0, 0, 0, 1)), angular_velocity=(0, 0, np.pi), **NO_GRAVITY)
    run(dynamics, 50, 0.01)
    r = about((0, 0, 1), np.pi / 2)
    pose = dynamics.poses()[0]
    np.testing.assert_allclose(pose[3:], r, atol=1e-9)
    np.testing.assert_allclose(pose[:3], [1, -5, 2], atol=1e-8)
