"""Meshes of arrays: welding, validation and description."""

import json

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import numpy as np
import pytest
import trimesh
from helpers import refused
from hypothesis import example, given

from warp_abtree.model.mesh import MeshError, describe_mesh, mesh_from_arrays

V, F = [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]


def describe(vertices, faces):
    return describe_mesh(mesh_from_arrays(vertices, faces))


def test_tiny_coordinates_become_zero_and_far_ones_are_refused():
    below = np.nextafter(2.0**-290, 0)
    mesh = mesh_from_arrays([[0, below, -5e-324], [1, 0, 0], [0, 1, -(2.0**-290)], [0, 0, 0]], [[0, 1, 2], [0, 3, 1]])
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, -(2.0**-290)]])
    np.testing.assert_array_equal(mesh.dropped_faces, [1])
    assert not np.signbit(mesh.vertices[0]).any()
    far, limit = np.nextafter(2.0**300, np.inf), -(2.0**300)
    with pytest.raises(MeshError, match=r"vertex 1 .* 2\^300"):
        mesh_from_arrays([[far, 9, 9], [far, 0, 0], [far, 1, 0], [far, 0, 1]], [[2, 1, 3]])
    assert len(mesh_from_arrays([[limit, 0, 0], [limit, 1, 0], [limit, 0, 1]], F).faces) == 1


def soups():
    # Few distinct coordinates, so that vertices coincide often.
    coordinate = st.sampled_from([0.0, -0.0, 1.0, -1.0, 0.1, 1e-300, 2.0**-1074, 3.0])
    vertices = hnp.arrays(np.float64, st.tuples(st.integers(3, 12), st.just(3)), elements=coordinate)
    faces = hnp.arrays(np.int64, st.tuples(st.integers(1, 20), st.just(3)), elements=st.integers(0, 11))
    return st.tuples(vertices, faces)


@given(soups())
@example((np.zeros((3, 3)), np.array([[0, 1, 2]])))
@example((np.array([[0.0, 1, 1], [1, 0, 1], [1, 1, 1]]), np.array([[0, 1, 2]] * 3)))
def test_random_soups(soup):
    vertices, faces = np.where(np.abs(soup[0]) < 2.0**-290, 0.0, soup[0]), soup[1] % len(soup[0])
    corners = [{tuple(x + 0.0) for x in vertices[face]} for face in faces]
    dropped = [f for f, corner in enumerate(corners) if len(corner) < 3]
    if len(dropped) == len(faces):
        refused(MeshError, "three distinct corners", mesh_from_arrays, vertices, faces)
        return
    if np.ptp(vertices[faces].reshape(-1, 3), axis=0).max() < 2.0**-100:
        refused(MeshError, "extent", mesh_from_arrays, vertices, faces)
        return
    mesh = mesh_from_arrays(vertices, faces)
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], vertices[faces])
    np.testing.assert_array_equal(mesh.dropped_faces, dropped)
    assert not np.signbit(mesh.vertices[mesh.vertices == 0.0]).any()
    assert len({tuple(x) for x in mesh.vertices}) == len(mesh.vertices)
    assert set(mesh.faces.ravel().tolist()) == set(range(len(mesh.vertices)))
    assert mesh.file_vertex_count == mesh.unreferenced_count + mesh.welded_count + len(mesh.vertices)
    first = [min(i for i in set(faces.ravel().tolist()) if (vertices[i] == x).all()) for x in mesh.vertices]
    assert first == sorted(first)
    # The description against sets and dictionaries.
    report = describe_mesh(mesh)
    kept = [tuple(face) for f, face in enumerate(mesh.faces.tolist()) if f not in dropped]
    edges = [frozenset(pair) for a, b, c in kept for pair in ((a, b), (b, c), (c, a))]
    assert report["open_edges"] == sum(edges.count(edge) == 1 for edge in set(edges))
    assert report["closed"] == all(edges.count(edge) % 2 == 0 for edge in set(edges))
    assert report["nonmanifold_edges"] == sum(edges.count(edge) > 2 for edge in set(edges))
    assert report["duplicate_faces"] == len(kept) - len({frozenset(face) for face in kept})
    groups = []
    for face in kept:
        joined = [group for group in groups if group & set(face)]
        groups = [group for group in groups if group not in joined] + [set(face).union(*joined)]
    assert report["components"] == len(groups)


def test_describe_cube():
    box = trimesh.creation.box(extents=(1, 2, 3))
    report = describe(box.vertices, box.faces)
    expected = {"faces": 12, "vertices": 8, "open_edges": 0, "nonmanifold_edges": 0, "components": 1, "closed": True}
    expected |= {"extents": [1, 2, 3], "bounds": [[-0.5, -1, -1.5], [0.5, 1, 1.5]]}
    assert {name: report[name] for name in expected} == expected
    assert report["diagonal"] == pytest.approx(14**0.5) and json.loads(json.dumps(report)) == report


def test_describe_two_components_duplicates_and_zero_area():
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 0, 0], [6, 0, 0], [5, 1, 0], [0.1, 0.1, 0.1], [0.3, 0.3, 0.3]]
    vertices += [[0.7, 0.7, 0.7], [0.7, 0.7, 0.7 + 1e-9]]
    faces = [[0, 1, 2], [3, 4, 5], [5, 3, 4], [3, 5, 4], [6, 7, 8], [6, 7, 9], [0, 0, 1]]
    report = describe(vertices, faces)
    assert (report["components"], report["duplicate_faces"], report["dropped_faces"]) == (3, 2, 1)
    for scale in (1, 2.0**-99, 2.0**96):
        assert describe(np.array(vertices) * scale, faces)["zero_area_faces"] == 1
    # An area within the error bound of its computation.
    line = [[0.6, 0.3, 0.0], [0.6, 0.54, 0.27], [0.6, np.nextafter(0.86, 0), 0.63]]
    cross = np.cross(np.subtract(line[1], line[0]), np.subtract(line[2], line[0]))
    assert 0 < np.linalg.norm(cross) < 1e-16
    assert describe(line, F)["zero_area_faces"] == 1


def test_components_of_shuffled_chains():
    # Faces of a chain share one vertex with the next; labels travel along it in a random order.
    chains, length = 300, 30
    size = 2 * length + 1
    faces = size * np.arange(chains)[:, None, None] + 2 * np.arange(length)[:, None] + np.arange(3)
    order = np.random.default_rng(5).permutation(chains * size)
    vertices = np.random.default_rng(6).random((chains * size, 3))
    assert describe(vertices, order[faces.reshape(-1, 3)])["components"] == chains


BIG = np.broadcast_to(np.array([0, 1, 2], dtype=np.int32), (2**30 + 1, 3))


@pytest.mark.parametrize(
    "vertices, faces, message",
    [
        ([], F, "no vertices"),
        (V, np.zeros((0, 3), int), "no faces"),
        ([[0, 0, 0], [1, 0, np.nan], [0, 1, 0]], F, "vertex 1 is not finite"),
        (np.array(V, np.longdouble) * np.longdouble("1e400"), F, "not finite"),
        (V, [[0, 1, 2], [0, 1, 3]], r"face 1 has corners \[0, 1, 3\], but vertices run from 0 to 2"),
        (V, np.array([[0, 1, 2**63 + 2]], np.uint64), "face 0 has corners"),
        (V, [[0, 1, np.inf]], "face 0"),
        (V, [[0, 1, 2], [0, 1, 1.5]], "face 1 .* not integers"),
        (V, [[True, False, True]], "faces have type bool"),
        (V, [0, 1, 2], r"faces have shape \(3,\)"),
        (V, [[0, 1, 2], [0, 1]], "faces do not form an array"),
        ([[0, 0], [1, 0], [0, 1]], F, r"vertices have shape \(3, 2\)"),
        (np.array(V) * 1j, F, "vertices have type complex"),
        ([[0, 0, 0], [0, 0, 0], [0, 1, 0]], F, "no face has three distinct corners"),
        (np.array(V) * 2.0**-101, F, "extent"),
        (np.array(V) * 2.0**101, F, "extent"),
        (np.array([[-1.5e308, 0, 0], [1.5e308, 0, 0], [0, 1, 0]]), F, "extent inf"),
        (V, BIG, r"1073741825 faces, but at most 2\^30"),
    ],
)
def test_array_errors(vertices, faces, message, recwarn):
    caught = refused(MeshError, message, mesh_from_arrays, vertices, faces, name="thing")
    assert str(caught).startswith("thing: ")
    assert not recwarn.list


def test_limits_are_included_and_integral_floats_pass():
    for scale in (2.0**-100, 2.0**100):
        mesh_from_arrays(np.array(V) * scale, F)
    assert mesh_from_arrays(V, np.array(F, np.float32)).faces.tolist() == F
    assert mesh_from_arrays(np.array(V, np.int8), np.array(F, np.uint8)).faces.tolist() == F
