"""Orientation of closed parts of one mesh: winding numbers by exact rays are 1 in what parity calls inside, else 0."""

from fractions import Fraction

import numpy as np
import pytest
import trimesh
from helpers.solids import shell, turned, voxel_mesh
from oracles.inside import winding_number

from warp_abtree.model.mesh import describe_mesh, mesh_from_arrays, orient_mesh
from warp_abtree.model.winding import find_winding

BALL = trimesh.creation.icosphere(1)
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)


def box(size, at=(0, 0, 0)):
    """Return a box with its lower corner somewhere, wound outwards."""
    mesh = trimesh.creation.box()
    return (mesh.vertices + 0.5) * size + at, mesh.faces


def ball(radius, at=(0, 0, 0)):
    return BALL.vertices * radius + at, BALL.faces


def joined(*parts):
    """Return one mesh of parts, and the part of each face."""
    vertices, faces = trimesh.util.append_faces(*zip(*parts))
    return vertices, faces, np.repeat(np.arange(len(parts)), [len(part[1]) for part in parts])


def mirrored(part, k):
    """Return a part of height 1 with its lower side at k, every other one upside down."""
    vertices, faces = part
    return (vertices * [1, 1, -1] + [0, 0, k + 1], faces[:, ::-1]) if k % 2 else (vertices + [0, 0, k], faces)


TETRAHEDRON = CORNERS[[0, 3, 5, 6]], np.array([(0, 1, 2), (0, 3, 1), (0, 2, 3), (1, 3, 2)])
SHELLS = {
    "two": joined(box(3), box(1, (1, 1, 1))),
    "three": joined(box(5), box(3, (1, 1, 1)), box(1, (2, 2, 2))),
    "four, of balls": joined(*[ball(radius, (0.3, 0.2, 0.1)) for radius in (1, 2, 3, 4)]),
    "voxels": (*voxel_mesh(shell(4)), None),
    "side by side": joined(box(1), box(1, (2, 0, 0)), ball(1, (9, 9, 9))),
    "two cavities, one with a body": joined(box(9), ball(1, (2, 2, 2)), box(4, (4, 4, 4)), ball(1.5, (6, 6, 6))),
    "touching at a corner and at faces, from outside": joined(box(1), box(1, (1, 1, 1)), box(1, (-1, 0.25, 0.25))),
    "touching at an edge, from outside": joined(box(1), box(1, (1, 1, 0))),
    "a pocket that shares three planes": joined(box(3), box(1)),
    "a pocket in the upper corner": joined(box(3), box(1, (2, 2, 2))),
    "a pocket in one side": joined(box(3), box(1, (1, 1, 2))),
    "touching at a vertex and an edge, from inside": joined(box(4), TETRAHEDRON, box((1, 1, 2), (3, 3, 1))),
    "inscribed: every corner is one of the box": joined(box(1), TETRAHEDRON),
    "in a bay, inside the box of the other": joined(
        voxel_mesh([(0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 1, 0), (2, 1, 0), (0, 2, 0), (2, 2, 0)]),
        box(0.5, (1.25, 1.25, 0.25)),
    ),
}


def winding_numbers(mesh, points):
    return np.array([winding_number(point, mesh.vertices[mesh.faces]) for point in points])


def some_turned(rng, faces, part, some):
    """Return faces in any order, whole parts of them turned at random, and single ones too where `some`."""
    flip = (rng.random(part.max() + 1) < 0.5)[part] ^ (rng.random(len(part)) < 0.2 * some)
    return turned(faces, flip)[rng.permutation(len(faces))]


@pytest.mark.parametrize("name", SHELLS)
def test_parity_decides_which_way_parts_face(name):
    vertices, faces, part = SHELLS[name]
    welded = mesh_from_arrays(vertices, faces)
    part = find_winding(welded.vertices, welded.faces).part if part is None else part
    rng = np.random.default_rng(list(SHELLS).index(name))
    # Beside faces of all parts, on either side.
    points = vertices[faces[rng.choice(len(faces), 40)]].mean(1) + rng.normal(size=(40, 3)) * 0.05
    truth = winding_numbers(welded, points) % 2
    assert 5 < truth.sum() < 35
    for case in range(4):
        # Whole parts either way, as they are given; then with some faces of their own besides.
        mesh = mesh_from_arrays(vertices, some_turned(rng, faces, part, case > 1))
        mended = orient_mesh(mesh)
        assert (np.sort(mended.faces, 1) == np.sort(mesh.faces, 1)).all(), "faces keep their corners and places"
        np.testing.assert_array_equal(winding_numbers(mended, points), truth)
        report = describe_mesh(mended)
        assert report["winding"] == "outwards" and report["inside_out_faces"] == 0
        if case < 2:
            wrong, winding = (mended.faces != mesh.faces).any(1), find_winding(mesh.vertices, mesh.faces)
            assert describe_mesh(mesh)["inside_out_faces"] == wrong.sum()
            assert set(np.flatnonzero(wrong)) == set(winding.inside_out)
            assert wrong.all() or not wrong.any() or f"{wrong.sum()} faces" in winding.fault()


@pytest.mark.parametrize("name", SHELLS)
def test_turned_parts_touch_as_near_as_they_round(name):
    """Planes that were shared are so but for rounding, and stay so far from the origin."""
    vertices, faces, _ = SHELLS[name]
    turn = trimesh.transformations.rotation_matrix(0.7, (1, 2, 3))[:3, :3]
    vertices = (vertices[:, None] * turn).sum(2)
    for at in (0.0, 1e9):
        mesh = mesh_from_arrays(vertices + at, faces)
        mended, expected = orient_mesh(mesh), orient_mesh(mesh_from_arrays(*SHELLS[name][:2]))
        np.testing.assert_array_equal(mended.faces, expected.faces)


def changed_faces(vertices, faces):
    """Return which faces of a mesh are turned when it is mended."""
    mesh = mesh_from_arrays(vertices, faces)
    return (orient_mesh(mesh).faces != mesh.faces).any(1)


def test_a_wall_that_is_out_by_a_rounding_is_a_wall():
    vertices, faces, part = joined(box(3), box(1))
    vertices[8:][vertices[8:] == 0] = -1e-15
    np.testing.assert_array_equal(changed_faces(vertices, faces), part == 1)


def volume(vertices, faces):
    """Return six times the volume within a surface, exactly."""
    total = Fraction(0)
    for a, b, c in vertices[faces].tolist():
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = ([Fraction(x) for x in corner] for corner in (a, b, c))
        total += ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
    return total


@pytest.mark.parametrize("scale, at", [(2.0**-90, 0.0), (2.0**90, 0.0), (1.0, 1e6)])
def test_sizes_and_places_do_not_matter(scale, at):
    vertices, faces, part = joined(ball(3), ball(2), ball(1))
    mended = orient_mesh(mesh_from_arrays(vertices * scale + at, faces))
    same = (mended.faces == mesh_from_arrays(vertices, faces).faces).all(1)
    np.testing.assert_array_equal(same, part != 1)


TOUCHING = {
    "a row of boxes, walls cut otherwise": (joined(*[box(1, (k, 0, 0)) for k in range(3)]), 3),
    "a stack, walls cut alike": (joined(*[mirrored(box(1), k) for k in range(3)]), 3),
    "two cavities with a wall between in a box": (joined(box(5), box(1, (1, 2, 2)), box(1, (2, 2, 2))), 125 - 2),
    "eight, with a cavity each": (
        joined(*[box(1, at) for at in CORNERS], *[(TETRAHEDRON[0] / 4 + at + 0.25, TETRAHEDRON[1]) for at in CORNERS]),
        8 - Fraction(8, 3 * 64),
    ),
}


@pytest.mark.parametrize("name", TOUCHING)
def test_bodies_that_share_a_wall_face_out(name):
    """Their edges at the wall have four faces; a cavity's and another's sides end there alike."""
    (vertices, faces, part), material = TOUCHING[name]
    rng = np.random.default_rng(list(TOUCHING).index(name))
    for case in range(6):
        mended = orient_mesh(mesh_from_arrays(vertices, some_turned(rng, faces, part, case > 2)))
        assert volume(mended.vertices, mended.faces) == 6 * material
        assert describe_mesh(mended)["winding"] == "outwards"
    assert describe_mesh(mesh_from_arrays(vertices, turned(faces, part == 1)))["winding"] == "inside out"


@pytest.mark.parametrize("seed", range(6))
def test_random_neighbours_face_out(seed):
    """Cells of a grid in three bodies, which touch at walls, edges and corners and lie in cavities of one another."""
    rng = np.random.default_rng(seed)
    label = rng.integers(0, 4, (3, 3, 3))
    vertices, faces, part = joined(*[voxel_mesh(np.argwhere(label == k), rng if seed % 2 else None) for k in (1, 2, 3)])
    mended = orient_mesh(mesh_from_arrays(vertices, some_turned(rng, faces, part, seed % 3 == 2)))
    assert volume(mended.vertices, mended.faces) == 6 * np.count_nonzero(label)
    assert describe_mesh(mended)["winding"] == "outwards"


def test_parts_that_cross_are_bodies_of_their_own():
    """Of such a part one side is inside another and one is not, whatever it faces: it faces out."""
    for parts in (
        (ball(1), ball(1, (0.9, 0.1, 0.2))),
        (ball(3), ball(1, (1.8, 1.6, 0.5))),  # within the box of the other
        (box(9), ball(2, (4, 4, 4)), box(2, (5, 4, 4))),  # in a body that has a cavity which it leaves
    ):
        vertices, faces, part = joined(*parts)
        mesh = mesh_from_arrays(vertices, faces)
        last = part == part.max()
        for flip in (np.zeros(len(part), bool), last):
            mended = orient_mesh(mesh_from_arrays(mesh.vertices, turned(mesh.faces, flip)))
            assert (volume(mended.vertices, mended.faces[last]) > 0) == (len(parts) == 2)


def test_open_parts_stay_and_hold_nothing():
    """An open box around a ball, and an open sheet in its cavity, go with the majority of their faces alone."""
    vertices, faces = box(9)
    parts = joined((vertices, faces[:-1]), box(5, (2, 2, 2)), ball(1, (4, 4, 4)), (CORNERS + 3, np.array([(0, 1, 2)])))
    for faces, wrong in ((parts[1], 2), (parts[1][:, ::-1], 1)):
        np.testing.assert_array_equal(changed_faces(parts[0], faces), parts[2] == wrong)


def test_walls_listed_several_times_count_as_often():
    ball_in, wall = ball(1, (4, 4, 4)), box(9)
    for count in (1, 2, 3):
        vertices, faces, part = joined(*[wall] * count, ball_in)
        np.testing.assert_array_equal(changed_faces(vertices, faces), (part == count) & (count % 2 == 1))


def test_closed_parts_with_a_fin_hold_what_is_in_them():
    """A fin leaves its edge odd: the box that it grows on is closed all the same."""
    vertices, faces = box(9)
    fin = np.array([*vertices[faces[0][:2]], (20, 20, 20)]), np.array([(0, 1, 2)])
    vertices, faces, part = joined((vertices, faces), ball(1, (4, 4, 4)), fin)
    np.testing.assert_array_equal(changed_faces(vertices, faces), part == 1)
