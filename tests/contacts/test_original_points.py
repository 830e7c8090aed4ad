"""Contact points of LODs moved to the original surfaces: against nearest points of all original faces, in NumPy."""

import numpy as np
import pytest
import trimesh
from helpers import refused
from helpers.bodies import FLOOR, about, model_of
from helpers.scenes import scene_with
from oracles.distance import brute_distances
from oracles.motion import posed

import warp_abtree as ab

GAP = 0.15


def wavy_plate():
    """Return a plate of gentle waves, and a ball of many faces."""
    plate = trimesh.creation.box((4, 4, 1)).subdivide_loop(0)
    for _ in range(5):
        plate = plate.subdivide()
    x, y, _z = plate.vertices.T
    plate.vertices[:, 2] += np.where(_z > 0, 0.06 * np.sin(3 * x) * np.cos(2 * y), 0)
    return model_of(plate), model_of(trimesh.creation.icosphere(subdivisions=4))


MODELS = wavy_plate()


def world_triangles(pose):
    """Return the original faces of the plate, and of the ball at a pose."""
    meshes = [model.mesh_at(model.lod_max)[:2] for model in MODELS]
    return [posed(vertices, at)[faces] for (vertices, faces), at in zip(meshes, (np.array(FLOOR, float), pose))]


def ask(device, pose, fraction, **options):
    scene = scene_with(device, (MODELS[0], FLOOR), (MODELS[1], pose))
    scene.set_lods([int(fraction * model.lod_max) for model in MODELS])
    return ab.ManifoldQuery(scene, [(0, 1)], **options), scene


def off_middle(points, triangles):
    """Return how far points that are apart are from the middle of two surfaces, and their depths from the distance."""
    apart = points["depth"] < 0
    a, b = (brute_distances(points["point"][apart], own) for own in triangles) if apart.any() else np.zeros((2, 0))
    return [*zip(np.abs(a - b), np.abs(a + b + points["depth"][apart]))]


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_points_lie_in_the_middle_of_both_originals(device, order):
    """As far from the nearest original face of either, and their depths are these distances, whatever the LODs say.

    Each lies between the points nearest to where the LODs had it, which differ from the nearest of all in second order.
    """
    rng, off, coarse = np.random.default_rng(0), [], []
    for _ in range(10):
        pose = np.array([*rng.uniform(-0.8, 0.8, 2), 1.0 + rng.uniform(-0.01, 0.1), *about(rng.normal(size=3), 3.0)])
        query, scene = ask(device, pose, 0.08, gap=GAP, originals=True)
        query.set_pairs([order])
        points = query.run().points
        triangles = world_triangles(pose)
        off += off_middle(points, triangles)
        coarse += off_middle(ab.ManifoldQuery(scene, [order], gap=GAP).run().points, triangles)
        assert (points["depth"] > -GAP).all()
        assert (points["normal"][:, 2] * (1 if order == (0, 1) else -1) > 0.5).all()
    assert len(off) > 20
    assert (np.median(off, axis=0) < 0.1 * np.median(coarse, axis=0)).all()
    assert np.max(off) < 0.03 * GAP


@pytest.mark.parametrize("gap", [None, GAP])
def test_the_finest_lods_stay_as_they_are(device, gap):
    pose = np.array([0.3, 0.2, 1.0, *about((1, 2, 3), 0.7)])
    found = []
    for originals in (False, True):
        points = ask(device, pose, 1.0, gap=gap, originals=originals)[0].run().points
        found.append([np.ascontiguousarray(values).tobytes() for values in points.values()])
    assert found[0] == found[1] and len(found[0][0])


def test_without_a_gap_points_are_inside(device):
    """What crosses at the LODs alone has no points."""
    for height, meets in ((1.03, True), (1.058, False)):  # a crest is at 0.06, coarse ones are higher
        query, _ = ask(device, np.array([np.pi / 6 + 0.1, 0.1, height, 0, 0, 0, 1.0]), 0.05, originals=True)
        result = query.run()
        depth = result.points["depth"]
        assert (depth >= 0).all() and (len(depth) > 0 or not meets)


def test_lods_and_poses_that_change_are_followed(device):
    """The originals follow poses, and what is kept of a pair that rests are points on them."""
    pose = np.array([np.pi / 6, 0, 1.1, 0, 0, 0, 1.0])
    query, scene = ask(device, pose, 0.05, gap=GAP, originals=True, remember=0.01)
    query.run()
    pose[2] -= 0.02
    scene.set_poses([FLOOR, pose])
    scene.set_lods([int(0.1 * model.lod_max) for model in MODELS])
    points = query.run().points
    depth = points["depth"].max()
    assert 0 < np.max(off_middle(points, world_triangles(pose))) < 0.01 * GAP
    pose[2] -= 0.005
    scene.set_poses([FLOOR, pose])
    again = query.run().points["depth"].max()
    assert query.memory.place.numpy()[0] == 0 and again == pytest.approx(depth + 0.005, abs=1e-4)
    refused(ValueError, "originals", ab.ManifoldQuery, scene, originals=1)
