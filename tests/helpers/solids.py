"""Closed meshes with awkward corners: surfaces of voxels, and what lies between them."""

import numpy as np

import warp_abtree as ab
from helpers.questions import QUARTERS, to_matrix
from helpers.scenes import scene_with

# The two triangles of a unit square's sides, by corners of the cube in binary, outwards.
SQUARES = {
    (-1, 0, 0): (4, 6, 2, 0),
    (1, 0, 0): (3, 7, 5, 1),
    (0, -1, 0): (1, 5, 4, 0),
    (0, 1, 0): (6, 7, 3, 2),
    (0, 0, -1): (2, 3, 1, 0),
    (0, 0, 1): (5, 7, 6, 4),
}


def voxel_mesh(cells, rng=None):
    """Return the surface of cells, int (k, 3), with integer corners: vertices and faces, wound outwards.

    Faces come in random order with random diagonals where `rng` is given.
    """
    cells = {tuple(cell) for cell in np.asarray(cells).tolist()}
    corners, faces = {}, []
    for cell in sorted(cells):
        for side, square in SQUARES.items():
            if tuple(np.add(cell, side).tolist()) in cells:
                continue
            points = [tuple(np.add(cell, (k & 1, k >> 1 & 1, k >> 2)).tolist()) for k in square]
            a, b, c, d = (corners.setdefault(point, len(corners)) for point in points)
            cut = rng is not None and rng.random() < 0.5
            faces += [(b, c, d), (b, d, a)] if cut else [(a, b, c), (a, c, d)]
    faces = np.array(faces)
    return np.array(list(corners), float), faces if rng is None else faces[rng.permutation(len(faces))]


def shell(size):
    grid = np.indices((size, size, size)).reshape(3, -1).T
    return grid[((grid == 0) | (grid == size - 1)).any(1)]


def lattice_pose(rng, reach):
    return to_matrix(QUARTERS[rng.integers(len(QUARTERS))], rng.integers(-reach, reach + 1, 3))


def model_of(mesh, name="voxels"):
    return ab.Model.from_arrays(*mesh, base_faces=4, name=name)


def ask(device, placed, pairs=((0, 1),), output="any", **options):
    """Return the result for objects given as (model, pose, whether it is a solid)."""
    scene = scene_with(device, *[(model, pose, {"solid": solid}) for model, pose, solid in placed])
    return scene.intersect(np.array(pairs), output, **options)


def moved(x=0.0, y=0.0, z=0.0):
    return (x, y, z, 0, 0, 0, 1)


def turned(faces, chosen):
    return np.where(np.asarray(chosen)[:, None], faces[:, ::-1], faces)
