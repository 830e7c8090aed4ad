"""Contact points in closed form, at heights down to rounding: of parallel faces, edges and corners, and of slides."""

import itertools
from functools import cache

import numpy as np
import pytest
import trimesh
from conftest import slow_rows
from helpers.bodies import about, box, make, model_of, open_floor, plain_model
from helpers.samples import STILL
from helpers.scenes import scene_with
from oracles.triangle import quaternion_matrix

import warp_abtree as ab
from warp_abtree.checks.quaternions import multiply_quaternions

GAP, TOLERANCE = 0.01, 1e-6
UP = np.array([0, 0, 1.0])
HEIGHTS = (-1e-9, 0.0, 1e-17, 1e-15, 1e-12, 1e-10, 1e-9, 1e-6, 1e-4, 1e-3)
EDGE_HEIGHTS = (0, 1e-15, 1e-12, 1e-10, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3)
ANGLES = (30, 60, 90, 120, 150)  # of edges [degrees]
SIDE = 4.0  # of floors
CELLS = {"2 faces": (1, 1), "200 faces": (10, 10), "2,000 faces": (32, 32), "24,000 faces": (100, 120)}
COARSE = ("one huge face", "closed", "2 faces")
FLOORS_AND_HEIGHTS = [(floor, height) for floor in (*COARSE, "200 faces", "2,000 faces") for height in HEIGHTS]
FLOORS_AND_HEIGHTS += slow_rows(*(("24,000 faces", height) for height in (0.0, 1e-12, 1e-4)))
# The object with the lower index, and the one that the pair names first.
ORDERS = (("floor", "floor"), ("shape", "shape"), ("floor", "shape"))
TILT = np.array([0.31, -0.52, 0.23, 0.76]) / np.linalg.norm([0.31, -0.52, 0.23, 0.76])


def closed_floor(width, length, splits=0):
    """Return a closed floor whose top is in the plane z = 0."""
    mesh = trimesh.creation.box((width, length, 1)).apply_translation([0, 0, -0.5])
    for _ in range(splits):
        mesh = mesh.subdivide()
    return plain_model(mesh.vertices, mesh.faces)


@cache
def floor_of(name):
    """Return a floor whose top is in the plane z = 0, and the longest edge of its faces there, 0 of few faces."""
    if name in CELLS:
        edge = SIDE * np.hypot(*(1 / np.array(CELLS[name])))
        return open_floor(CELLS[name], (-SIDE / 2,) * 2, (SIDE / 2,) * 2), 0.0 if name in COARSE else edge
    if name == "one huge face":
        return plain_model([[-20, -20, 0], [30, -20, 0], [-20, 30, 0]], [[0, 1, 2]]), 0.0
    return closed_floor(SIDE, SIDE), 0.0


@cache
def shapes():
    """Return closed models by name, which stand on the plane z = 0, exactly."""
    tetrahedron = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.25, 0.25, 0.7]], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
    meshes = {
        "cube": trimesh.creation.box(),
        "slab": trimesh.creation.box((1, 0.6, 0.1)),
        "tetrahedron": trimesh.Trimesh(*tetrahedron, process=False),
        "prism": trimesh.creation.cylinder(0.5, 0.4, sections=6),
    }
    return {name: plain_model(m.vertices - [0, 0, m.bounds[0, 2]], m.faces) for name, m in meshes.items()}


def places():
    """Return places on a floor and turns about z: along the edges of its faces, and any."""
    rng = np.random.default_rng(3)
    return [(0.0, 0.0, 0.0), *map(tuple, rng.uniform((-0.6, -0.6, 0), (0.6, 0.6, 2 * np.pi), (3, 3)).tolist())]


def cases():
    """Return (shape, place, whether all is tilted, order)."""
    return itertools.product(shapes(), places(), (False, True), ORDERS)


def pose_of(place, height, tilted):
    """Return the pose of a shape at a height above a floor.

    That is exact where nothing is tilted. A tilted one is so high up to some 1e-15: at the least heights rounding says
    on which side of the floor a corner is. What is asked of points is the same on either side.
    """
    x, y, turn = place
    turned, origin = np.array(about(UP, turn)), np.array([x, y, height])
    if tilted:
        turned, origin = multiply_quaternions(TILT, turned), quaternion_matrix(TILT) @ origin
    return np.array([*origin, *turned])


def find_points(device, floor, height):
    """Return a list of the points of each case: positions and normals in the frame of the floor, the latter away from
    the floor, and depths."""
    scene, pairs = ab.Scene(device), []
    for name, place, tilted, (lower, first) in cases():
        placed = {
            "floor": (floor_of(floor)[0], (0, 0, 0, *(TILT if tilted else STILL[3:]))),
            "shape": (shapes()[name], pose_of(place, height, tilted)),
        }
        others = {"floor": "shape", "shape": "floor"}
        index = {each: scene.add(placed[each][0], pose=placed[each][1]) for each in (lower, others[lower])}
        pairs.append((index[first], index[others[first]]))
    found = ab.ManifoldQuery(scene, pairs, gap=GAP).run()
    np.testing.assert_array_equal(found.pairs, pairs)
    listed = []
    for p, (_, _, tilted, (_, first)) in enumerate(cases()):
        own = found.points["pair"] == p
        back = quaternion_matrix(TILT) if tilted else np.eye(3)
        away = 1 if first == "floor" else -1
        rows = found.points["point"][own] @ back, away * found.points["normal"][own] @ back
        listed.append((*rows, found.points["depth"][own]))
    return listed


def corners_of(name, place):
    """Return the corners of a shape's bottom above a floor, (n, 2)."""
    vertices = shapes()[name].mesh_at(shapes()[name].lod_max)[0].astype(float)
    bottom = vertices[:, 2] == 0
    if name == "prism":  # the middle of its bottom is a vertex, and no corner
        bottom &= np.hypot(*vertices.T[:2]) > 0.1
    return (vertices[bottom] @ quaternion_matrix(about(UP, place[2])).T)[:, :2] + place[:2]


@pytest.mark.parametrize(("floor", "height"), FLOORS_AND_HEIGHTS)
def test_normals_are_the_floors_depths_minus_the_height_and_every_corner_has_a_point(device, floor, height):
    """On a floor of many faces a point stands for those within a face of it. Points lie between both surfaces."""
    faults = []
    for case, (points, normals, depths) in zip(cases(), find_points(device, floor, height), strict=True):
        angles = np.rad2deg(np.arctan2(np.linalg.norm(np.cross(normals, UP), axis=1), normals @ UP))
        corners = corners_of(*case[:2])
        away = np.linalg.norm(corners[:, None] - points[:, :2], axis=2).min(1, initial=np.inf)
        high = (points[:, 2] > max(0, height) + TOLERANCE) | (points[:, 2] < min(0, height) - TOLERANCE)
        found = {
            "degrees": angles.max(initial=0) if len(normals) else np.inf,
            "missed corners": (away > max(TOLERANCE, floor_of(floor)[1])).sum(),
            "points beside both surfaces": high.sum(),
            "off in depth": np.abs(depths + height).max(initial=0),
        }
        if found["degrees"] > 1 or found["missed corners"] or high.any() or found["off in depth"] > TOLERANCE:
            faults.append((*case, found))
    assert faults == []


@cache
def track(name):
    """Return a floor that is long enough to slide on, its top in the plane z = 0."""
    if name == "closed":
        return closed_floor(16, 8)
    return open_floor({"open": (1, 1), "fine": (150, 80)}[name], (-8, -4), (8, 4))


def slide(device, floor, start, speed, friction, rate):
    """Return how far a cube slides along x in 2 s, and its velocity then; start is its x, height and turn about z."""
    cube = box(0.4, 0.4, 0.4), (start[0], 0.03, 0.2 + start[1], *about(UP, start[2]))
    options = {"friction": friction, "velocity": [(0, 0, 0), (speed, 0, 0)]}
    bodies = make(device, (track(floor), STILL, True), cube, **options)
    for _ in range(2 * rate):
        bodies.step(1 / rate)
    return bodies.poses()[1][0] - start[0], bodies.velocities()[0][1]


SLIDES = [("open", 60, 0.0), ("closed", 60, 0.5), *slow_rows(("fine", 60, 0.5), ("open", 240, 0.0))]


@pytest.mark.parametrize(("floor", "rate", "turn"), SLIDES)
def test_a_cube_keeps_its_speed_or_slides_as_far_as_friction_says(device, floor, rate, turn):
    _, velocity = slide(device, floor, (-3, 0, turn), 2, 0.0, rate)
    np.testing.assert_allclose(velocity, [2, 0, 0], atol=0.01)
    way, _ = slide(device, floor, (-1, 1e-4, turn), 1, 0.3, rate)  # set down too high
    assert way == pytest.approx(1 / (2 * 0.3 * 9.81), abs=0.02)


def wedge(angle, length, points_down=True):
    """Return a prism whose edge, along x through the origin, has so many degrees."""
    half, sense = np.tan(np.radians(angle / 2)), 1 if points_down else -1
    corners = [(x, y, sense * z) for x in (-length / 2, length / 2) for y, z in ((0, 0), (-half, 1), (half, 1))]
    return model_of(trimesh.convex.convex_hull(corners))


def grid(width, length, count):
    """Return an open floor about the origin of so many cells a side."""
    return open_floor((count, count), (-width / 2, -length / 2), (width / 2, length / 2))


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


@pytest.mark.parametrize("floor", [grid(16, 16, 1), grid(16, 16, 4), grid(16, 16, 16), closed_floor(16, 16)])
def test_an_edge_over_a_floor_has_a_point_at_either_end(device, floor):
    """However sharp the edge is, however it leans, and whatever faces of the floor it lies over."""
    rng, placed, told = np.random.default_rng(0), [], []
    for angle, height, leans in itertools.product((3, 30, 60, 90, 120), EDGE_HEIGHTS, (0, 1)):
        length = rng.choice([0.2, 1, 4])
        turn = multiply_quaternions(about(UP, rng.uniform(0, 7)), about((1, 0, 0), leans * rng.uniform(-0.3, 0.3)))
        place = np.array([*rng.uniform(-2, 2, 2), height])
        placed.append(((floor, STILL), (wedge(angle, length), (*place, *turn))))
        told.append((place + [[-length / 2], [length / 2]] * quaternion_matrix(turn)[:, 0], UP, height))
    assert not [told[k] for k, found in enumerate(points_of(device, placed)) if wrong_ends(found, *told[k])]


@pytest.mark.parametrize("plank", [grid(0.5, 6, 1), grid(0.5, 6, 3), closed_floor(0.5, 6), closed_floor(0.5, 6, 1)])
def test_an_edge_across_a_plank_has_points_over_its_rims(device, plank):
    rng, placed, told = np.random.default_rng(1), [], []
    for angle, height, _ in itertools.product(ANGLES, EDGE_HEIGHTS[1:], "ab"):
        turn = about(UP, rng.uniform(-0.9, 0.9))
        place, along = np.array([*rng.uniform(-0.1, 0.1, 2), height]), quaternion_matrix(turn)[:, 0]
        placed.append(((plank, STILL), (wedge(angle, 2), (*place, *turn))))
        told.append((place + [[(rim - place[0]) / along[0]] for rim in (-0.25, 0.25)] * along, UP, height))
    assert not [told[k] for k, found in enumerate(points_of(device, placed)) if wrong_ends(found, *told[k])]


def test_edges_along_one_another_have_points_at_the_ends_of_what_they_share(device):
    rng, placed, told = np.random.default_rng(2), [], []
    for angle, height, _ in itertools.product(ANGLES, EDGE_HEIGHTS[4:], "abc"):
        length, shift, q = rng.choice([1, 4]), rng.uniform(-0.7, 0.7), about(rng.normal(size=3), rng.uniform(0, 3))
        shift, r, t = shift * length, quaternion_matrix(q), rng.uniform(-1, 1, 3)
        turn = multiply_quaternions(q, about((1, 0, 0), rng.uniform(-0.1, 0.1)))
        lower = wedge(rng.choice(ANGLES), length, points_down=False)
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
