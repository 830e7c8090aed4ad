"""Contacts for Newton, where it is installed: geometry against closed forms, and bodies that its solver holds up."""

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers import refused
from helpers.bodies import at, collided, contact_rows, newton_mesh, settle, touching_shapes

import warp_abtree as ab
from warp_abtree.interop import newton as adapter

newton = pytest.importorskip("newton")
# Newton's first steps compile its own kernels, which takes most of the time of this file.


CUBE = trimesh.creation.box((1, 1, 1))
FLOOR = trimesh.creation.box((8, 8, 1))
Config = newton.ModelBuilder.ShapeConfig


def matrix(pose):
    """4x4 matrix of x y z qx qy qz qw."""
    found = trimesh.transformations.quaternion_matrix([pose[6], *pose[3:6]])
    found[:3, 3] = pose[:3]
    return found


def world_points(model, state, contacts):
    """Surface points of both shapes in the world, by Newton's convention for points and offsets of bodies."""
    body, body_q = model.shape_body.numpy(), state.body_q.numpy()
    points = []
    for side in (0, 1):
        shapes, point, offset = contact_rows(contacts, *(f"{name}{side}" for name in ("shape", "point", "offset")))
        poses = [np.eye(4) if body[s] < 0 else matrix(body_q[body[s]]) for s in shapes]
        points.append(np.array([(m @ [*x, 1])[:3] for m, x in zip(poses, point + offset)]).reshape(-1, 3))
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
    r = matrix([0, 0, 0, *at(angle=0.5)[3:]])[:3, :3]
    corners = np.array([r @ [x, y, 0] + [0.3, 0.2, 0] for x in (-0.5, 0.5) for y in (-0.4, 0.4)])
    for corner in corners:
        assert np.abs(0.5 * (first + second) - corner)[:, :2].max(1).min() < 1e-6
    assert (contacts.rigid_contact_count.numpy() == 4).all()
    assert np.unique(contacts.rigid_contact_margin0.numpy()[:4]) == pytest.approx(0.02)


@pytest.mark.parametrize("captured", [False, True])
def test_what_is_inside_a_solid_is_pushed_out(device, captured):
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
        state, found, contacts = collided(model, solids=solids)
        if captured:
            with wp.ScopedCapture(wp.get_device(device)) as capture:
                found.launch(state, contacts)
            contacts.clear()
            wp.capture_launch(capture.graph)
        (first, second), normals = world_points(model, state, contacts)
        of_cube = contacts.rigid_contact_shape1.numpy()[: len(normals)] == 1
        depths[str(solids)] = sorted(((first - second) * normals).sum(1)[of_cube])
        assert all(normal @ [0, 0, 1] > 1 - 1e-6 for normal in normals)
    assert depths["False"] == [] and depths["[0]"] == depths["True"]
    np.testing.assert_allclose(depths["True"][-1], 0.3, atol=1e-6)
    refused(ValueError, "shape 2 is no mesh", ab.NewtonContacts, model, solids=[0, 2])


def test_a_solid_is_closed(device):
    builder = newton.ModelBuilder()
    open_cube = trimesh.Trimesh(CUBE.vertices, CUBE.faces[:-1], process=False)
    for mesh in (CUBE, open_cube):
        builder.add_shape_mesh(builder.add_body(), mesh=newton_mesh(mesh))
    model = builder.finalize(device=device)
    ab.NewtonContacts(model, solids=[0])
    refused(ab.MeshError, "not closed", ab.NewtonContacts, model, solids=True)


def test_filters_groups_and_worlds(device):
    def add(builder, **config):
        body = builder.add_body(xform=at())
        return builder.add_shape_mesh(body, mesh=newton_mesh(CUBE), cfg=Config(**config))

    part = newton.ModelBuilder()
    add(part)
    part.add_shape_mesh(0, xform=at(0.5), mesh=newton_mesh(CUBE))  # of the same body
    builder = newton.ModelBuilder()
    for _ in range(2):
        builder.add_world(part)
    add(builder, collision_group=-1)  # in every world
    model = builder.finalize(device=device)
    assert model.shape_world.numpy().tolist() == [0, 0, 1, 1, -1]
    found = ab.NewtonContacts(model)
    assert found.scene.broad_phase().tolist() == [[0, 4], [1, 4], [2, 4], [3, 4]]
    builder = newton.ModelBuilder()
    shapes = [add(builder, collision_group=g) for g in (1, 1, 2, -1, -1, -2, 0)]
    builder.add_shape_collision_filter_pair(shapes[0], shapes[1])
    found = ab.NewtonContacts(builder.finalize(device=device))
    expected = [(0, 3), (0, 4), (0, 5), (1, 3), (1, 4), (1, 5), (2, 3), (2, 4), (2, 5), (3, 5), (4, 5)]
    assert [tuple(pair) for pair in found.scene.broad_phase().tolist()] == expected


def test_room_and_wrong_models(device):
    builder = newton.ModelBuilder()
    builder.add_shape_mesh(-1, xform=at(z=-0.5), mesh=newton_mesh(FLOOR))
    builder.add_shape_sphere(builder.add_body())
    refused(ValueError, "1 shapes that are meshes", ab.NewtonContacts, builder.finalize(device=device))
    builder.add_shape_mesh(builder.add_body(xform=at(z=0.49)), mesh=newton_mesh(CUBE))
    model = builder.finalize(device=device)
    found = ab.NewtonContacts(model)
    refused(ab.CapacityError, r"\d rigid contacts", found.collide, model.state(), found.contacts(2))


@pytest.mark.parametrize("gap, margin, count", [(0.03, 0.0, 4), (0.02, 0.0, 0), (0.02, 0.01, 4)])
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


def test_excluded_pairs_of_many_shapes():
    """By body, group, world and list, as pair by pair; and not all pairs of many worlds are looked at."""
    rng = np.random.default_rng(0)
    body, group = rng.integers(-1, 6, 40), rng.choice([-2, -1, 0, 1, 2], 40)
    world = rng.integers(-1, 3, 40)
    found = [*adapter.same_body_pairs(body), *adapter.group_pairs(group, world)]
    found = {tuple(sorted(pair)) for pair in np.concatenate(found).tolist() if pair[0] != pair[1]}
    for i in range(40):
        for j in range(i + 1, 40):
            low, high = sorted((group[i], group[j]))
            apart = low == 0 or high == 0 or not (low == high if low > 0 else low != high)
            together = world[i] == world[j] or min(world[i], world[j]) < 0
            assert ((i, j) in found) == (bool(apart and together) or bool(body[i] == body[j] >= 0))
    world = np.repeat(np.arange(5000), 2)
    assert adapter.group_pairs(np.ones(10_000, int), world) == []


def test_shapes_that_are_no_meshes_are_newtons(device):
    """Two mesh cubes, one on the other, and a sphere stand on Newton's ground plane."""
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    for z in (0.5, 1.5):
        builder.add_shape_mesh(builder.add_body(xform=at(z=z)), mesh=newton_mesh(CUBE), cfg=Config(gap=0.01))
    builder.add_shape_sphere(builder.add_body(xform=at(3, 0, 0.3)), radius=0.3, cfg=Config(gap=0.01))
    model = builder.finalize(device=device)
    poses, contacts = settle(model, ab.NewtonContacts(model), 60)
    assert touching_shapes(contacts) == {(0, 1), (1, 2), (0, 3)}
    np.testing.assert_allclose(poses[:, 2], [0.5, 1.5, 0.3], atol=0.01)


def test_a_ring_falls_over_a_peg_in_newton(device):
    builder = newton.ModelBuilder()
    peg, ring = trimesh.creation.cylinder(0.3, 1.2, sections=8), trimesh.creation.torus(0.8, 0.25, 16, 8)
    builder.add_shape_mesh(-1, xform=at(z=-0.5), mesh=newton_mesh(FLOOR))
    builder.add_shape_mesh(-1, xform=at(z=0.55), mesh=newton_mesh(peg))
    builder.add_shape_mesh(builder.add_body(xform=at(0.1, 0, 1.0, (2, 1, 0), 0.15)), mesh=newton_mesh(ring))
    model = builder.finalize(device=device)
    x, y, z = settle(model, ab.NewtonContacts(model), 400)[0][0, :3]
    assert np.hypot(x, y) < 0.3 and z == pytest.approx(0.25, abs=0.02)
