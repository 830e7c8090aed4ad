"""Newton's models in `NewtonContacts`: pairs, materials, particles, worlds, captures and order; nuts on bolts."""

import importlib.util
import pathlib

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers.bodies import PairContacts, at, collided, contact_rows, newton_mesh, settle, touching_shapes

import warp_abtree as ab

newton = pytest.importorskip("newton")


CUBE, FLOOR = newton_mesh(trimesh.creation.box((1, 1, 1))), newton_mesh(trimesh.creation.box((8, 8, 1)))
RING = newton_mesh(trimesh.creation.torus(0.8, 0.25, 24, 12))
COLUMNS = ("shape0", "shape1", "point0", "point1", "offset0", "normal", "margin0")
NEAR = newton.ModelBuilder.ShapeConfig(gap=0.01)


def test_pairs_are_those_of_newton(device):
    rng = np.random.default_rng(1)
    builder, shapes = newton.ModelBuilder(), []
    for _ in range(3):
        world, last = newton.ModelBuilder(), None
        for _ in range(5):
            body = -1 if rng.random() < 0.2 else world.add_link(xform=at())
            for _ in range(rng.integers(1, 3)):
                config = newton.ModelBuilder.ShapeConfig(collision_group=int(rng.choice([-2, -1, 0, 1, 2])))
                config.has_shape_collision = bool(rng.random() < 0.9)
                add = world.add_shape_mesh if rng.random() < 0.6 else world.add_shape_sphere
                add(body, **({"mesh": CUBE} if add == world.add_shape_mesh else {"radius": 0.5}), cfg=config)
            if body >= 0:
                joint = world.add_joint_free(body) if last is None else world.add_joint_fixed(last, body)
                shapes.append(joint)
                last = body
        world.add_articulation(list(range(world.joint_count)))
        for _ in range(4):
            a, b = rng.choice(world.shape_count, 2, replace=False).tolist()
            world.add_shape_collision_filter_pair(a, b)
        builder.add_world(world)
    builder.add_ground_plane()
    builder.add_shape_mesh(-1, mesh=FLOOR)
    model = builder.finalize(device=device)
    found = ab.NewtonContacts(model)
    found.contacts()
    ours = {tuple(sorted(pair)) for pair in found.shapes[found.scene.broad_phase()].tolist()}
    others = {tuple(pair) for pair in found.others.shape_pairs_filtered.numpy().tolist()}
    expected = {tuple(sorted(pair)) for pair in model.shape_contact_pairs.numpy().tolist()}
    assert len(expected) > 50 and len(ours) > 10 and len(others) > 10
    assert not ours & others
    assert ours | others == expected


def test_other_pairs_of_one_plane_are_as_many_as_bodies():
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    for _ in range(300):
        builder.add_shape_mesh(builder.add_body(), mesh=CUBE)
    found = ab.NewtonContacts(builder.finalize(device="cpu"))
    found.contacts(100)
    assert found.others.shape_pairs_filtered.numpy().tolist() == [[0, k] for k in range(1, 301)]


@pytest.mark.slow
@pytest.mark.parametrize("mu, slides", [(0.2, True), (0.8, False)])
def test_friction_is_that_of_the_shapes(device, mu, slides):
    """A cube on a slope of 0.4 rad, whose tangent is 0.42."""
    slope = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), 0.4)
    config = newton.ModelBuilder.ShapeConfig(gap=0.01, mu=mu)
    builder = newton.ModelBuilder()
    below, above = (wp.transform(wp.quat_rotate(slope, wp.vec3(0, 0, z)), slope) for z in (-0.5, 0.5))
    builder.add_shape_mesh(-1, xform=below, mesh=FLOOR, cfg=config)
    builder.add_shape_mesh(builder.add_body(xform=above), mesh=CUBE, cfg=config)
    model = builder.finalize(device=device)
    poses, _ = settle(model, ab.NewtonContacts(model), 120, iterations=8)
    way = np.linalg.norm((poses - model.state().body_q.numpy())[0, :3])
    # By friction alone it would slide 9.81 (sin - mu cos) t^2 / 2 = 0.25 m.
    assert 0.15 < way < 0.35 if slides else way < 0.03


@pytest.mark.slow  # Newton compiles much for it
def test_particles_are_newtons(device):
    builder = newton.ModelBuilder()
    builder.add_shape_mesh(-1, xform=at(z=-0.5), mesh=FLOOR, cfg=NEAR)
    builder.add_shape_mesh(builder.add_body(xform=at(z=0.5)), mesh=CUBE, cfg=NEAR)
    builder.add_particle((3.0, 0.0, 0.05), (0.0, 0.0, 0.0), 1.0, radius=0.1)
    _, _, contacts = collided(builder.finalize(device=device))
    assert contacts.soft_contact_count.numpy()[0] == 1
    assert touching_shapes(contacts) == {(0, 1)} and contacts.rigid_contact_count.numpy()[0] == 4


def test_worlds_have_meshes_of_their_own(device):
    """The same shape is a cube in one world and a ring in the next: their contacts are at other heights."""
    builder = newton.ModelBuilder()
    for mesh, half in ((CUBE, 0.5), (RING, 0.25)):
        world = newton.ModelBuilder()
        world.add_shape_mesh(-1, xform=at(z=-0.5), mesh=FLOOR, cfg=NEAR)
        world.add_shape_mesh(world.add_body(xform=at(z=half + 0.005)), mesh=mesh, cfg=NEAR)
        builder.add_world(world)
    _, _, contacts = collided(builder.finalize(device=device))
    assert touching_shapes(contacts) == {(0, 1), (2, 3)}
    second, points = contact_rows(contacts, "shape1", "point1")
    np.testing.assert_allclose(points[second == 1, 2], -0.5, atol=0.004)
    np.testing.assert_allclose(points[second == 3, 2], -0.25, atol=0.004)
    np.testing.assert_allclose(np.linalg.norm(points[second == 3, :2], axis=1), 0.8, atol=0.02)


def ring_model(device, count, others=True):
    builder = newton.ModelBuilder()
    if others:
        builder.add_ground_plane()
        builder.add_shape_sphere(builder.add_body(xform=at(6.0, z=0.295)), radius=0.3, cfg=NEAR)
    builder.add_shape_mesh(-1, xform=at(z=0.5), mesh=FLOOR, cfg=NEAR)
    for k in range(count):
        builder.add_shape_mesh(builder.add_body(xform=at(z=1.255 + 0.505 * k)), mesh=RING, cfg=NEAR)
    return builder.finalize(device=device)


def test_contacts_keep_their_order_as_bodies_move(device, monkeypatch):
    """Row by row the same pair and nearly the same point, so that what a solver keeps of a row still fits."""
    monkeypatch.setattr(newton, "CollisionPipeline", PairContacts)
    model = ring_model(device, 3)
    state, found, contacts = collided(model)
    before = contact_rows(contacts, *COLUMNS)
    poses = state.body_q.numpy().copy()
    for _ in range(4):
        poses[:, :3] += np.float32(1e-4)
        state.body_q.assign(poses)
        found.collide(state, contacts)
        rows = contact_rows(contacts, *COLUMNS)
        assert rows[0].tolist() == before[0].tolist() and rows[1].tolist() == before[1].tolist()
        np.testing.assert_allclose(rows[3], before[3], atol=0.01)
        again = contact_rows(contacts, *COLUMNS)
        found.collide(state, contacts)
        for one, two in zip(again, contact_rows(contacts, *COLUMNS)):
            np.testing.assert_array_equal(one, two)


@pytest.mark.filterwarnings("ignore:Model.request_contact_attributes")  # deprecated, but what Isaac Lab 3.0 calls
@pytest.mark.parametrize("others", [False, True])
def test_a_loop_as_isaac_labs(device, monkeypatch, others):
    """It takes the pipeline's contacts, with what sensors read, or larger ones, for states that take turns."""
    monkeypatch.setattr(newton, "CollisionPipeline", PairContacts)
    model = ring_model(device, 2, others)
    model.request_contact_attributes("force")
    pipeline, states, found = ab.NewtonContacts(model), (model.state(), model.state()), []
    contacts = pipeline.contacts()
    assert others or contacts.force is not None  # with others their pipeline makes the contacts
    for room in (contacts, newton.Contacts(2 * contacts.rigid_contact_max, 0, device=device)):
        for state in states:
            pipeline.collide(state, room)
            found.append(contact_rows(room, *COLUMNS))
    assert len(found[0][0]) >= 8
    for rows in found[1:]:
        for one, two in zip(rows, found[0], strict=True):
            np.testing.assert_array_equal(one, two)


@pytest.mark.slow
def test_collide_in_a_capture_launches_only(device):
    """A graph of collide and a solver's step has the bits of doing so step by step."""
    model = ring_model(device, 2)
    ends = []
    for captured in (False, True):
        found, state, after = ab.NewtonContacts(model), model.state(), model.state()
        solver, control, contacts = newton.solvers.SolverXPBD(model), model.control(), found.contacts()

        def step(found=found, solver=solver, state=state, after=after, control=control, contacts=contacts):
            found.collide(state, contacts)
            state.clear_forces()
            solver.step(state, after, control, contacts, 1 / 240)
            state.assign(after)

        step()
        if captured:
            with wp.ScopedCapture(device) as capture:
                step()
        for _ in range(20):
            wp.capture_launch(capture.graph) if captured else step()
        found.check(contacts)
        ends.append(state.body_q.numpy().copy())
    assert np.abs(ends[0][:, 2] - model.body_q.numpy()[:, 2]).max() > 1e-4
    np.testing.assert_array_equal(*ends)


@pytest.fixture(scope="module")
def scene():
    path = pathlib.Path(__file__).parents[2] / "scenes/interop/newton_nut_and_bolt.py"
    spec = importlib.util.spec_from_file_location("newton_nut_and_bolt", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def make_nuts(scene, solver, device, count, hammer=0.0, tolerance=None):
    parts = scene.make_bolt(16, 6), scene.make_nut(16, 3)
    assert all(trimesh.Trimesh(*part).is_volume and trimesh.Trimesh(*part).volume > 0 for part in parts)
    bolt, nut = (ab.Model.from_arrays(*part) for part in parts)
    height = scene.find_height(bolt, nut, scene.PITCH, 2 * scene.PITCH)
    model = scene.build_model(bolt, nut, height, scene.PITCH, count, device)
    return scene.Nuts(model, bolt, nut, solver, scene.PITCH, hammer, tolerance=tolerance)


@pytest.mark.parametrize("tolerance", [None, 4e-5])
def test_flanks_hold_a_nut_from_either_side(scene, device, tolerance):
    """One that is pushed along its bolt, by a tenth of the pitch: also at LODs, where a tolerance is given."""
    nuts = make_nuts(scene, "xpbd", device, 2, tolerance=tolerance)
    coarse = nuts.found.scene.lods < [model.lod_max for model in nuts.found.scene.models * 2]
    assert coarse.all() if tolerance else not coarse.any()
    start = nuts.state.body_q.numpy().copy()
    for way in (-0.1 * scene.PITCH, 0.1 * scene.PITCH):
        nuts.state.body_q.assign(start + np.float32([0, 0, way, 0, 0, 0, 0]))
        nuts.found.collide(nuts.state, nuts.contacts)
        assert touching_shapes(nuts.contacts) == {(0, 1), (2, 3)}
        points = nuts.found.query.result().points
        assert 0 < points["depth"].max() < abs(way) and len(points["depth"]) > 20
        assert (points["normal"][:, 2] * np.sign(way) < 0.01).all(), "from the bolt, against the push"


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [None, 4e-5])
def test_hammered_nuts_stay_on_their_threads(scene, device, tolerance):
    """At most the thread's play off it, while a blow alone would carry a nut through most of a pitch in a step."""
    nuts = make_nuts(scene, "xpbd", device, 2, 0.5, tolerance)
    nuts.run(0.3)
    assert (nuts.turned < -0.1).all() and abs(np.subtract(*nuts.turned)) > 0.001, "each has a speed of its own"
    assert (nuts.lag < scene.PITCH / 8).all(), nuts.lag


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["xpbd", "mujoco"])
def test_nuts_follow_the_pitch(scene, device, solver):
    if solver == "mujoco":
        pytest.importorskip("mujoco_warp")
    nuts = make_nuts(scene, solver, device, 1)
    nuts.run(1.5)
    assert (nuts.turned < -1).all()
    np.testing.assert_allclose(nuts.travel(), 1, atol=0.05)
