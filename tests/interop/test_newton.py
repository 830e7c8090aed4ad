"""Contacts for Newton, where it is installed: geometry against closed forms, and bodies that its solver holds up."""

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers import refused

import warp_abtree as ab
from warp_abtree.interop import newton as adapter

newton = pytest.importorskip("newton")
# Newton's first steps compile its own kernels, which takes most of the time of this file.


def mesh_of(shape):
    return newton.Mesh(np.asarray(shape.vertices, np.float32), np.asarray(shape.faces).ravel())


def placed(position, axis=(0, 0, 1), angle=0.0):
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    return wp.transform(wp.vec3(*position), wp.quat(*(np.sin(angle / 2) * axis), float(np.cos(angle / 2))))


CUBE = trimesh.creation.box((1, 1, 1))
FLOOR = trimesh.creation.box((8, 8, 1))


def matrix(pose):
    """4x4 matrix of x y z qx qy qz qw."""
    found = trimesh.transformations.quaternion_matrix([pose[6], *pose[3:6]])
    found[:3, 3] = pose[:3]
    return found


def world_points(model, state, contacts):
    """Surface points of both shapes in the world, by Newton's convention for points and offsets of bodies."""
    count = int(contacts.rigid_contact_count.numpy()[0])
    body, body_q = model.shape_body.numpy(), state.body_q.numpy()
    points = []
    for side in (0, 1):
        names = [f"rigid_contact_{name}{side}" for name in ("shape", "point", "offset")]
        shapes, point, offset = (getattr(contacts, name).numpy()[:count] for name in names)
        poses = [np.eye(4) if body[s] < 0 else matrix(body_q[body[s]]) for s in shapes]
        points.append(np.array([(m @ [*x, 1])[:3] for m, x in zip(poses, point + offset)]).reshape(-1, 3))
    return points, contacts.rigid_contact_normal.numpy()[:count]


def test_a_cube_on_a_floor_has_its_corners(device):
    builder = newton.ModelBuilder()
    turn = (0, 0, 1), 0.5
    config = newton.ModelBuilder.ShapeConfig(margin=0.02)
    builder.add_shape_mesh(-1, xform=placed((0, 0, -0.5)), mesh=mesh_of(FLOOR), cfg=config)
    body = builder.add_body(xform=placed((0.3, 0.2, 0.0), *turn))
    # The shape stands off its body, and its mesh is scaled.
    builder.add_shape_mesh(body, xform=placed((0, 0, 0.49)), mesh=mesh_of(CUBE), scale=wp.vec3(1.0, 0.8, 1.0))
    model = builder.finalize(device=device)
    state, found = model.state(), ab.NewtonContacts(model)
    contacts = found.contacts()
    for _ in range(2):
        found.collide(state, contacts)
    (first, second), normals = world_points(model, state, contacts)
    assert len(normals) == 4
    np.testing.assert_allclose(normals, np.tile([0, 0, 1], (4, 1)), atol=1e-6)
    for side in (0, 1):
        assert set(getattr(contacts, f"rigid_contact_shape{side}").numpy()[:4]) == {side}
    # The floor's margin thickens it, as in Newton.
    np.testing.assert_allclose((second - first) @ [0, 0, 1], -0.03, atol=1e-6)
    r = matrix([0, 0, 0, *placed((0, 0, 0), *turn)[3:]])[:3, :3]
    corners = np.array([r @ [x, y, 0] + [0.3, 0.2, 0] for x in (-0.5, 0.5) for y in (-0.4, 0.4)])
    for corner in corners:
        assert np.abs(0.5 * (first + second) - corner)[:, :2].max(1).min() < 1e-6
    assert (contacts.rigid_contact_count.numpy() == 4).all()
    assert np.unique(contacts.rigid_contact_margin0.numpy()[:4]) == pytest.approx(0.02)


@pytest.mark.parametrize("captured", [False, True])
def test_what_is_inside_a_solid_is_pushed_out(device, captured):
    """A cube wholly inside a floor crosses no face of it; as a solid the floor knows how deep it is."""
    builder = newton.ModelBuilder()
    builder.add_shape_mesh(-1, mesh=mesh_of(FLOOR))
    body = builder.add_body(xform=placed((0.3, 0.2, 0.3), (0, 0, 1), 0.4))
    builder.add_shape_mesh(body, mesh=mesh_of(CUBE), scale=wp.vec3(0.2, 0.2, 0.2))
    builder.add_shape_sphere(body, radius=0.01)
    model = builder.finalize(device=device)
    model.shape_gap.fill_(0.0)
    state, depths = model.state(), {}
    for solids in (False, [0], True):
        found = ab.NewtonContacts(model, solids=solids)
        contacts = found.contacts()
        found.collide(state, contacts)
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
        builder.add_shape_mesh(builder.add_body(), mesh=mesh_of(mesh))
    model = builder.finalize(device=device)
    ab.NewtonContacts(model, solids=[0])
    refused(ab.MeshError, "not closed", ab.NewtonContacts, model, solids=True)


def test_filters_groups_and_worlds(device):
    def add(builder, **config):
        body = builder.add_body(xform=placed((0, 0, 0)))
        return builder.add_shape_mesh(body, mesh=mesh_of(CUBE), cfg=newton.ModelBuilder.ShapeConfig(**config))

    part = newton.ModelBuilder()
    add(part)
    part.add_shape_mesh(0, xform=placed((0.5, 0, 0)), mesh=mesh_of(CUBE))  # of the same body
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
    builder.add_shape_mesh(-1, xform=placed((0, 0, -0.5)), mesh=mesh_of(FLOOR))
    builder.add_shape_sphere(builder.add_body())
    refused(ValueError, "1 shapes that are meshes", ab.NewtonContacts, builder.finalize(device=device))
    builder.add_shape_mesh(builder.add_body(xform=placed((0, 0, 0.49))), mesh=mesh_of(CUBE))
    model = builder.finalize(device=device)
    found = ab.NewtonContacts(model)
    refused(ab.CapacityError, r"\d rigid contacts", found.collide, model.state(), found.contacts(2))


@pytest.mark.parametrize("gap, margin, count", [(0.03, 0.0, 4), (0.02, 0.0, 0), (0.02, 0.01, 4)])
def test_gaps_and_margins_are_those_of_newton(device, gap, margin, count):
    """A cube 0.05 above a floor: contacts where margins and gaps of both reach that far, with what margins leave."""
    config = newton.ModelBuilder.ShapeConfig(gap=gap, margin=margin)
    builder = newton.ModelBuilder()
    builder.add_shape_mesh(-1, xform=placed((0, 0, -0.5)), mesh=mesh_of(FLOOR), cfg=config)
    builder.add_shape_mesh(builder.add_body(xform=placed((0, 0, 0.55))), mesh=mesh_of(CUBE), cfg=config)
    model = builder.finalize(device=device)
    state, found = model.state(), ab.NewtonContacts(model)
    contacts = found.contacts()
    found.collide(state, contacts)
    (first, second), normals = world_points(model, state, contacts)
    assert len(normals) == count
    np.testing.assert_allclose((second - first) @ [0, 0, 1], 0.05 - 2 * margin, atol=1e-6)
    np.testing.assert_allclose(normals, np.tile([0, 0, 1], (count, 1)), atol=1e-6)


def test_shapes_that_are_no_meshes_are_newtons(device):
    """Two mesh cubes, one on the other, and a sphere stand on Newton's ground plane."""
    config = newton.ModelBuilder.ShapeConfig(gap=0.01)
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    for z in (0.5, 1.5):
        builder.add_shape_mesh(builder.add_body(xform=placed((0, 0, z))), mesh=mesh_of(CUBE), cfg=config)
    builder.add_shape_sphere(builder.add_body(xform=placed((3, 0, 0.3))), radius=0.3, cfg=config)
    model = builder.finalize(device=device)
    found = ab.NewtonContacts(model)
    solver, contacts, control = newton.solvers.SolverXPBD(model), found.contacts(), model.control()
    state, after = model.state(), model.state()
    for _ in range(60):
        state.clear_forces()
        found.collide(state, contacts)
        solver.step(state, after, control, contacts, 1 / 240)
        state, after = after, state
    count = int(contacts.rigid_contact_count.numpy()[0])
    pairs = {
        tuple(pair)
        for pair in np.stack([getattr(contacts, f"rigid_contact_shape{k}").numpy() for k in (0, 1)], 1)[:count]
    }
    assert {tuple(sorted(pair)) for pair in pairs} == {(0, 1), (1, 2), (0, 3)}
    np.testing.assert_allclose(state.body_q.numpy()[:, 2], [0.5, 1.5, 0.3], atol=0.01)


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


def test_a_ring_falls_over_a_peg_in_newton(device):
    builder = newton.ModelBuilder()
    builder.add_shape_mesh(-1, xform=placed((0, 0, -0.5)), mesh=mesh_of(FLOOR))
    peg = trimesh.creation.cylinder(0.3, 1.2, sections=8)
    builder.add_shape_mesh(-1, xform=placed((0, 0, 0.55)), mesh=mesh_of(peg))
    ring = builder.add_body(xform=placed((0.1, 0, 1.0), (2, 1, 0), 0.15))
    builder.add_shape_mesh(ring, mesh=mesh_of(trimesh.creation.torus(0.8, 0.25, 16, 8)))
    model = builder.finalize(device=device)
    found = ab.NewtonContacts(model)
    solver, contacts, control = newton.solvers.SolverXPBD(model), found.contacts(), model.control()
    state, after = model.state(), model.state()
    for _ in range(400):
        state.clear_forces()
        found.collide(state, contacts)
        solver.step(state, after, control, contacts, 1 / 240)
        state, after = after, state
    x, y, z = state.body_q.numpy()[0, :3]
    assert np.hypot(x, y) < 0.3 and z == pytest.approx(0.25, abs=0.02)
