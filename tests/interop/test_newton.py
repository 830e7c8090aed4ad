"""Contacts for Newton: geometry against closed forms, bodies at rest, mirrored shapes, and settings that change."""

import itertools

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers import refused
from helpers.bodies import PairContacts, at, collided, contact_rows, newton_mesh, settle, touching_shapes
from helpers.samples import STILL
from oracles.motion import posed

import warp_abtree as ab
from warp_abtree.interop import newton as adapter

newton = pytest.importorskip("newton")

CUBE = trimesh.creation.box((1, 1, 1))
FLOOR = trimesh.creation.box((8, 8, 1))
Config = newton.ModelBuilder.ShapeConfig


@pytest.fixture(autouse=True)
def pair_contacts(request, monkeypatch):
    """Give other pairs a contact each but where the test is slow: Newton's own pipeline takes 13 s to compile."""
    if not request.node.get_closest_marker("slow"):
        monkeypatch.setattr(newton, "CollisionPipeline", PairContacts)


def world_points(model, state, contacts):
    """Surface points of both shapes in the world, by Newton's convention for points and offsets of bodies."""
    body, body_q = model.shape_body.numpy(), state.body_q.numpy()
    points = []
    for side in (0, 1):
        shapes, point, offset = contact_rows(contacts, *(f"{name}{side}" for name in ("shape", "point", "offset")))
        poses = [STILL if body[s] < 0 else body_q[body[s]] for s in shapes]
        points.append(np.array([posed(x, pose) for pose, x in zip(poses, point + offset)]).reshape(-1, 3))
    return points, *contact_rows(contacts, "normal")


def test_a_cube_on_a_floor_has_its_corners(device):
    builder = newton.ModelBuilder()
    config = Config(margin=0.02)
    builder.add_shape_mesh(-1, xform=at(z=-0.5), mesh=newton_mesh(FLOOR), cfg=config)
    body = builder.add_body(xform=at(0.3, 0.2, angle=0.5))
    # The shape stands off its body, and its mesh is scaled.
    builder.add_shape_mesh(body, xform=at(z=0.49), mesh=newton_mesh(CUBE), scale=wp.vec3(1.0, 0.8, 1.0))
    model = builder.finalize(device=device)
    state, found, contacts = collided(model)
    found.collide(state, contacts)
    (first, second), normals = world_points(model, state, contacts)
    assert len(normals) == 4
    np.testing.assert_allclose(normals, np.tile([0, 0, 1], (4, 1)), atol=1e-6)
    for side in (0, 1):
        assert set(getattr(contacts, f"rigid_contact_shape{side}").numpy()[:4]) == {side}
    # The floor's margin thickens it, as in Newton.
    np.testing.assert_allclose((second - first) @ [0, 0, 1], -0.03, atol=1e-6)
    flat = np.array([(x, y, 0) for x in (-0.5, 0.5) for y in (-0.4, 0.4)])
    corners = posed(flat, np.array(at(0.3, 0.2, angle=0.5)))
    for corner in corners:
        assert np.abs(0.5 * (first + second) - corner)[:, :2].max(1).min() < 1e-6
    assert (contacts.rigid_contact_count.numpy() == 4).all()
    assert np.unique(contacts.rigid_contact_margin0.numpy()[:4]) == pytest.approx(0.02)
    assert (contacts.rigid_contact_margin1.numpy()[:4] == model.shape_margin.numpy()[1]).all()


def test_what_is_inside_a_solid_is_pushed_out(device):
    """A cube wholly inside a floor crosses no face of it; as a solid the floor knows how deep it is."""
    builder = newton.ModelBuilder()
    builder.add_shape_mesh(-1, mesh=newton_mesh(FLOOR))
    body = builder.add_body(xform=at(0.3, 0.2, 0.3, angle=0.4))
    builder.add_shape_mesh(body, mesh=newton_mesh(CUBE), scale=wp.vec3(0.2, 0.2, 0.2))
    builder.add_shape_sphere(body, radius=0.01)
    model = builder.finalize(device=device)
    model.shape_gap.fill_(0.0)
    depths = {}
    for solids in (False, [0], True):
        state, _, contacts = collided(model, solids=solids)
        (first, second), normals = world_points(model, state, contacts)
        of_cube = contacts.rigid_contact_shape1.numpy()[: len(normals)] == 1
        depths[str(solids)] = sorted(((first - second) * normals).sum(1)[of_cube])
        assert (normals[of_cube] @ [0, 0, 1] > 1 - 1e-6).all()
    assert depths["False"] == [] and depths["[0]"] == depths["True"]
    np.testing.assert_allclose(depths["True"][-1], 0.3, atol=1e-6)


def test_models_refused(device):
    builder = newton.ModelBuilder()
    builder.add_shape_mesh(-1, xform=at(z=-0.5), mesh=newton_mesh(FLOOR))
    builder.add_shape_sphere(builder.add_body())
    refused(ValueError, "1 shapes that are meshes", ab.NewtonContacts, builder.finalize(device=device))
    builder.add_shape_mesh(builder.add_body(xform=at(z=0.49)), mesh=newton_mesh(CUBE))
    model = builder.finalize(device=device)
    found = ab.NewtonContacts(model)
    refused(ab.CapacityError, r"\d rigid contacts", found.collide, model.state(), found.contacts(2))
    open_cube = newton_mesh(trimesh.Trimesh(CUBE.vertices, CUBE.faces[:-1], process=False))
    builder.add_shape_mesh(builder.add_body(), mesh=open_cube)
    model = builder.finalize(device=device)
    ab.NewtonContacts(model, solids=[2])
    refused(ab.MeshError, "not closed", ab.NewtonContacts, model, solids=True)
    for solids in ([True, False, True, False], np.array([True]), [0.5], "all"):  # a mask would be shapes 0 and 1
        said = r"^solids: .* is neither a bool nor indices of shapes$"
        refused(ValueError, said, ab.NewtonContacts, model, solids=solids)
    refused(ValueError, "shape 1 is no mesh", ab.NewtonContacts, model, solids=[0, 1])
    assert not any(ab.NewtonContacts(model, solids=[]).scene.object_solid)
    open_cube.enable_surface_velocity = True
    refused(ValueError, "surface of shape 3 moves", ab.NewtonContacts, builder.finalize(device=device))


@pytest.mark.parametrize("gap, margin, count", [(0.03, 0.0, 4), (0.02, 0.0, 0), (0.02, 0.01, 4), (0.012, 0.012, 0)])
def test_gaps_and_margins_are_those_of_newton(device, gap, margin, count):
    """A cube 0.05 above a floor: contacts where margins and gaps of both reach that far, with what margins leave."""
    config = Config(gap=gap, margin=margin)
    builder = newton.ModelBuilder()
    builder.add_shape_mesh(-1, xform=at(z=-0.5), mesh=newton_mesh(FLOOR), cfg=config)
    builder.add_shape_mesh(builder.add_body(xform=at(z=0.55)), mesh=newton_mesh(CUBE), cfg=config)
    model = builder.finalize(device=device)
    state, _, contacts = collided(model)
    (first, second), normals = world_points(model, state, contacts)
    assert len(normals) == count
    np.testing.assert_allclose((second - first) @ [0, 0, 1], 0.05 - 2 * margin, atol=1e-6)
    np.testing.assert_allclose(normals, np.tile([0, 0, 1], (count, 1)), atol=1e-6)


def test_pairs_of_many_worlds_are_not_looked_at():
    assert adapter.group_pairs(np.ones(10_000, int), np.repeat(np.arange(5000), 2)) == []


def cubes_and_a_sphere(device):
    """Return a model of a ground plane, two mesh cubes on it, one on the other, and a sphere."""
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    for z in (0.5, 1.5):
        builder.add_shape_mesh(builder.add_body(xform=at(z=z)), mesh=newton_mesh(CUBE), cfg=Config(gap=0.01))
    builder.add_shape_sphere(builder.add_body(xform=at(3, 0, 0.3)), radius=0.3, cfg=Config(gap=0.01))
    return builder.finalize(device=device)


def test_other_contacts_come_first(device):
    """Those of pairs of which one is no mesh; contacts of meshes stand behind, and replace what was there."""
    model = cubes_and_a_sphere(device)
    state, found, contacts = collided(model)
    for _ in range(2):
        rows = np.stack(contact_rows(contacts, "shape0", "shape1"), 1).tolist()
        assert rows == [*([0, 1], [0, 2], [0, 3], [1, 3], [2, 3]), *4 * [[1, 2]]]
        found.collide(state, contacts)
    other, own = newton.Contacts(99, 0, device=device), ab.Model.load(CUBE)
    refused(ValueError, "another size", found.launch, state, other)
    found.collide(state, other)
    assert found.others.rigid_contact_max == 99
    assert ab.NewtonContacts(model, models={1: own}).scene.models[0] is own
    refused(ValueError, "models: 3 is no index of a mesh", ab.NewtonContacts, model, models={1: own, 3: own})


@pytest.mark.slow
def test_shapes_that_are_no_meshes_are_newtons(device):
    model = cubes_and_a_sphere(device)
    poses, contacts = settle(model, ab.NewtonContacts(model), 60)
    assert touching_shapes(contacts) == {(0, 1), (1, 2), (0, 3)}
    np.testing.assert_allclose(poses[:, 2], [0.5, 1.5, 0.3], atol=0.01)


GROUND = trimesh.creation.box((4, 4, 1))
# A wedge with a step, like none of its mirror images.
PART = trimesh.Trimesh(
    [[0, 0, 0], [1, 0, 0], [0, 0.6, 0], [0, 0, 0.3], [0.7, 0, 0.5], [0.1, 0.5, 0.2]],
    [[0, 2, 1], [3, 4, 5], [0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5]],
    process=False,
)
CLOSE = newton.ModelBuilder.ShapeConfig(gap=0.02, margin=0.0)


def mirrored_model(device, scale, mirrored_by_hand, on_body, solids):
    builder = newton.ModelBuilder()
    faces, low = PART.faces, float((PART.vertices * scale)[:, 2].min())
    mesh, place = newton_mesh(PART), at(0.2, 0.1, (-0.4 if solids else -0.01) - low)
    given = wp.vec3(*map(float, scale))
    if mirrored_by_hand:
        faces, given = faces[:, ::-1] if np.prod(scale) < 0 else faces, wp.vec3(1.0, 1.0, 1.0)
        mesh = newton_mesh(trimesh.Trimesh(PART.vertices * scale, faces, process=False))
    # Two that are static never meet: either moves.
    floor = -1 if on_body else builder.add_body(xform=at(z=-0.5))
    builder.add_shape_mesh(floor, xform=at(z=-0.5) if on_body else at(), mesh=newton_mesh(GROUND), cfg=CLOSE)
    body = builder.add_body(xform=place) if on_body else -1
    builder.add_shape_mesh(body, xform=at() if on_body else place, mesh=mesh, scale=given, cfg=CLOSE)
    if on_body:
        # The same mesh, not mirrored, far from the others: it shares no model with the mirrored one.
        builder.add_shape_mesh(builder.add_body(xform=at(x=9)), mesh=mesh, cfg=CLOSE)
    return builder.finalize(device=device)


@pytest.mark.parametrize("solids", [False, True])
@pytest.mark.parametrize("on_body", [False, True])
def test_mirrored_shapes_are_those_mirrored_by_hand(device, on_body, solids):
    for scale in itertools.product((1.0, -2.0), (1.0, -0.5), (1.0, -1.0)):
        found, expected = [], []
        for by_hand, rows in ((False, found), (True, expected)):
            model = mirrored_model(device, np.array(scale), by_hand, on_body, solids)
            rows += contact_rows(collided(model, solids=solids)[2], "shape0", "shape1", "normal", "point0", "point1")
        assert len(found[0]) > 0
        for a, b in zip(found, expected):
            np.testing.assert_allclose(a, b, atol=1e-6)
        # From the floor to what stands on it, also where that is in the floor.
        up = found[2][:, 2] * np.where(found[0] == 0, 1, -1)
        assert (up > 0.5).all(), scale


def stack(device):
    """Return a model of a mesh floor, two mesh bodies on it, and a sphere."""
    builder = newton.ModelBuilder()
    floor, part = newton_mesh(GROUND), newton_mesh(PART)
    builder.add_shape_mesh(-1, xform=at(z=-0.5), mesh=floor, cfg=CLOSE)
    for x in (-1.0, 1.0):
        builder.add_shape_mesh(builder.add_body(xform=at(x=x, z=-0.01)), mesh=part, cfg=CLOSE)
    builder.add_shape_sphere(builder.add_body(xform=at(z=0.29)), radius=0.3, cfg=CLOSE)
    builder.add_shape_collision_filter_pair(0, 3)
    return builder.finalize(device=device)


def change(model, name, shape, value):
    values = getattr(model, name).numpy()
    values[shape] = value
    getattr(model, name).assign(values)


CHANGES = {
    "shape_type": (3, int(newton.GeoType.BOX)),
    "shape_scale": (1, (1.0, 1.0, -1.0)),
    "shape_margin": (2, 0.01),
    "shape_gap": (0, 0.5),
    "shape_collision_group": (3, 7),
    "shape_world": (1, 0),
    "shape_body": (1, 1),
    "shape_flags": (2, 0),
}


@pytest.mark.parametrize("captured", [False, True])
def test_what_is_read_once_is_refused_where_it_changed(device, captured):
    model = stack(device)
    state, found, contacts = collided(model)
    if captured:
        if device != "cpu" and not wp.is_mempool_enabled(device):
            pytest.skip("no graph without a memory pool")
        with wp.ScopedCapture(wp.get_device(device)) as capture:
            found.launch(state, contacts)

    def ask():
        if captured:
            wp.capture_launch(capture.graph)
            wp.capture_launch(capture.graph)
            found.check(contacts)
        else:
            found.collide(state, contacts)

    for name, (shape, value) in CHANGES.items():
        values = getattr(model, name)
        kept = np.array(values.numpy()[shape])
        message = rf"^{name} of shape {shape} changed since NewtonContacts read it, once; make a new one$"
        # The array itself, then another in its place.
        for other in (values, wp.clone(values)):
            setattr(model, name, other)
            ask()
            change(model, name, shape, value)
            refused(RuntimeError, message, ask)
            change(model, name, shape, kept)
            ask()
    if captured:
        return
    pairs = sorted(model.shape_collision_filter_pairs)
    for other in ([*pairs, (1, 3)], [*pairs, (1, 2)][1:]):
        model._set_shape_collision_filter_pairs(other)
        refused(RuntimeError, r"^shape_collision_filter_pairs changed", ask)
    model._set_shape_collision_filter_pairs(pairs)
    ask()
    model.shape_source[1] = newton_mesh(trimesh.Trimesh(2 * PART.vertices, PART.faces))
    refused(RuntimeError, r"^shape_source changed", ask)


def test_what_is_read_at_every_call_may_change(device):
    """Transforms of shapes, whether one is drawn, and the sizes of shapes that are no meshes."""
    model = stack(device)
    state, found, contacts = collided(model)
    before = len(contact_rows(contacts, "normal")[0])
    change(model, "shape_flags", 2, int(model.shape_flags.numpy()[2]) ^ int(newton.ShapeFlags.VISIBLE))
    change(model, "shape_scale", 3, (0.2, 0.0, 0.0))
    change(model, "shape_transform", 1, (0.0, 0.0, 5.0, 0.0, 0.0, 0.0, 1.0))
    found.collide(state, contacts)
    (touched,) = contact_rows(contacts, "shape1")
    assert 0 < len(touched) < before and 1 not in touched and 2 in touched
