"""Contact points of edges: both ends of what an edge shares with a face, or with an edge along it."""

import numpy as np
import pytest
import trimesh
from helpers.bodies import about, box, model_of, open_floor
from helpers.scenes import scene_with
from oracles.triangle import quaternion_matrix

import warp_abtree as ab
from warp_abtree.checks.quaternions import multiply_quaternions

GAP, STILL, UP = 0.01, (0, 0, 0, 0, 0, 0, 1), np.array([0, 0, 1.0])
HEIGHTS = (0, 1e-15, 1e-12, 1e-10, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3)


def wedge(angle, length, points_down=True):
    """Return a prism whose edge, along x through the origin, has so many degrees."""
    half, sense = np.tan(np.radians(angle / 2)), 1 if points_down else -1
    corners = [(x, y, sense * z) for x in (-length / 2, length / 2) for y, z in ((0, 0), (-half, 1), (half, 1))]
    return model_of(trimesh.convex.convex_hull(corners))


def grid(width, length, count):
    """Return an open floor about the origin of so many cells a side."""
    return open_floor((count, count), (-width / 2, -length / 2), (width / 2, length / 2))


def lowered(width, length, splits):
    """Return a closed floor whose top is at 0."""
    plate = trimesh.creation.box((width, length, 1)).apply_translation((0, 0, -0.5))
    for _ in range(splits):
        plate = plate.subdivide()
    return model_of(plate)


def points_of(device, placed):
    """Return the points of pairs of objects side by side: of each pair positions, normals and depths."""
    scene = scene_with(device, *(one for pair in placed for one in pair))
    pairs = [(2 * k, 2 * k + 1) for k in range(len(placed))]
    points = ab.ManifoldQuery(scene, pairs, gap=GAP).run().points
    return [[points[name][points["pair"] == k] for name in ("point", "normal", "depth")] for k in range(len(pairs))]


def wrong_ends(found, ends, up, height):
    """Return whether one of two ends has no point, or a point has another normal or depth."""
    point, normal, depth = found
    if len(point) == 0 or (normal @ up).min() < 0.999 or abs(depth.max() + height) > 1e-8:
        return True
    away = point[:, None] - ends
    away -= (away @ up)[..., None] * up  # a point may lie on either surface
    return np.linalg.norm(away, axis=2).min(0).max() > 1e-6


@pytest.mark.parametrize("floor", [grid(16, 16, 1), grid(16, 16, 4), grid(16, 16, 16), lowered(16, 16, 0)])
def test_an_edge_over_a_floor_has_a_point_at_either_end(device, floor):
    """However sharp the edge is, however it leans, and whatever faces of the floor it lies over."""
    rng, placed, told = np.random.default_rng(0), [], []
    for angle, height, leans in ((a, h, lean) for a in (3, 30, 60, 90, 120) for h in HEIGHTS for lean in (0, 1)):
        length = rng.choice([0.2, 1, 4])
        turn = multiply_quaternions(about(UP, rng.uniform(0, 7)), about((1, 0, 0), leans * rng.uniform(-0.3, 0.3)))
        place = np.array([*rng.uniform(-2, 2, 2), height])
        placed.append(((floor, STILL), (wedge(angle, length), (*place, *turn))))
        told.append((place + [[-length / 2], [length / 2]] * quaternion_matrix(turn)[:, 0], UP, height))
    assert not [told[k] for k, found in enumerate(points_of(device, placed)) if wrong_ends(found, *told[k])]


@pytest.mark.parametrize("plank", [grid(0.5, 6, 1), grid(0.5, 6, 3), lowered(0.5, 6, 0), lowered(0.5, 6, 1)])
def test_an_edge_across_a_plank_has_points_over_its_rims(device, plank):
    rng, placed, told = np.random.default_rng(1), [], []
    for angle, height in ((angle, height) for angle in (30, 60, 90, 120, 150) for height in HEIGHTS[1:] for _ in "ab"):
        turn = about(UP, rng.uniform(-0.9, 0.9))
        place, along = np.array([*rng.uniform(-0.1, 0.1, 2), height]), quaternion_matrix(turn)[:, 0]
        placed.append(((plank, STILL), (wedge(angle, 2), (*place, *turn))))
        told.append((place + [[(rim - place[0]) / along[0]] for rim in (-0.25, 0.25)] * along, UP, height))
    assert not [told[k] for k, found in enumerate(points_of(device, placed)) if wrong_ends(found, *told[k])]


def test_edges_along_one_another_have_points_at_the_ends_of_what_they_share(device):
    rng, placed, told = np.random.default_rng(2), [], []
    for angle, height in ((angle, height) for angle in (30, 60, 90, 120, 150) for height in HEIGHTS[4:] for _ in "abc"):
        length, shift, q = rng.choice([1, 4]), rng.uniform(-0.7, 0.7), about(rng.normal(size=3), rng.uniform(0, 3))
        shift, r, t = shift * length, quaternion_matrix(q), rng.uniform(-1, 1, 3)
        turn = multiply_quaternions(q, about((1, 0, 0), rng.uniform(-0.1, 0.1)))
        lower = wedge(rng.choice([30, 60, 90, 120, 150]), length, points_down=False)
        placed.append(((lower, (*t, *q)), (wedge(angle, length), (*(t + r @ [shift, 0, height]), *turn))))
        ends = np.array([max(-1, 2 * shift / length - 1), min(1, 2 * shift / length + 1)]) * length / 2
        told.append((t + ends[:, None] * r[:, 0], r[:, 2], height))
    assert not [told[k] for k, found in enumerate(points_of(device, placed)) if wrong_ends(found, *told[k])]


def test_a_corner_over_a_floor_has_its_nearest_point_whatever_the_gap(device):
    """Edges that cross aslant do not pass for nearer than it."""
    rng, floor, cube, placed, heights = np.random.default_rng(3), grid(4 * GAP, 4 * GAP, 16), box(GAP, GAP, GAP), [], []
    for part in np.repeat([0.01, 0.1, 0.3, 0.5, 0.9], 30):
        turn, heights = about(rng.normal(size=3), rng.uniform(0.3, 3)), [*heights, part * GAP]
        lowest = -np.abs(quaternion_matrix(turn)[2]).sum() * GAP / 2
        placed.append(((floor, STILL), (cube, (*rng.uniform(-GAP, GAP, 2) / 2, part * GAP - lowest, *turn))))
    for (_, _, depth), height in zip(points_of(device, placed), heights):
        assert depth.max(initial=-np.inf) >= -height * (1 + 1e-3) - 2e-3 * GAP
