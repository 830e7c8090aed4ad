"""Depth and contact points of solids: the deepest samples inside, by brute force, closed forms, and ways out."""

from functools import partial

import numpy as np
import pytest
import trimesh
from helpers import refused
from helpers.bodies import about
from helpers.questions import captured
from helpers.samples import corners_of, model_of_faces, random_poses
from helpers.scenes import scene_with
from helpers.solids import ask, lattice_pose, model_of, moved, shell, voxel_mesh
from oracles.distance import brute_distances
from oracles.inside import parity
from oracles.motion import posed
from oracles.triangle import into_frame_of_a

import warp_abtree as ab

BOX = ab.Model.load(trimesh.creation.box((4, 4, 4)))
BALL = ab.Model.load(trimesh.creation.icosphere(2, 0.5), base_faces=4)
DEPTH = {"output": "distance", "signed": True}
KNOT = ab.Model.load(trimesh.creation.torus(1, 0.45, major_sections=14, minor_sections=8), base_faces=4)


def samples(triangles):
    """Corners, middles of edges and centroids, (7 n, 3)."""
    middles = (triangles + np.roll(triangles, -1, axis=1)) / 2
    return np.concatenate([triangles, middles, triangles.mean(1, keepdims=True)], axis=1).reshape(-1, 3)


def greatest_depth(points, outer):
    """Return the greatest depth of points in a surface, by brute force: 0 where all are outside, or on it."""
    near = ((points >= outer.min((0, 1))) & (points <= outer.max((0, 1)))).all(1)
    points = np.unique(points[near], axis=0)
    depths = brute_distances(points, outer) if len(points) else np.zeros(0)
    return next((depths[k] for k in np.argsort(-depths) if depths[k] > 1e-12 and parity(points[k], outer)), 0.0)


def check_row(result, row, meshes, poses, solid):
    """Compare one pair that intersects with brute force, and its witnesses with the meshes; return the depth."""
    a, b = sorted(result.pairs[row].tolist())
    other = into_frame_of_a(meshes[b][0], poses[a], poses[b])[meshes[b][1]]
    own = meshes[a][0][meshes[a][1]]
    depths = [greatest_depth(samples(own), other), greatest_depth(samples(other), own)]
    expected = max(depths[0] * solid[b], depths[1] * solid[a])
    depth = -result.distance[row]
    assert abs(depth - expected) <= 1e-12
    if depth > 0:
        lower, upper = result.bracket[row]
        assert lower <= -expected <= upper and upper - lower < 1e-11
        gap = result.points[row, 0] - result.points[row, 1]
        assert abs(np.linalg.norm(gap) - depth) < 1e-12
        for k, which in enumerate(result.pairs[row]):
            vertices, faces, ids = meshes[which]
            face = posed(vertices[faces[np.flatnonzero(ids == result.point_faces[row, k])[0]]], poses[which])
            near = trimesh.triangles.closest_point(face[None], result.points[row, k][None])
            assert np.linalg.norm(near - result.points[row, k]) < 1e-12
    return depth


@pytest.mark.parametrize("seed", range(2))
def test_depths_are_those_of_brute_force(device, seed):
    rng = np.random.default_rng(seed)
    scene = scene_with(device, *[((KNOT, BALL)[i % 2], moved(), {"solid": i % 4 != 3}) for i in range(8)])
    pairs = np.array([(i, j) for i in range(8) for j in range(i)])
    pairs[::2] = pairs[::2, ::-1]
    deep = 0
    for fraction in (1.0, 0.2):
        lods = np.array([scene.models[m].lod_for(fraction=fraction) for m in scene.object_model])
        scene.set_lods(lods)
        poses = random_poses(rng, 8, 0.7)
        scene.set_poses(poses)
        result, plain = scene.intersect(pairs, "distance", signed=True), scene.intersect(pairs, "distance")
        meshes = [scene.models[m].mesh_at(lod) for m, lod in zip(scene.object_model, lods)]
        np.testing.assert_array_equal(result.any, plain.any)
        np.testing.assert_array_equal(np.maximum(result.distance, 0), plain.distance)
        for row in np.flatnonzero(result.any)[:: 1 if fraction < 1 else 8]:
            deep += check_row(result, row, meshes, poses, scene.object_solid) > 0
    assert deep > 10


def test_closed_forms(device):
    """A ball sinks into a floor past whole rings of faces; a peg too thick for its hole; bodies of equal size."""
    for solid in (False, True):
        for sink in (1e-6, 0.1, 0.5, 0.9, 1.4):
            found = ask(device, [(BOX, moved(), True), (BALL, moved(z=2.5 - sink), solid)], **DEPTH)
            assert found.distance[0] == pytest.approx(-sink, rel=1e-9)
            way = found.points[0, 0] - found.points[0, 1]
            np.testing.assert_allclose(way / np.linalg.norm(way), [0, 0, 1], atol=1e-6)
    peg = trimesh.creation.cylinder(1.01, 4, sections=64)
    plate = trimesh.creation.annulus(0.99, 2, 1, sections=64)
    peg, plate = ab.Model.load(peg), ab.Model.load(plate)
    found = ask(device, [(peg, moved(), True), (plate, moved(), True)], **DEPTH)
    assert -0.021 < found.distance[0] < -0.019
    # Laid on one another, side on side, with all corners on the other's sides.
    for z, expected in ((3.9, -0.1), (4.0, 0.0), (4.5, 0.5)):
        found = ask(device, [(BOX, moved(), True), (BOX, moved(z=z), True)], **DEPTH)
        assert found.distance[0] == pytest.approx(expected, abs=1e-12)
    # Coincident: every sample lies on the other surface.
    assert ask(device, [(BOX, moved(), True), (BOX, moved(), True)], **DEPTH).distance[0] == 0

    # In a cavity distances stay positive.
    hollow = model_of(voxel_mesh(shell(5)), "hollow")
    found = ask(device, [(hollow, moved(), True), (BALL, moved(2.5, 2.5, 2.5), True)], **DEPTH)
    assert 0.99 < found.distance[0] < 1.01
    found = ask(device, [(hollow, moved(), True), (BALL, moved(2.5, 2.5, 1.0), True)], **DEPTH)
    assert found.distance[0] < -0.4


def test_the_same_bits_in_any_order_and_batch(device):
    rng = np.random.default_rng(7)
    scene = scene_with(device, *zip((KNOT, BALL) * 5, random_poses(rng, 10, 0.8)), solid=True)
    pairs = np.array([(i, j) for i in range(10) for j in range(i)])
    first = scene.intersect(pairs, "distance", signed=True)
    order = rng.permutation(len(pairs))
    again = scene.intersect(pairs[order][:, ::-1], "distance", signed=True)
    for name in ("distance", "bracket"):
        assert getattr(first, name)[order].tobytes() == getattr(again, name).tobytes()
    assert first.points[order][:, ::-1].tobytes() == again.points.tobytes()
    np.testing.assert_array_equal(first.point_faces[order][:, ::-1], again.point_faces)
    assert (first.distance < 0).sum() > 5
    single = [scene.intersect(pairs[[k]], "distance", signed=True).distance[0] for k in range(len(pairs))]
    assert np.array(single).tobytes() == first.distance.tobytes()


def test_lattice_bodies(device):
    """Samples on edges, corners and planes of the other."""
    rng = np.random.default_rng(11)
    deep = 0
    for _ in range(60):
        bodies = [voxel_mesh(rng.integers(0, 3, (8, 3)), rng) for _ in range(2)]
        poses = lattice_pose(rng, 1), lattice_pose(rng, 1)
        models = [model_of((vertices * (1, 0.5)[k], faces)) for k, (vertices, faces) in enumerate(bodies)]
        found = ask(device, list(zip(models, poses, (True, True))), **DEPTH)
        if found.any[0]:
            own = corners_of(models[0])
            other = into_frame_of_a(corners_of(models[1]).reshape(-1, 3), *poses).reshape(-1, 3, 3)
            expected = max(greatest_depth(samples(own), other), greatest_depth(samples(other), own))
            assert -found.distance[0] == pytest.approx(expected, abs=1e-12)
            deep += expected > 0
    assert deep > 2


def test_sweeps_and_captured_queries(device):
    poses = np.array([moved(z=z) for z in (0.0, 2.4, 2.6, 3.0)])
    found = ab.sweep(BOX, BALL, poses, output="distance", device=device, solid=True, signed=True)
    np.testing.assert_allclose(found["distance"][1:], [-0.1, 0.1, 0.5], atol=1e-9)
    assert found["distance"][0] < -1.5
    plain = ab.sweep(BOX, BALL, poses, output="distance", device=device, solid=True)
    np.testing.assert_array_equal(plain["distance"], np.maximum(found["distance"], 0))
    refused(ValueError, "signed 1 is neither", ab.sweep, BOX, BALL, poses, output="distance", device=device, signed=1)
    refused(ValueError, "signed means nothing", ab.sweep, BOX, BALL, poses, output="any", device=device, signed=True)
    scene = scene_with(device, BOX, (BALL, poses[0]), solid=True)
    query = ab.DistanceQuery(scene, np.array([(0, 1)]), signed=True)
    replay = captured(query)
    for k, pose in enumerate(poses):
        scene.set_poses(np.array([moved(), pose]))
        replay()
        assert query.result().distance[0] == found["distance"][k]


@pytest.mark.parametrize("with_solid", [False, True])
@pytest.mark.parametrize("pairs", [None, [(0, 1)], [(0, 1), (2, 1)], []], ids=str)
def test_depths_of_surfaces_are_refused(device, pairs, with_solid):
    """Of three surfaces, beside which a solid stands or does not."""
    beside = BOX, moved(50.0), {"solid": with_solid}
    scene = scene_with(device, *[(BALL, moved(x)) for x in (0.0, 1.0, 1.5)], beside)
    asks = [partial(scene.intersect, pairs, "distance", signed=True)]
    asks.append(lambda: ab.DistanceQuery(scene, pairs, signed=True).run())
    if pairs is not None and with_solid:
        asks.append(partial(ab.DistanceQuery(scene, [(0, 3)], signed=True).set_pairs, pairs))
    # Of no pair at all nothing is wrong; nor of what the broad phase happens to find in a scene with a solid.
    for ask_it in asks:
        if with_solid and not pairs:
            ask_it()
        else:
            refused(ValueError, r"^signed: no object of the pairs is a solid", ask_it)
    refused(ValueError, "signed means nothing", scene.intersect, [(0, 1)], "any", signed=True)
    if with_solid:
        mixed, plain = (scene.intersect([(0, 1), (0, 3)], "distance", signed=signed) for signed in (True, False))
        np.testing.assert_array_equal(mixed.distance, plain.distance)


@pytest.mark.parametrize("count", [0, 3])
def test_depths_of_surfaces_in_sweeps_are_refused(device, count):
    poses = np.array([moved(0.5)] * 3)[:count]
    refused(ValueError, r"^signed: no object of the pairs", ab.sweep, BALL, BOX, poses, device=device, **DEPTH)
    for solid in ((True, False), (False, True)):
        assert len(ab.sweep(BALL, BOX, poses, device=device, solid=solid, **DEPTH)) == count


def test_depths_after_the_broad_phase_found_surfaces_alone(device):
    sheet = model_of_faces([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    scene = scene_with(device, (BOX, {"solid": True}), (BALL, moved(20)), (sheet, moved(40)), (sheet, moved(40.01)))
    apart = scene.intersect(None, "distance", signed=True)
    assert apart.pairs.tolist() == [[2, 3]] and apart.distance[0] == 0
    scene.set_poses([moved(), moved(), moved(40), moved(40)])
    expected = ab.DistanceQuery(scene, [(0, 1)], signed=True).run().distance
    assert scene.intersect([(0, 1)], "distance", signed=True).distance == expected < 0


SLAB = ab.Model.load(trimesh.creation.box((4, 4, 2)))
RING = ab.Model.load(trimesh.creation.torus(0.6, 0.25, 18, 10), base_faces=4)
SMALL = ab.Model.load(trimesh.creation.icosphere(1, 0.2), base_faces=4)


def points_of(device, placed, solid=True, **options):
    """Return the contact points of (model, pose) in a scene, and the result."""
    result = ab.ManifoldQuery(scene_with(device, *placed, solid=solid), pairs=[(0, 1)], **options).run()
    return result.points, result


def triangles_of(model, pose):
    """Return the corners of the faces in the world, (n, 3, 3)."""
    return posed(corners_of(model), np.asarray(pose))


def depth_in(point, triangles):
    """Return the distance of a point from a surface, and the nearest point."""
    near = trimesh.triangles.closest_point(triangles, np.tile(point, (len(triangles), 1)))
    away = np.linalg.norm(near - point, axis=1)
    return away.min(), near[away.argmin()]


@pytest.mark.parametrize("models", [(BALL, RING), (RING, RING)])
def test_a_pair_is_as_deep_as_its_deepest_corner(device, models):
    """Of corners whose way out is on the side of the others'; and never deeper than any way out."""
    rng = np.random.default_rng(2)
    added = 0
    for _ in range(4):
        poses = random_poses(rng, 2, 0.35)
        points, result = points_of(device, list(zip(models, poses)))
        plain, _ = points_of(device, list(zip(models, poses)), solid=False)
        if not result.any[0]:
            continue
        assert len(points["pair"]) <= 8
        sides = [triangles_of(*placed) for placed in zip(models, poses)]
        deepest = max(greatest_depth(a.reshape(-1, 3), b) for a, b in (sides, sides[::-1]))
        known = {tuple(x) for x in plain["point"].tolist()}
        for x, normal, depth in zip(*(points[name] for name in ("point", "normal", "depth"))):
            if tuple(x.tolist()) in known:
                continue
            added += 1
            # Of a corner of the first object in the second the way out is against the normal.
            inside = [np.abs(side.reshape(-1, 3) - x).max(1).min() < 1e-12 for side in sides]
            assert sum(inside) == 1, "it is a corner of one of both"
            outer = sides[1] if inside[0] else sides[0]
            expected, foot = depth_in(x, outer)
            assert depth == pytest.approx(expected, abs=1e-12) and depth <= deepest + 1e-12
            assert parity(x, outer)
            np.testing.assert_allclose(normal, (x - foot if inside[0] else foot - x) / expected, atol=1e-9)
    assert added > 1


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_ring_that_has_gone_under_is_as_deep_as_it_is(device, order):
    """Whole rings of faces are under the surface; without solids depth is that of the faces that cross."""
    for sink in (0.15, 0.2, 0.3):
        placed = [(SLAB, (0, 0, -1, 0, 0, 0, 1)), (RING, (0.1, 0.2, 0.25 - sink, *about((0, 0, 1), 0.1)))]
        low = -triangles_of(*placed[1])[..., 2].min()
        points, _ = points_of(device, [placed[k] for k in order])
        plain, _ = points_of(device, [placed[k] for k in order], solid=False)
        assert points["depth"].max() == pytest.approx(low, abs=1e-12)
        assert plain["depth"].max() < 0.8 * low
        up = 1 if order == (0, 1) else -1
        deep = points["depth"] > 0.9 * low
        assert deep.sum() == 4, "far from one another"
        np.testing.assert_allclose(points["normal"][deep], [[0, 0, up]] * 4, atol=1e-9)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_what_lies_inside_whole_has_points_that_push_it_out_one_way(device, order):
    placed = [(SLAB, (0, 0, -1, 0, 0, 0, 1)), (SMALL, (0.3, 0.2, -0.8, *about((1, 2, 3), 0.3)))]
    points, result = points_of(device, [placed[k] for k in order])
    assert result.any[0] and result.count[0] == 0
    assert 1 <= len(points["pair"]) <= 4
    up = 1 if order == (0, 1) else -1
    np.testing.assert_allclose(points["normal"], [[0, 0, up]] * len(points["pair"]), atol=1e-9)
    np.testing.assert_allclose(points["depth"], -points["point"][:, 2], atol=1e-12)
    assert points["depth"].max() == pytest.approx(-triangles_of(*placed[1])[..., 2].min(), abs=1e-12)
    assert not points_of(device, placed, solid=False)[0]["pair"].size


def test_solids_whose_contacts_know_their_depth_keep_their_points(device):
    """To the bit: boxes on one another, and what only touches."""
    for z in (0.5, 0.499, 0.45):
        placed = [(SLAB, (0, 0, -1, 0, 0, 0, 1)), (ab.Model.load(trimesh.creation.box()), (0, 0, z, 0, 0, 0, 1))]
        with_solids, without = (points_of(device, placed, solid=solid)[0] for solid in (True, False))
        for name, values in without.items():
            assert np.array_equal(values, with_solids[name]), name


def test_bodies_that_are_deep_in_a_solid_come_out(device):
    for model, z in ((SMALL, -0.8), (RING, 0.0)):
        ground = (SLAB, (0, 0, -1, 0, 0, 0, 1), {"static": True, "solid": True})
        bodies = ab.Dynamics(scene_with(device, ground, (model, (0, 0, z, 0, 0, 0, 1))))
        for _ in range(60):
            bodies.step(1 / 60)
        low = triangles_of(model, bodies.poses()[1])[..., 2].min()
        assert abs(low) < 0.005 and abs(bodies.velocities()[0][1, 2]) < 0.1
