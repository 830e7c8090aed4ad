"""Contact points of parallel faces: normals at heights down to rounding, all corners, and bodies that slide there."""

import itertools
from functools import cache

import numpy as np
import pytest
import trimesh
from conftest import slow_rows
from helpers.bodies import about, box, make, open_floor, plain_model
from helpers.samples import STILL
from oracles.triangle import quaternion_matrix

import warp_abtree as ab
from warp_abtree.checks.quaternions import multiply_quaternions

GAP, TOLERANCE = 0.01, 1e-6
UP = np.array([0, 0, 1.0])
HEIGHTS = (-1e-9, 0.0, 1e-17, 1e-15, 1e-12, 1e-10, 1e-9, 1e-6, 1e-4, 1e-3)
SIDE = 4.0  # of floors
CELLS = {"2 faces": (1, 1), "200 faces": (10, 10), "2,000 faces": (32, 32), "24,000 faces": (100, 120)}
COARSE = ("one huge face", "closed", "2 faces")
FLOORS_AND_HEIGHTS = [(floor, height) for floor in (*COARSE, "200 faces", "2,000 faces") for height in HEIGHTS]
FLOORS_AND_HEIGHTS += slow_rows(*(("24,000 faces", height) for height in (0.0, 1e-12, 1e-4)))
# The object with the lower index, and the one that the pair names first.
ORDERS = (("floor", "floor"), ("shape", "shape"), ("floor", "shape"))
TILT = np.array([0.31, -0.52, 0.23, 0.76]) / np.linalg.norm([0.31, -0.52, 0.23, 0.76])


@cache
def floor_of(name):
    """Return a floor whose top is in the plane z = 0, and the longest edge of its faces there, 0 of few faces."""
    if name in CELLS:
        edge = SIDE * np.hypot(*(1 / np.array(CELLS[name])))
        return open_floor(CELLS[name], (-SIDE / 2,) * 2, (SIDE / 2,) * 2), 0.0 if name in COARSE else edge
    if name == "one huge face":
        return plain_model([[-20, -20, 0], [30, -20, 0], [-20, 30, 0]], [[0, 1, 2]]), 0.0
    mesh = trimesh.creation.box((SIDE, SIDE, 1)).apply_translation([0, 0, -0.5])
    return plain_model(mesh.vertices, mesh.faces), 0.0


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
        mesh = trimesh.creation.box((16, 8, 1)).apply_translation([0, 0, -0.5])
        return plain_model(mesh.vertices, mesh.faces)
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
