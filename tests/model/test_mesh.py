"""Meshes of arrays, files and trimesh objects: welded, described, in their order; one error for what is unreadable."""

import gzip
import json
import sys

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import numpy as np
import pytest
import trimesh
from helpers import refused
from hypothesis import example, given
from oracles.inside import components

from warp_abtree.model.files.found import Remarks
from warp_abtree.model.files.obj import read_obj
from warp_abtree.model.mesh import MeshError, describe_mesh, load_mesh, mesh_from_arrays

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
    assert report["components"] == len(components(kept))
    bounds = [mesh.vertices.min(0), mesh.vertices.max(0)]
    assert np.array_equal(report["bounds"], bounds) and np.array_equal(report["extents"], bounds[1] - bounds[0])
    assert report["diagonal"] == pytest.approx(np.linalg.norm(report["extents"]))
    assert json.loads(json.dumps(report)) == report


def test_zero_area_is_told_at_any_scale():
    vertices = np.array([*V, *([x] * 3 for x in (0.1, 0.3, 0.7)), [0.7, 0.7, 0.7 + 1e-9]])
    for scale in (1, 2.0**-99, 2.0**96):
        assert describe(vertices * scale, [[0, 1, 2], [3, 4, 5], [3, 4, 6]])["zero_area_faces"] == 1
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


BAD_ARRAYS = [
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
]


@pytest.mark.parametrize("vertices, faces, message", BAD_ARRAYS)
def test_array_errors(vertices, faces, message, recwarn):
    caught = refused(MeshError, message, mesh_from_arrays, vertices, faces, name="thing")
    assert str(caught).startswith("thing: ")
    assert not recwarn.list


def test_limits_are_included_and_integral_floats_pass():
    for scale in (2.0**-100, 2.0**100):
        mesh_from_arrays(np.array(V) * scale, F)
    assert mesh_from_arrays(V, np.array(F, np.float32)).faces.tolist() == F
    assert mesh_from_arrays(np.array(V, np.int8), np.array(F, np.uint8)).faces.tolist() == F


def ball():
    """Return an icosphere whose coordinates float32 holds, so that every format can keep them."""
    shape = trimesh.creation.icosphere(subdivisions=2)
    return trimesh.Trimesh(shape.vertices.astype(np.float32).astype(float), shape.faces, process=False)


@pytest.mark.parametrize("extension", ["obj", "ply", "stl", "off", "glb", "obj.gz", "stl.gz", "ply.gz", "STL"])
def test_formats_keep_every_triangle(tmp_path, extension):
    shape, path = ball(), tmp_path / f"some.ball.{extension}"
    kind = extension.lower().removesuffix(".gz")
    data = shape.export(file_type=kind, **({"digits": 17} if kind in ("obj", "off") else {}))
    data = data.encode() if isinstance(data, str) else data
    path.write_bytes(gzip.compress(data) if extension.endswith(".gz") else data)
    mesh = load_mesh(path)
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], shape.vertices[shape.faces])
    assert mesh.name == "some.ball" and load_mesh(str(path), name="x").name == "x"
    assert (mesh.vertices.dtype, mesh.faces.dtype, mesh.dropped_faces.dtype) == (np.float64, np.int32, np.int32)
    assert len(mesh.vertices) == len(shape.vertices) and len(mesh.dropped_faces) == 0
    if kind == "stl":
        assert mesh.file_vertex_count == 3 * len(shape.faces)
        assert mesh.welded_count == 3 * len(shape.faces) - len(shape.vertices)
    else:
        np.testing.assert_array_equal(mesh.vertices, shape.vertices)
        np.testing.assert_array_equal(mesh.faces, shape.faces)


OBJ = """mtllib absent.mtl
v 0 0 0\r
v 1 0 0 1.0
v 1 1 0 0.5 0.5 0.5  # a colour
v 0 1 0
vt 0 0
vt 1 0
vn 0 0 1
o first
usemtl red
f 1/1/1 2/2/1 3/1/1 4/2/1
usemtl blue
f 1//1 2//1 \\
  3//1
usemtl red
f 3/1 2/2 1/1   # reversed
g second
v 5 5 5
v 6 5 5
v 5 6 5
f -3 -2 -1
v 5 5 6
f -4 -3 -1
l 1 2
p 1
"""


def test_obj_keeps_the_order_of_the_file(tmp_path):
    path = tmp_path / "order.obj"
    path.write_text(OBJ)
    mesh = load_mesh(path)
    expected = [[0, 1, 2], [0, 2, 3], [0, 1, 2], [2, 1, 0], [4, 5, 6], [4, 5, 7]]
    np.testing.assert_array_equal(mesh.faces, expected)
    np.testing.assert_array_equal(mesh.vertices[[2, 7]], [[1, 1, 0], [5, 5, 6]])


def test_source_errors(monkeypatch):
    beyond = trimesh.Scene([trimesh.Trimesh(np.eye(3), [[0, 1, 3]], process=False), ball()])
    monkeypatch.setitem(sys.modules, "pxr", None)
    for source, message in (
        ("warp:cow", "warp:bunny, warp:bear, warp:rocks"),
        ("warp:bunny", r"pip install usd-core"),
        (3, "cannot load a mesh from int"),
        (trimesh.PointCloud(np.eye(3)), r"no faces .*PointCloud"),
        (trimesh.Scene(), "no faces"),
        (beyond, "face 0 has corners"),
    ):
        refused(MeshError, message, load_mesh, source)


@pytest.mark.parametrize(
    "text",
    [
        "v 0 1 2.5\nvn 0 0 1\n# a\nv -1e-3 nan 1_0\nv 1 2 3\nf 1 2 3\n\nf 3 2 1",
        "v 0 1 2\nv 0  1\nv 1 2 3 4\nf 1 2 3\n",
        "v 0 1 2 \nv 1 1 1\nv 2 2 2\nf 1 2 3\nf 1 2 3 1\n",
        "v 0 1 2\nv 1 1 1\nv 2 2 2\nf 1 2 -1\n",
        "v 0 1 2\nf 1 1 99999999999999999999\n",
        "v 0 1 2\nf 1/1 1/1 1/1\n",
        "v 0 1 x\nf 1 1 1\n",
        "v 0 1 2\nf 0 1 1\n",
        "f 1 2 3\n",
        "",
    ],
)
def test_plain_files_are_read_as_any_others(text):
    """A tab at the end of a file makes it no plain one."""

    def read(data):
        try:
            surface = read_obj(data, "here", Remarks())
            return surface.vertices.tolist(), surface.faces.tolist()
        except MeshError as error:
            return str(error)

    assert repr(read(text.encode())) == repr(read(text.encode() + b"\n\t\n"))
