"""Cameras, and what a view measures, against plain Python written from section 4.2 of the paper."""

import math

import numpy as np
import pytest
import trimesh
from helpers.bodies import strewn

from warp_abtree.lod.view import Camera, View


def f_printed(alpha, gamma, far, wide):
    return min(max(min((far - alpha) / far, (wide - gamma) / wide), 0.0), 1.0)


def see(camera, point):
    """Project by a 4x4 view matrix; return the distance, and the place on the screen or None behind the camera."""
    matrix = np.eye(4)
    matrix[:3, :3] = camera.view
    matrix[:3, 3] = -camera.view @ camera.eye
    x, y, z, _ = matrix @ [*point, 1.0]
    scale = camera.size[1] / 2 / math.tan(camera.field_of_view / 2)
    place = None if z >= 0 else np.array([scale * x / -z, scale * y / -z])
    return math.dist(point, camera.eye), place


def test_camera_looks_where_it_is_told():
    camera = Camera.look_at((0, 0, 5), (0, 0, 0), size=(200, 100), field_of_view=math.pi / 2)
    assert np.array_equal(camera.view, np.eye(3))
    assert np.allclose(see(camera, (1, 2, 0))[1], [10, 20])
    tilted = Camera.look_at((3, 1, -2), (0, 2, 7), up=(0.1, 1, 0))
    assert np.allclose(tilted.view @ (np.array([0, 2, 7]) - [3, 1, -2]), [0, 0, -math.sqrt(91)])
    assert (tilted.view @ [0.1, 1, 0])[1] > 0


@pytest.mark.parametrize(
    ("wrong", "what"),
    [
        ({"eye": (0, 0)}, "eye"),
        ({"eye": (0, 0, math.nan)}, "eye"),
        ({"view": 2 * np.eye(3)}, "view"),
        ({"view": np.diag([1.0, 1.0, -1.0])}, "view"),
        ({"field_of_view": 0.0}, "field_of_view"),
        ({"field_of_view": math.pi}, "field_of_view"),
        ({"size": (0, 10)}, "size"),
        ({"far": -1.0}, "far"),
        ({"far": math.inf}, "far"),
        ({"target": (0, 0, 1)}, "looks"),
        ({"target": (0, 3, 1)}, "looks"),
    ],
)
def test_camera_refuses(wrong, what):
    with pytest.raises(ValueError, match=what):
        if "target" in wrong:
            Camera.look_at((0, 0, 1), **wrong)
        Camera(**{"eye": (0, 0, 1), "view": np.eye(3), **wrong})


def test_view_measures_distance_motion_and_focus(device):
    """Moving objects, a moving camera, objects beyond D, behind the eye, and passing it."""
    rng = np.random.default_rng(2)
    scene = strewn(40, device)
    view = View(scene, window=3)
    ways, last, before = [], [None] * 40, 0
    for _ in range(8):
        camera = Camera.look_at(rng.uniform(-1, 1, 3), rng.uniform(-5, 5, 3), size=(320, 240), far=3.5)
        poses = np.concatenate([rng.uniform(-4, 4, (40, 3)), rng.normal(size=(40, 4))], axis=1)
        poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
        scene.set_poses(poses)
        view.look(camera)
        view.launch()
        rotation = trimesh.transformations
        alpha, way = np.empty(40), np.zeros(40)
        for i in range(40):
            x, y, z, w = poses[i, 3:]
            turn = rotation.quaternion_matrix([w, x, y, z])[:3, :3]
            centre = scene.models[scene.object_model[i]].centre
            alpha[i], place = see(camera, turn @ centre + poses[i, :3])
            if place is not None and last[i] is not None:
                way[i] = math.dist(place, last[i])
            last[i] = place
        ways.append(way)
        gamma = np.sum(ways[-3:], axis=0)
        focus = [f_printed(a, g, 3.5, 400.0) for a, g in zip(alpha, gamma)]
        assert np.allclose(view.distance.numpy(), alpha, rtol=1e-12)
        assert np.allclose(view.motion.numpy(), gamma, rtol=1e-9)
        assert np.allclose(view.focus.numpy(), focus, atol=1e-9)
        before += sum(place is None for place in last)
    assert 0 < before < 8 * 40 and (alpha > 3.5).any() and 0 < np.mean(np.array(focus) > 0) < 1
