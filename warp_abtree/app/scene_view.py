"""View of a scene, for viewer, pictures and scene files: directions upwards and to the eye, and the world shown."""

from typing import NamedTuple

import numpy as np

from warp_abtree.app.toml.objects import unit
from warp_abtree.lod.view import as_direction


class SceneView(NamedTuple):
    """View of a scene: directions to the eye and upwards, of length 1, and the world that is shown."""

    eye: np.ndarray
    up: np.ndarray
    world: int = 0


def make_view(up="z", eye=None, world: int = 0) -> SceneView:
    """Return a view; raise ValueError for directions that are none, or along each other.

    Args:
        up: Axis, as "z" or "-y", or a direction, (3,).
        eye: Direction to the eye, as up; None is from the front, a little from the right and from above.
        world: World that is shown.
    """
    up = unit(as_direction(up))
    if eye is None:
        right = np.eye(3)[int(abs(up[0]) > 0.9)]
        right = unit(right - (right @ up) * up)
        eye = 0.4 * right + 0.35 * up + np.cross(right, up)
    eye = unit(as_direction(eye, "eye"))
    if not np.linalg.norm(np.cross(eye, up)) > 1e-6:
        raise ValueError("up: points along eye")
    return SceneView(eye, up, world)
