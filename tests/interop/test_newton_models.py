"""Newton's models in `NewtonContacts`: pairs, particles, worlds, order, match indices; nuts on bolts."""

import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers.bodies import PairContacts, at, collided, contact_rows, newton_mesh, touching_shapes

import warp_abtree as ab

newton = pytest.importorskip("newton")

SCENES = Path(__file__).resolve().parents[2] / "scenes" / "interop"

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
        np.testing.assert_equal(contact_rows(contacts, *COLUMNS), again)


def test_a_launch_reads_the_poses_of_its_state(device, monkeypatch):
    """The rows are those of a `collide` at these poses; before the first call objects stand where the model's are."""
    monkeypatch.setattr(newton, "CollisionPipeline", PairContacts)
    model = ring_model(device, 2)
    found = ab.NewtonContacts(model)
    bodies, shapes = model.shape_body.numpy()[found.shapes], model.shape_transform.numpy()[found.shapes]
    for pose, body, shape in zip(found.scene.poses, bodies, shapes):
        expected = (
            wp.transform(*shape) if body < 0 else wp.transform(*model.body_q.numpy()[body]) * wp.transform(*shape)
        )
        np.testing.assert_allclose(pose, expected, atol=1e-6)
    state, there, contacts = model.state(), model.state(), found.contacts()
    moved = there.body_q.numpy().copy()
    moved[-1, :2] += np.float32(0.03)
    there.body_q.assign(moved)
    found.collide(state, contacts)
    at_first = contact_rows(contacts, *COLUMNS)
    found.query.forget()
    found.launch(there, contacts)
    rows = contact_rows(contacts, *COLUMNS)
    _, other, expected = collided(model)
    other.query.forget()
    other.collide(there, expected)
    np.testing.assert_equal(rows, contact_rows(expected, *COLUMNS))
    assert len(rows[0]) != len(at_first[0]) or any((a != b).any() for a, b in zip(rows, at_first))


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
        np.testing.assert_equal(rows, found[0])


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
    return SimpleNamespace(**runpy.run_path(str(SCENES / "newton_nut_and_bolt.py")))


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
def test_nuts_follow_the_pitch(scene, device):
    pytest.importorskip("mujoco_warp")
    nuts = make_nuts(scene, "mujoco", device, 1)
    nuts.run(1.5)
    assert (nuts.turned < -1).all()
    np.testing.assert_allclose(nuts.travel(), 1, atol=0.05)


COUNT = 4


@pytest.fixture(name="world")
def make_world(device):
    """Cubes side by side on a floor; returns what finds contacts, the state, and a function that moves the cubes."""
    builder, config = newton.ModelBuilder(), newton.ModelBuilder.ShapeConfig(gap=0.02)
    builder.add_shape_mesh(-1, xform=at(z=-0.5), mesh=FLOOR, cfg=config)
    for k in range(COUNT):
        body = builder.add_body(xform=at(2.0 * k - 3.0, 0.2, 0.495, angle=0.1 * k))
        builder.add_shape_mesh(body, mesh=CUBE, cfg=config)
    model = builder.finalize(device=device)
    state = model.state()
    start = state.body_q.numpy().copy()

    def move(shift):
        poses = start.copy()
        poses[:, :3] += shift
        state.body_q.assign(poses)

    return model, state, move


def rows(contacts):
    """Return shapes (n, 2), first points and match indices of contacts."""
    first, second, point, index = contact_rows(contacts, "shape0", "shape1", "point0", "match_index")
    return np.stack([first, second], 1), point, index


def check_matches(now, before):
    """Check that matched contacts are of the same shapes and nearly in the same place, each matched once."""
    shapes, point, index = now
    kept = index >= 0
    np.testing.assert_array_equal(shapes[kept], before[0][index[kept]])
    assert np.abs(point[kept] - before[1][index[kept]]).max(initial=0) < 0.02
    assert len(np.unique(index[kept])) == kept.sum()
    return kept


def test_contacts_that_stay_are_matched(device, world):
    """As cubes rest, slide, lift off and come back; pairs shift their places among the others."""
    model, state, move = world
    found = ab.NewtonContacts(model)
    contacts = found.contacts()
    rng, before, generation, seen = np.random.default_rng(0), None, None, set()
    lifted_before = np.zeros(COUNT, bool)
    for step in range(25):
        lifted = rng.random(COUNT) < 0.3
        shift = np.zeros((COUNT, 3))
        shift[:, 0] = 0.004 * np.sin(step) * (np.arange(COUNT) % 2)  # half of them slide, by more than rests
        shift[lifted, 2] = 1.0
        move(shift)
        found.collide(state, contacts)
        now = rows(contacts)
        match_generation = int(contacts.rigid_contact_match_generation.numpy()[0])
        if before is None:
            assert (now[2] == -1).all() and match_generation == -1
        else:
            assert match_generation == generation
            kept = check_matches(now, before)
            cube = now[0].max(1) - 1
            # Those of cubes that have come back are new; the corners of the others are those that they were.
            np.testing.assert_array_equal(kept, ~lifted_before[cube])
            seen |= set(zip(now[2][kept] != np.flatnonzero(kept), found.query.memory.place.numpy()[cube[kept]] >= 0))
        before, lifted_before, generation = now, lifted, int(contacts.contact_generation.numpy()[0])
    assert {shifted for shifted, _ in seen} == {False, True}


def test_a_graph_matches(device, world):
    model, state, move = world
    found = ab.NewtonContacts(model)
    contacts = found.contacts()
    found.collide(state, contacts)
    with wp.ScopedCapture(wp.get_device(device)) as capture:
        found.collide(state, contacts)  # launches only, where a graph is captured
    for step in range(4):
        before = rows(contacts)
        move([[0.003 * step, 0, 0]])
        wp.capture_launch(capture.graph)
        assert check_matches(rows(contacts), before).all()


@pytest.mark.parametrize("remember", [True, False])
def test_without_memory_or_generations_nothing_matches(device, world, remember):
    """Contacts of Newton 1.6, which Isaac Lab 3.0 asks for, have no generations."""
    model, state, _ = world
    found = ab.NewtonContacts(model, remember=remember)
    contacts = newton.Contacts(200, 0, device=device, contact_matching=True)
    if remember:
        del contacts.rigid_contact_match_generation
    else:
        assert found.contacts().rigid_contact_match_index is None
    for _ in range(2):
        found.collide(state, contacts)
        assert len(rows(contacts)[0]) > 0 and (rows(contacts)[2] == -1).all()


def test_contents_of_others_do_not_match(device, world):
    """Another finder writes the buffer, it is cleared, or others are written or the query is launched in between."""
    model, state, _ = world
    found, other = ab.NewtonContacts(model), ab.NewtonContacts(model)
    contacts, second, plain = found.contacts(), found.contacts(), newton.Contacts(200, 0, device=device)

    def launch_apart():
        poses = np.tile([0, 0, 0, 0, 0, 0, 1.0], (COUNT + 1, 1))
        poses[:, 0] = 100 * np.arange(COUNT + 1)
        found.scene.set_poses(poses)
        found.query.run()

    actions = [lambda: other.collide(state, contacts), contacts.clear, launch_apart]
    actions += [lambda each=each: found.collide(state, each) for each in (second, plain)]
    for between in actions:
        found.collide(state, contacts)
        between()
        found.collide(state, contacts)
        assert (rows(contacts)[2] == -1).all() and len(rows(contacts)[2]) == 4 * COUNT
        assert contacts.rigid_contact_match_generation.numpy()[0] == -1
        found.collide(state, contacts)
        assert (rows(contacts)[2] >= 0).all()
    for _ in range(12):  # new ones lie where those before lay
        found.collide(state, new := found.contacts())
        assert (rows(new)[2] == -1).all()
        del new


def test_room_that_grows_keeps_matches(device, world):
    """Two cubes rest while others arrive that there is no room for yet."""
    model, state, move = world
    lifted = np.zeros((COUNT, 3))
    lifted[2:, 2] = np.arange(2, COUNT) * 5
    move(lifted)
    found = ab.NewtonContacts(model, capacity=ab.Buffers(pairs=2))
    contacts = newton.Contacts(200, 0, device=device, contact_matching=True)
    found.collide(state, contacts)
    before, room = rows(contacts), len(found.query.pairs)
    move(0 * lifted)
    found.collide(state, contacts)
    assert len(found.query.pairs) > room
    now = rows(contacts)
    np.testing.assert_array_equal(check_matches(now, before), now[0].max(1) <= 2)
