"""Contact points of solids: as deep as the deepest corner inside, by brute force, and a way out of what is inside."""

import numpy as np
import pytest
import trimesh
from helpers.bodies import about, model_of
from helpers.samples import random_poses
from helpers.scenes import scene_with
from oracles.inside import parity
from oracles.motion import posed

import warp_abtree as ab

BOX = ab.Model.load(trimesh.creation.box((4, 4, 2)))
BALL = model_of(trimesh.creation.icosphere(2, 0.5))
RING = model_of(trimesh.creation.torus(0.6, 0.25, 18, 10))
SMALL = model_of(trimesh.creation.icosphere(1, 0.2))


def points_of(device, placed, solid=True, **options):
    """Return the contact points of (model, pose) in a scene, and the result."""
    result = ab.ManifoldQuery(scene_with(device, *placed, solid=solid), pairs=[(0, 1)], **options).run()
    return result.points, result


def triangles_of(model, pose):
    """Return the corners of the faces in the world, (n, 3, 3)."""
    vertices, faces, _ = model.mesh_at(model.lod_max)
    return posed(vertices, np.asarray(pose))[faces]


def depth_in(point, triangles):
    """Return the distance of a point from a surface, and the nearest point."""
    near = trimesh.triangles.closest_point(triangles, np.tile(point, (len(triangles), 1)))
    away = np.linalg.norm(near - point, axis=1)
    return away.min(), near[away.argmin()]


def greatest_depth(inner, outer):
    """Greatest depth of corners of one surface inside the other, by brute force."""
    corners = np.unique(inner.reshape(-1, 3), axis=0)
    corners = corners[((corners > outer.min((0, 1))) & (corners < outer.max((0, 1)))).all(1)]
    depths = np.array([depth_in(x, outer)[0] for x in corners])
    return next((depths[k] for k in np.argsort(-depths) if parity(corners[k], outer)), 0.0)


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
        deepest = max(greatest_depth(*sides), greatest_depth(*sides[::-1]))
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
        placed = [(BOX, (0, 0, -1, 0, 0, 0, 1)), (RING, (0.1, 0.2, 0.25 - sink, *about((0, 0, 1), 0.1)))]
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
    placed = [(BOX, (0, 0, -1, 0, 0, 0, 1)), (SMALL, (0.3, 0.2, -0.8, *about((1, 2, 3), 0.3)))]
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
        placed = [(BOX, (0, 0, -1, 0, 0, 0, 1)), (model_of(trimesh.creation.box((1, 1, 1))), (0, 0, z, 0, 0, 0, 1))]
        with_solids, without = (points_of(device, placed, solid=solid)[0] for solid in (True, False))
        for name, values in without.items():
            assert np.array_equal(values, with_solids[name]), name


def test_bodies_that_are_deep_in_a_solid_come_out(device):
    for model, z in ((SMALL, -0.8), (RING, 0.0)):
        ground = (BOX, (0, 0, -1, 0, 0, 0, 1), {"static": True, "solid": True})
        bodies = ab.Dynamics(scene_with(device, ground, (model, (0, 0, z, 0, 0, 0, 1))))
        for _ in range(60):
            bodies.step(1 / 60)
        low = triangles_of(model, bodies.poses()[1])[..., 2].min()
        assert abs(low) < 0.005 and abs(bodies.velocities()[0][1, 2]) < 0.1
