"""The host's search for the nearest faces: boxes may look farther apart than the faces in them, and none is lost."""

import numpy as np
import pytest
from helpers.samples import random_quaternions
from oracles.triangle import quaternion_matrix

import warp_abtree as ab
from warp_abtree.interop.nearest import NodeBoxes, find_nearest, triangle_distances


class Shape:
    """What the search asks of an object."""

    def __init__(self, vertices, faces):
        self.model = ab.Model.from_arrays(vertices, faces, base_faces=10**6)
        self.node_boxes = NodeBoxes(self.model)


def test_frames_off_orthonormal_hide_no_face():
    """Frames are off by as much as scenes take; the faces in which the search begins are not the nearest."""
    skew = 2.0**-22
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [1.0, 0.0, 1.0]])
    near, far = np.array([0.0, 0.0, 0.0]), np.array([1024.0, 0.0, 0.0])
    # In A's frame the nearest faces, 1 apart, look 1.0005 apart; the first are 1 + 2^-16 apart.
    spread, poses = 2.0**-12 * corners, np.tile(np.eye(4), (2, 1, 1))
    a = np.concatenate([near - spread, far - spread])
    b = np.concatenate([near + (1 + 2.0**-16, 0, 0) + spread, far * (1 + skew) + (1, 0, 0) + spread])
    shapes = [Shape(corners, [[0, 1, 2], [3, 4, 5]]) for corners in (a, b)]
    poses[0, :3, :3] *= 1 + skew
    distance, _, faces, _ = find_nearest(shapes, poses, np.array([[0, 1]]), 2.0, 0)
    assert (distance, faces) == (1.0, (1, 1))
    # A pair 1 apart that looks nearer in A's frame leaves another in, 2^-16 nearer than it is.
    spread, poses = 2.0**-20 * corners, np.tile(np.eye(4), (4, 1, 1))
    begins = [far - spread, far * (1 - skew) + (1, 0, 0) + spread, -spread, spread + (1 - 2.0**-16, 0, 0)]
    poses[0, :3, :3] *= 1 - skew
    shapes = [Shape(corners, [[0, 1, 2]]) for corners in begins]
    distance, pair, *_ = find_nearest(shapes, poses, np.array([[0, 1], [2, 3]]), 2.0, 0)
    assert (distance, pair) == (1 - 2.0**-16, 1)


@pytest.mark.parametrize("place", ["turned back", "in their own frames", "in the world"])
def test_roundings_hide_no_face(place):
    """Corners one over the other, far from an origin: boxes keep the distance of the faces, but for rounding."""
    rng = np.random.default_rng(1)
    far = 2.0**20
    for q in random_quaternions(rng, 12):
        poses = np.tile(np.eye(4), (2, 1, 1))
        middle = np.zeros(3)
        if place == "in the world":
            poses[:, :3, 3] = far * q[:3]
        else:
            middle = far * q[:3]
        if place == "turned back":
            poses[:, :3, :3] = quaternion_matrix(q)
            poses[:, :3, 3] = -poses[0, :3, :3] @ middle
        below, above = rng.uniform(0.1, 1.0, (2, 2, 3)) * np.array([[[1, 1, -1]], [[1, 1, 1]]])
        heights = np.array([[0, 0, 0.1], [0, 0, 1.8]])
        corners = [middle + np.concatenate([[z], z + away]) for z, away in zip(heights, (below, above))]
        posed = [part @ pose[:3, :3].T + pose[:3, 3] for part, pose in zip(corners, poses)]
        found = find_nearest([Shape(part, [[0, 1, 2]]) for part in corners], poses, np.array([[0, 1]]), 2.0, 0)
        assert found is not None and found[0] == triangle_distances(posed[0][None], posed[1][None])[0][0]
