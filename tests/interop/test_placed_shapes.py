"""Bounds of distances by the boxes of placed shapes, against fractions; the pair that is looked at first."""

from fractions import Fraction
from itertools import product

import numpy as np
import pytest
import trimesh
from helpers.questions import to_matrix
from helpers.samples import random_quaternions
from helpers.scenes import scene_with
from oracles.triangle import quaternion_matrix
from trimesh.transformations import translation_matrix

import warp_abtree as ab
from warp_abtree.interop import placed_shapes
from warp_abtree.interop.placed_shapes import PlacedShapes, Shape

STRETCH = 4.9e-7  # of a frame; more is refused


def fractions(x):
    """Return numbers as fractions, an array of objects."""
    return np.vectorize(lambda v: Fraction(float(v)), otypes=[object])(x)


def face_at(rng, corner, size):
    """Return the shape of a face with a given corner, from which it reaches so far."""
    points = corner + size * np.concatenate([np.zeros((1, 3)), rng.normal(size=(2, 3))])
    return Shape(ab.Model.from_arrays(points, [[0, 1, 2]]))


def place(shapes, poses):
    """Return placed shapes without objects on a device, of which bounds need none."""
    placed = PlacedShapes("cpu", False)
    placed.shapes, placed.poses = list(shapes), list(poses)
    return placed


def least_square(shapes, poses):
    """Return the square of the least distance of two shapes' vertices in the frame of the first, a fraction."""
    (a, b), (pose_a, pose_b) = (
        [fractions(x) for x in each] for each in ([np.unique(s.corners, axis=0) for s in shapes], poses)
    )
    to_a = pose_a[:3, :3].T
    there = (b @ pose_b[:3, :3].T + pose_b[:3, 3] - pose_a[:3, 3]) @ to_a.T
    return min(sum((q - p) ** 2) for p, q in product(a, there))


# How far the faces are from their own origins and these from the world's, the faces' size, and how far they are apart.
PLACES = {
    "near": (1.0, 1.0, 1.0, 1e-3),
    "far apart": (0.0, 0.0, 1e-3, 100.0),
    "far from their origins": (1e3, 1.0, 1e-3, 1e-9),
    "far from their origins, less near": (1e3, 1.0, 1e-4, 2e-3),
    "far from the world's": (0.0, 1e4, 1e-6, 1e-9),
}


@pytest.mark.parametrize("stretch", [0.0, STRETCH, -STRETCH])
@pytest.mark.parametrize("where", PLACES)
def test_bounds_by_boxes_are_no_more_than_distances(where, stretch):
    """Boxes with a corner at the nearest vertex: along the axes of frames that are turned by quarters, or a little."""
    rng, close = np.random.default_rng(3), 0
    own, world, size, apart = PLACES[where]
    for turn in range(24):
        rotations = (
            [np.eye(3), np.eye(3)[[1, 2, 0]]] if turn % 2 else map(quaternion_matrix, random_quaternions(rng, 2))
        )
        stretches = (stretch, 0.0) if turn % 4 < 2 else (stretch, -stretch)
        along = np.eye(3) if turn % 3 else np.ones((3, 3))  # all ways alike, or one way thrice as much
        rotations = [r @ (np.eye(3) + s * along) for r, s in zip(rotations, stretches)]
        corners = own * rng.normal(size=(2, 3))
        way = np.ones(3) / 3**0.5 if turn % 6 == 3 else np.eye(3)[turn % 3] * (1 if turn % 8 < 4 else -1)
        place_a = world * rng.normal(size=3)
        place_b = rotations[0] @ corners[0] + place_a + apart * way - rotations[1] @ corners[1]
        shapes = [face_at(rng, corner, size) for corner in corners]
        poses = [to_matrix(*pose) for pose in zip(rotations, (place_a, place_b))]
        (gap,) = place(shapes, poses).gaps(np.array([[0, 1]]))
        square = least_square(shapes, poses)
        assert Fraction(gap) ** 2 <= square
        close += gap > 0.5 * float(square) ** 0.5
    assert where != "far apart" or close == 24


def test_the_pair_of_the_nearest_corners_is_looked_at_first(monkeypatch):
    """Whatever the number of pairs at a time, among pairs whose boxes may be nearer than their corners."""
    rng = np.random.default_rng(4)
    shapes = [face_at(rng, np.zeros(3), 0.3) for _ in range(9)]
    poses = [to_matrix(quaternion_matrix(q), 3 * rng.normal(size=3)) for q in random_quaternions(rng, 9)]
    placed, pairs = place(shapes, poses), np.stack(np.triu_indices(9, 1), 1)
    squares = [least_square([shapes[i] for i in pair], [poses[i] for i in pair]) for pair in pairs]
    for order in (np.argsort(squares), np.argsort(squares)[::-1], rng.permutation(len(pairs))):
        gaps = placed.gaps(pairs[order])
        for count in (1, 5, 2**16):
            monkeypatch.setattr(placed_shapes, "PAIRS_AT_ONCE", count)
            assert order[placed.find_likely(pairs[order], gaps)] == np.argmin(squares)


def test_the_least_distance_may_be_that_of_a_frame_off_orthonormal(device):
    """Of two pairs, each 100 apart about, that which the stretch brings nearer, though not by its corners."""
    box, manager = trimesh.creation.box((1, 1, 1)), ab.CollisionManager(device)
    shrunk = np.diag([1 - STRETCH] * 3 + [1])
    manager.add_object("shrunk", box, shrunk)
    manager.add_object("beside it", box, translation_matrix((101, 0, 0)))
    manager.add_object("first", box, translation_matrix((0, 1e4, 0)))
    manager.add_object("second", box, translation_matrix((101 - 50 * STRETCH, 1e4, 0)))
    model = ab.Model.load(box)
    scene = scene_with(device, (model, shrunk), (model, translation_matrix((101, 0, 0))))
    expected = scene.intersect([(0, 1)], "distance").distance[0]
    assert 100 - 101 * STRETCH < expected < 100 - 60 * STRETCH
    distance, names = manager.min_distance_internal(return_names=True)
    assert (distance, names) == (expected, ("beside it", "shrunk"))
