"""Shapes of Newton: mirrored ones against meshes mirrored by hand, and settings that change after they are read."""

import itertools

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers import refused
from helpers.bodies import at, collided, contact_rows, newton_mesh, settle

import warp_abtree as ab

newton = pytest.importorskip("newton")

FLOOR = trimesh.creation.box((4, 4, 1))
# A wedge with a step, like none of its mirror images.
PART = trimesh.Trimesh(
    [[0, 0, 0], [1, 0, 0], [0, 0.6, 0], [0, 0, 0.3], [0.7, 0, 0.5], [0.1, 0.5, 0.2]],
    [[0, 2, 1], [3, 4, 5], [0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5]],
    process=False,
)
NEAR = newton.ModelBuilder.ShapeConfig(gap=0.02, margin=0.0)


def points_of(model, **options):
    """Return shapes, normals and points of the contacts of a model at its poses."""
    return contact_rows(collided(model, **options)[2], "shape0", "shape1", "normal", "point0", "point1")


def scene_of(device, scale, mirrored_by_hand, on_body, solids):
    builder = newton.ModelBuilder()
    faces, low = PART.faces, float((PART.vertices * scale)[:, 2].min())
    mesh, place = newton_mesh(PART), at(0.2, 0.1, (-0.4 if solids else -0.01) - low)
    given = wp.vec3(*map(float, scale))
    if mirrored_by_hand:
        faces, given = faces[:, ::-1] if np.prod(scale) < 0 else faces, wp.vec3(1.0, 1.0, 1.0)
        mesh = newton_mesh(trimesh.Trimesh(PART.vertices * scale, faces, process=False))
    # Two that are static never meet: either moves.
    floor = -1 if on_body else builder.add_body(xform=at(z=-0.5))
    builder.add_shape_mesh(floor, xform=at(z=-0.5) if on_body else at(), mesh=newton_mesh(FLOOR), cfg=NEAR)
    body = builder.add_body(xform=place) if on_body else -1
    builder.add_shape_mesh(body, xform=at() if on_body else place, mesh=mesh, scale=given, cfg=NEAR)
    if on_body:
        # The same mesh, not mirrored, far from the others: it shares no model with the mirrored one.
        builder.add_shape_mesh(builder.add_body(xform=at(x=9)), mesh=mesh, cfg=NEAR)
    return builder.finalize(device=device)


@pytest.mark.parametrize("solids", [False, True])
@pytest.mark.parametrize("on_body", [False, True])
def test_mirrored_shapes_are_those_mirrored_by_hand(device, on_body, solids):
    for scale in itertools.product((1.0, -2.0), (1.0, -0.5), (1.0, -1.0)):
        found, expected = (
            points_of(scene_of(device, np.array(scale), by_hand, on_body, solids), solids=solids)
            for by_hand in (False, True)
        )
        assert len(found[0]) > 0
        for a, b in zip(found, expected):
            np.testing.assert_allclose(a, b, atol=1e-6)
        # From the floor to what stands on it, also where that is in the floor.
        up = found[2][:, 2] * np.where(found[0] == 0, 1, -1)
        assert (up > 0.5).all(), scale


def test_mirrored_shapes_rest_where_newton_has_them(device):
    """A mirrored ball on a mirrored floor, beside Newton's own contacts."""
    ball = trimesh.creation.icosphere(1, radius=0.3)
    low = float(ball.vertices[:, 2].min())
    builder = newton.ModelBuilder()
    floor = newton_mesh(FLOOR)
    builder.add_shape_mesh(-1, xform=at(z=-0.5), mesh=floor, scale=wp.vec3(1.0, -1.0, 1.0), cfg=NEAR)
    body = builder.add_body(xform=at(z=-low))
    builder.add_shape_mesh(body, mesh=newton_mesh(ball), scale=wp.vec3(-1.0, -1.0, -1.0), cfg=NEAR)
    model = builder.finalize(device=device)
    finders = ab.NewtonContacts(model), newton.CollisionPipeline(model)
    ours, newtons = (settle(model, found, 40, iterations=10)[0] for found in finders)
    assert ours[0, 2] == pytest.approx(newtons[0, 2], abs=0.003) == pytest.approx(-low, abs=0.003)


def stack(device):
    """Return a model of a mesh floor, two mesh bodies on it, and a sphere."""
    builder = newton.ModelBuilder()
    floor, part = newton_mesh(FLOOR), newton_mesh(PART)
    builder.add_shape_mesh(-1, xform=at(z=-0.5), mesh=floor, cfg=NEAR)
    for x in (-1.0, 1.0):
        builder.add_shape_mesh(builder.add_body(xform=at(x=x, z=-0.01)), mesh=part, cfg=NEAR)
    builder.add_shape_sphere(builder.add_body(xform=at(z=0.29)), radius=0.3, cfg=NEAR)
    builder.add_shape_collision_filter_pair(0, 3)
    return builder.finalize(device=device)


def change(model, name, shape, value):
    """Change one entry of an array in place."""
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
@pytest.mark.parametrize("name", CHANGES)
def test_what_is_read_once_is_refused_where_it_changed(device, name, captured):
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

    shape, value = CHANGES[name]
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


def test_other_meshes_and_filters_are_refused(device):
    model = stack(device)
    state, found, contacts = collided(model)
    pairs = sorted(model.shape_collision_filter_pairs)
    for other in ([*pairs, (1, 3)], [*pairs, (1, 2)][1:], pairs):
        model._set_shape_collision_filter_pairs(other)
        if other == pairs:
            found.collide(state, contacts)
            continue
        refused(RuntimeError, r"^shape_collision_filter_pairs changed", found.collide, state, contacts)
    model.shape_source[1] = newton_mesh(trimesh.Trimesh(2 * PART.vertices, PART.faces))
    refused(RuntimeError, r"^shape_source changed", found.collide, state, contacts)


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


@pytest.mark.parametrize("solids", [[True, False, True, False], np.array([True]), [0.5], "all"])
def test_solids_are_indices(device, solids):
    """A mask is no list of indices: it would make solids of shapes 0 and 1."""
    said = r"^solids: .* is neither a bool nor indices of shapes$"
    refused(ValueError, said, ab.NewtonContacts, stack(device), solids=solids)
    assert not any(ab.NewtonContacts(stack(device), solids=[]).scene.object_solid)
