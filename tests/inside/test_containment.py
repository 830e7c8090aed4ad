"""Solids: what lies inside intersects, against parities counted in integers; rays through corners, edges and planes."""

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers.questions import launch
from helpers.samples import corners_of, model_of_faces, random_poses
from helpers.scenes import scene_with
from helpers.solids import ask, lattice_pose, model_of, moved, shell, voxel_mesh
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.inside import components, parity, solids_intersect
from oracles.motion import posed

import warp_abtree as ab
from warp_abtree.kernels import native
from warp_abtree.kernels.inside.parity import Ray, crosses_face

wp.set_module_options(native.options("exact/determinant.cuh"))

BOX = ab.Model.load(trimesh.creation.box((4, 4, 4)))
BALL = ab.Model.load(trimesh.creation.icosphere(2, 0.5))
TORUS = ab.Model.load(trimesh.creation.torus(1, 0.3, major_sections=24, minor_sections=12))
TINY = ab.Model.load(trimesh.creation.icosphere(1, 0.1), base_faces=4)
SHELL = model_of(voxel_mesh(shell(5)), "shell")
SHEET = model_of_faces([[0, 0, 0], [1, 0, 0], [0, 1, 0]], name="sheet")


@wp.kernel
def parity_kernel(points: wp.array[wp.vec3d], corners: wp.array2d[wp.vec3d], parity_out: wp.array2d[wp.int32]):
    i = wp.tid()
    for k in range(6):
        ray = Ray()
        ray.origin = points[i]
        ray.axis = k % 3
        ray.ahead = wp.where(k < 3, 1, -1)
        count = wp.int32(0)
        for j in range(corners.shape[0]):
            count += crosses_face(ray, corners[j, 0], corners[j, 1], corners[j, 2])
        parity_out[i, k] = count % 2


@pytest.mark.parametrize("seed", range(3))
def test_rays_through_corners_edges_and_faces(device, seed):
    """Points in line with corners and edges, and in the planes of faces; folded and doubled surfaces."""
    rng = np.random.default_rng(seed)
    vertices, faces = voxel_mesh(rng.integers(0, 4, (16, 3)), rng)
    if seed % 2:
        # Corners moved on the lattice: slivers, faces of no area and surfaces that cross themselves.
        vertices = vertices * 2 + rng.integers(-2, 3, vertices.shape)
    triangles = vertices[faces]
    # In the middle of cells, at the height of corners, on lines through edges: never on the surface.
    grid = rng.integers(-2, 18, (100, 3)) * 0.5
    middles = (triangles[:, 0] + triangles[:, 1]) / 2 + rng.integers(-1, 2, (len(faces), 3)) * 0.25
    points = np.concatenate([grid, middles, vertices + np.eye(3)[rng.integers(0, 3, len(vertices))] * 0.5])
    if seed == 2:
        # The same, scaled and turned out of the axes by numbers that round: nearly degenerate.
        turn = 0.1 * np.array([[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1]])
        triangles, points = (vertices @ turn)[faces], points @ turn
    expected, kept = [], []
    for point in points:
        try:
            expected.append(parity(point, triangles))
            kept.append(point)
        except AssertionError:
            continue
    found = launch(parity_kernel, device, len(kept), np.array(kept), triangles, columns=6)
    assert len(kept) > 150 and 20 < sum(expected) < len(kept)
    np.testing.assert_array_equal(found, np.repeat(np.array(expected, int)[:, None], 6, axis=1))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_lattice_solids_are_decided_as_in_integers(seed):
    """Voxel bodies with cavities and bodies within them, in lattice poses: every ray is degenerate."""
    rng = np.random.default_rng(seed)
    outer = voxel_mesh(shell(int(rng.integers(3, 6))) if rng.random() < 0.5 else rng.integers(0, 4, (25, 3)), rng)
    cells = rng.integers(0, 3, (int(rng.integers(1, 5)), 3))
    inner = voxel_mesh(cells, rng)
    # A quarter of a cell in the middle of one: inside, outside and across all occur.
    inner = (inner[0] * 0.25 + 0.375, inner[1])
    meshes, solids = (outer, inner), rng.random(2) < 0.7
    if rng.random() < 0.5:
        meshes = meshes[::-1]
    poses = lattice_pose(rng, 1), lattice_pose(rng, 2)
    placed = [(model_of(mesh), pose, bool(solid)) for mesh, pose, solid in zip(meshes, poses, solids)]
    models = [model.mesh_at(model.lod_max)[:2] for model, _, _ in placed]
    meet, held = solids_intersect(*models, *poses, *solids)
    for device in map(str, wp.get_devices()):
        for pairs in ([(0, 1)], [(1, 0)]):
            found = ask(device, placed, pairs, "count")
            assert (found.any[0], found.count[0] > 0) == (meet or held, meet)
            found = ask(device, placed, pairs, "distance")
            assert (found.distance[0] == 0) == (meet or held)


@pytest.mark.parametrize("seed", range(2))
def test_solids_at_every_lod_and_random_poses(device, seed):
    """Coarse meshes that fold and cross themselves have an inside too."""
    rng = np.random.default_rng(seed)
    knot = ab.Model.load(trimesh.creation.torus(1, 0.45, major_sections=16, minor_sections=10), base_faces=4)
    probe = ab.Model.load(trimesh.creation.icosphere(1, 0.12), base_faces=4)
    scene = ab.Scene(device)
    count = 24
    for i in range(count):
        scene.add((knot, probe)[i % 2], random_poses(rng, 1, 0.6)[0], solid=i % 3 == 0)
    pairs = np.array([(i, j) for i in range(0, count, 2) for j in range(1, count, 2)])
    pairs[::3] = pairs[::3, ::-1]
    held_at_all = 0
    for fraction in (1.0, 0.3, 0.05, 0.01):
        lods = np.array([scene.models[m].lod_for(fraction=fraction) for m in scene.object_model])
        lods[0::4] = knot.lod_max if seed else 0
        scene.set_lods(lods)
        poses = random_poses(rng, count, 0.7)
        scene.set_poses(poses)
        answer, distance = scene.intersect(pairs, "count"), scene.intersect(pairs, "distance")
        meshes = [scene.models[m].mesh_at(lod)[:2] for m, lod in zip(scene.object_model, lods)]
        for row, (i, j) in enumerate(pairs.tolist()):
            a, b = min(i, j), max(i, j)
            solid = scene.object_solid[a], scene.object_solid[b]
            if answer.count[row]:
                assert answer.any[row] and distance.distance[row] == 0
                continue
            meet, held = solids_intersect(meshes[a], meshes[b], poses[a], poses[b], *solid)
            assert not meet and answer.any[row] == held == (distance.distance[row] == 0), (row, fraction)
            held_at_all += held
            if held:
                check_witness(scene, distance, row, meshes, poses)
    assert held_at_all > 5


def check_witness(scene, result, row, meshes, poses):
    """Both points are one, a corner of the face that is named, of the object that is inside."""
    faces = result.point_faces[row]
    assert (faces < 0).sum() == 1 and (result.points[row, 0] == result.points[row, 1]).all()
    inner = int(result.pairs[row, int(faces.argmax())])
    lod = int(scene.lods[inner])
    vertices, corners, ids = scene.models[scene.object_model[inner]].mesh_at(lod)
    at = vertices[corners[ids == faces.max()][0]]
    assert np.abs(posed(at, poses[inner]) - result.points[row, 0]).max(1).min() < 1e-12
    assert (result.bracket[row] == 0).all()


def test_what_each_output_says(device):
    inside = [(BOX, moved(), True), (BALL, moved(0.3), False)]
    for placed in (inside, inside[::-1]):
        found = ask(device, placed, output="contacts")
        assert found.any[0] and found.count[0] == 0 and len(found.contacts) == 0 and len(found.faces) == 0
        found = ask(device, placed, within=0.5)
        assert found.any[0] and not found.apart[0]
        assert ask(device, placed, output="distance", beyond=0.1).distance[0] == 0
    # The same without solids, or with the wrong one.
    for solids in ((False, False), (False, True)):
        found = ask(device, [(BOX, moved(), solids[0]), (BALL, moved(0.3), solids[1])], within=0.5)
        assert not found.any[0] and found.apart[0]
    # In a cavity, in the hole of a ring, beside it.
    assert not ask(device, [(SHELL, moved(), True), (BALL, moved(2.5, 2.5, 2.5), True)]).any[0]
    for x, held in ((0.0, False), (1.0, True), (1.5, False)):
        assert ask(device, [(TORUS, moved(), True), (TINY, moved(x), False)]).any[0] == held
    # An open surface within a solid.
    assert ask(device, [(BOX, moved(), True), (SHEET, moved(0.2), False)]).any[0]


def test_one_component_of_several_is_enough(device):
    """A box that holds one of three balls, in any order of faces; the lowest face of a component stands for it."""
    balls = [trimesh.creation.icosphere(1, 0.3).apply_translation(x) for x in ([9, 0, 0], [0, 9, 0], [0.5, 0, 0])]
    for order in ((0, 1, 2), (2, 0, 1), (1, 2, 0)):
        joined = trimesh.util.concatenate([balls[k] for k in order])
        model = ab.Model.load(joined)
        both = [(BOX, moved(), True), (model, moved(), False)]
        for placed in (both, both[::-1]):
            found = ask(device, placed, output="distance")
            assert found.any[0] and found.point_faces[0].max() == 80 * order.index(2)
        assert not ask(device, [(BOX, moved(), True), (model, moved(0, 0, 20), False)]).any[0]


def test_components_of_every_lod(device):
    """Blobs on thin necks fall apart as the LOD falls; each part has one face that stands for it."""
    rng = np.random.default_rng(3)
    neck = [(x, 0, 0) for x in range(9)]
    blobs = [(x, y, z) for x in (-1, 9, 10) for y in (-1, 0, 1) for z in (-1, 0, 1)]
    lumps = [model_of(voxel_mesh(neck + blobs, rng)), model_of(voxel_mesh(rng.integers(0, 7, (40, 3)), rng))]
    row = [trimesh.creation.icosphere(2).apply_translation([3 * k, 0, 0]) for k in range(5)]
    several = set()
    for model in (*lumps, ab.Model.load(trimesh.util.concatenate(row)), TORUS):
        scene = scene_with(device, (model, moved(), {"solid": True}), (model, moved(100.0)))
        for lod in range(model.lod_max, -1, -max(1, model.lod_max // 25)):
            scene.set_lods([lod, lod])
            scene.intersect(np.array([(0, 1)]))
            batch = scene.batch()
            state, pool = int(batch.objects.state[0]), batch.solids.pool
            first, count = int(pool.first.numpy()[state]), int(pool.count.numpy()[state])
            _, faces, ids = model.mesh_at(lod)
            expected = sorted(int(ids[rows].min()) for rows in components(faces))
            assert sorted(pool.face.numpy()[first : first + count].tolist()) == expected
            several.add(len(expected))
    assert len(several) > 3


def test_nothing_is_made_without_solids(device):
    scene = scene_with(device, BOX, BALL)
    query = ab.DistanceQuery(scene, np.array([(0, 1)]))
    assert scene.batch().solids is None and not hasattr(query, "contained")
    scene.add(BALL, solid=True)
    assert scene.batch().solids is not None


def test_captured_queries_and_pipelines_see_new_lods_and_poses(device):
    rng = np.random.default_rng(5)
    scene = ab.Scene(device)
    for i in range(12):
        scene.add((TORUS, BALL, BOX, TINY)[i % 4], moved(*rng.uniform(-3, 3, 3)), solid=i % 3 != 0)
    frame = ab.Pipeline(scene, "any", pairs=np.array([(i, j) for i in range(12) for j in range(i)]))
    graph = frame.capture()
    seen = set()
    for _ in range(6):
        lods = np.array([rng.integers(0, scene.models[m].lod_max + 1) for m in scene.object_model])
        poses = random_poses(rng, 12, 1.5)
        scene.set_lods(lods)
        scene.set_poses(poses)
        expected = scene.intersect(frame.result().pairs, "count")
        frame.lods.assign(lods.astype(np.int32))
        frame.poses.assign(poses)
        wp.capture_launch(graph)
        found = frame.result()
        np.testing.assert_array_equal(found.any, expected.any)
        seen |= set((expected.any & (expected.count == 0)).tolist())
        frame.check()
    assert seen == {True, False}


def test_an_interrupted_change_of_lods_is_made_good(device):
    """Components are found anew where tree states are."""
    scene = scene_with(device, SHELL, (BALL, moved(2.5, 2.5, 2.5)), (BALL, moved(0.2, 0.2, 0.2)), solid=True)
    pairs = np.array([(0, 1), (0, 2), (1, 2)])
    before = scene.intersect(pairs, "count")
    scene.batch().tear()
    again = scene.intersect(pairs, "count")
    np.testing.assert_array_equal(before.any, again.any)
    np.testing.assert_array_equal(before.count, again.count)


@pytest.mark.parametrize("name", ["cow", "rocker-arm"])
def test_real_meshes_against_winding_numbers(device, name, real_mesh_path):
    """Small probes anywhere in the box of a mesh, at its finest LOD and a coarse one, in turned poses."""
    mesh, rng = ab.Model.load(real_mesh_path(name)), np.random.default_rng(2)
    vertices = mesh.mesh_at(mesh.lod_max)[0]
    lower, upper = vertices.min(0), vertices.max(0)
    probe = ab.Model.load(trimesh.creation.icosphere(0, 0.004 * np.ptp(vertices, axis=0).max()), base_faces=20)
    poses = random_poses(rng, 150, 1.0)
    poses[:, :3] = rng.uniform(lower, upper, (len(poses), 3))
    for lod in (mesh.lod_max, mesh.lod_for(fraction=0.05)):
        faces = corners_of(mesh, lod)
        plain = ab.sweep(mesh, probe, poses, lod_a=lod, device=device)
        asked = {"lod_a": lod, "device": device, "solid": (True, False)}
        found = ab.sweep(mesh, probe, poses, **asked)
        signed = ab.sweep(mesh, probe, poses, **asked, output="distance", signed=True)
        # The sum of the solid angles of all faces, 4 pi inside; odd multiples count.
        angle = np.array([solid_angle(faces - pose[:3]) for pose in poses])
        held = np.round(angle / (4 * np.pi)).astype(int) % 2 == 1
        np.testing.assert_array_equal(found[~plain], held[~plain])
        assert (found | ~plain).all() and 20 < held[~plain].sum() < (~plain).sum()
        np.testing.assert_array_equal(signed["distance"] <= 0, found)
        assert (signed["distance"][held & ~plain] < 0).all()


def solid_angle(triangles):
    """Solid angle of triangles seen from the origin. Source: van Oosterom and Strackee 1983."""
    a, b, c = (triangles[:, k] for k in range(3))
    x, y, z = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    rest = x * y * z + np.einsum("ij,ij->i", a, b) * z + np.einsum("ij,ij->i", b, c) * x
    return 2 * np.arctan2(volume, rest + np.einsum("ij,ij->i", c, a) * y).sum()


def test_boxes_that_rays_meet_are_as_wide_as_they_round(device):
    """Specks far from the middle of their object, in and about a solid that is hardly larger than what rounds there."""
    rng = np.random.default_rng(7)
    size, count = 2.0**-20, 160
    corners = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    body = trimesh.creation.box((2 * size,) * 3)
    solid = ab.Model.from_arrays(body.vertices, body.faces, base_faces=4)
    scene, truth = ab.Scene(device), []
    for _ in range(count):
        pose = np.concatenate([rng.normal(size=3), random_poses(rng, 1, 0.0)[0, 3:]])
        inside = size * rng.uniform(-1.2, 1.2, 3)
        speck = posed(inside, pose) + size * 2.0**-10 * corners
        specks = np.concatenate([speck, -speck]), np.concatenate([faces, faces + 4])
        scene.add(ab.Model.from_arrays(*specks, base_faces=8))
        scene.add(solid, pose, solid=True)
        truth.append(solids_intersect(specks, (body.vertices, body.faces), moved(), pose, False, True))
    found = scene.intersect(np.arange(2 * count).reshape(-1, 2), "count")
    meet, held = np.array(truth).T
    assert 30 < held.sum() < count - 30
    np.testing.assert_array_equal(found.count > 0, meet)
    np.testing.assert_array_equal(found.any, meet | held)
