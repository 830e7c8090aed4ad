"""Match indices of Newton's contacts: each contact of a pair that stays knows where it was in the buffer before."""

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers.bodies import at, contact_rows, newton_mesh

import warp_abtree as ab

newton = pytest.importorskip("newton")

COUNT = 4


@pytest.fixture(name="world")
def make_world(device):
    """Cubes side by side on a floor; returns what finds contacts, the state, and a function that moves the cubes."""
    builder, config = newton.ModelBuilder(), newton.ModelBuilder.ShapeConfig(gap=0.02)
    floor, cube = trimesh.creation.box((32, 32, 1)), trimesh.creation.box((1, 1, 1))
    builder.add_shape_mesh(-1, xform=at(z=-0.5), mesh=newton_mesh(floor), cfg=config)
    for k in range(COUNT):
        body = builder.add_body(xform=at(2.0 * k - 3.0, 0.2, 0.495, angle=0.1 * k))
        builder.add_shape_mesh(body, mesh=newton_mesh(cube), cfg=config)
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


def test_other_buffers_do_not_match(device, world):
    model, state, _ = world
    found = ab.NewtonContacts(model)
    first, second, plain = found.contacts(), found.contacts(), newton.Contacts(200, 0, device=device)
    for contacts in (first, second, first):
        found.collide(state, contacts)
        assert (rows(contacts)[2] == -1).all()
        assert contacts.rigid_contact_match_generation.numpy()[0] == -1
    found.collide(state, first)
    assert (rows(first)[2] >= 0).all() and len(rows(first)[2]) == 4 * COUNT
    found.collide(state, plain)
    found.collide(state, first)
    assert (rows(first)[2] == -1).all()
    for _ in range(12):  # new ones lie where those before lay
        found.collide(state, other := found.contacts())
        assert (rows(other)[2] == -1).all()
        del other


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


def test_without_memory_nothing_matches(device, world):
    model, state, _ = world
    found = ab.NewtonContacts(model, remember=False)
    assert found.contacts().rigid_contact_match_index is None
    contacts = newton.Contacts(200, 0, device=device, contact_matching=True)
    for _ in range(2):
        found.collide(state, contacts)
        assert (rows(contacts)[2] == -1).all()


def test_contacts_without_generations_do_not_match(world):
    """As those of Newton 1.6, which Isaac Lab 3.0 asks for."""
    model, state, _ = world
    found = ab.NewtonContacts(model)
    contacts = found.contacts()
    del contacts.rigid_contact_match_generation
    for _ in range(2):
        found.collide(state, contacts)
        assert len(rows(contacts)[0]) == 4 * COUNT and (rows(contacts)[2] == -1).all()


def test_contents_of_others_do_not_match(device, world):
    """Another finder writes the buffer, it is cleared, or the query is launched between two calls."""
    model, state, _ = world
    found, other = ab.NewtonContacts(model), ab.NewtonContacts(model)
    contacts = found.contacts()

    def launch_apart():
        poses = np.tile([0, 0, 0, 0, 0, 0, 1.0], (COUNT + 1, 1))
        poses[:, 0] = 100 * np.arange(COUNT + 1)
        found.scene.set_poses(poses)
        found.query.run()

    for between in (lambda: other.collide(state, contacts), contacts.clear, launch_apart):
        found.collide(state, contacts)
        between()
        found.collide(state, contacts)
        assert (rows(contacts)[2] == -1).all() and len(rows(contacts)[2]) == 4 * COUNT
        assert contacts.rigid_contact_match_generation.numpy()[0] == -1
        found.collide(state, contacts)
        assert (rows(contacts)[2] >= 0).all()


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
