"""Orientation: winding by exact rays and loops, what mends it, and what refuses or warns where it is wrong."""

import json

import numpy as np
import pytest
import trimesh
from helpers import refused
from helpers.scenes import scene_with
from helpers.solids import model_of, shell, turned, voxel_mesh
from helpers.viewer import write_scene
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.inside import winding_number
from oracles.triangle import cross, dot, fractions

import warp_abtree as ab
from warp_abtree.app import SceneError, load_scene
from warp_abtree.app.cli.main import main
from warp_abtree.model.mesh import describe_mesh, mesh_from_arrays, orient_mesh
from warp_abtree.model.winding import find_winding

BALL = trimesh.creation.icosphere(1)
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)


def box(size, at=(0, 0, 0)):
    mesh = trimesh.creation.box()
    return (mesh.vertices + 0.5) * size + at, mesh.faces


def ball(radius, at=(0, 0, 0)):
    return BALL.vertices * radius + at, BALL.faces


def joined(*parts):
    """Return one mesh of parts, and the part of each face."""
    vertices, faces = trimesh.util.append_faces(*zip(*parts))
    return vertices, faces, np.repeat(np.arange(len(parts)), [len(part[1]) for part in parts])


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
    points = vertices[faces[rng.choice(len(faces), 24)]].mean(1) + rng.normal(size=(24, 3)) * 0.05
    truth = winding_numbers(welded, points) % 2
    assert 3 < truth.sum() < 21
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


WALL, BALL_IN = box(9), ball(1, (4, 4, 4))
ROUNDED = np.where(box(1)[0] == 0, -1e-15, box(1)[0]), box(1)[1]
# An open box around a box around a ball, and an open sheet in its cavity.
OPEN = (WALL[0], WALL[1][:-1]), box(5, (2, 2, 2)), BALL_IN, (CORNERS + 3, np.array([(0, 1, 2)]))
FIN = np.array([*WALL[0][WALL[1][0][:2]], (20, 20, 20)]), np.array([(0, 1, 2)])
# Parts, and the one that is turned.
HELD = {
    "a wall that is out by a rounding is a wall": ((box(3), ROUNDED), 1),
    "open parts stay and hold nothing": (OPEN, 2),
    "open parts, all inside out": ([(vertices, faces[:, ::-1]) for vertices, faces in OPEN], 1),
    "a wall": ((WALL, BALL_IN), 1),
    "a wall listed twice holds nothing": ((WALL, WALL, BALL_IN), None),
    "a wall listed three times": ((WALL, WALL, WALL, BALL_IN), 3),
    "a fin leaves an edge odd of a box that is closed all the same": ((WALL, BALL_IN, FIN), 1),
}


@pytest.mark.parametrize("name", HELD)
def test_parts_that_closed_ones_hold_are_turned(name):
    parts, wrong = HELD[name]
    vertices, faces, part = joined(*parts)
    mesh = mesh_from_arrays(vertices, faces)
    np.testing.assert_array_equal((orient_mesh(mesh).faces != mesh.faces).any(1), part == wrong)


def volume(vertices, faces):
    """Return six times the volume within a surface, exactly."""
    return sum(dot(a, cross(b, c)) for a, b, c in fractions(vertices[faces]))


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


TORUS = trimesh.creation.torus(1, 0.3, major_sections=12, minor_sections=8)


def winding_of(vertices, faces):
    mesh = mesh_from_arrays(vertices, faces)
    return find_winding(mesh.vertices, mesh.faces, mesh.dropped_faces)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(*[st.integers(0, 5)] * 3), min_size=1, max_size=20), st.integers(2, 6))
def test_edges_are_counted_as_by_hand(faces, vertex_count):
    vertices = np.random.default_rng(0).normal(size=(6, 3))
    faces = np.array(faces)
    if not any(len(set(face)) == 3 for face in faces.tolist()):
        return
    mesh = mesh_from_arrays(vertices, faces)
    runs = {}
    for f, (a, b, c) in enumerate(mesh.faces.tolist()):
        if len({a, b, c}) == 3:
            for u, v in ((a, b), (b, c), (c, a)):
                runs.setdefault((min(u, v), max(u, v)), []).append((f, u < v))
    winding = find_winding(mesh.vertices, mesh.faces, mesh.dropped_faces)
    odd = {edge: min(f for f, _ in of) for edge, of in runs.items() if len(of) % 2}
    assert dict(zip(map(tuple, winding.odd_edges.tolist()), winding.odd_faces.tolist())) == odd
    told = [[way for _, way in of] for of in runs.values() if len(of) == 2 or not odd]
    assert winding.mixed_edges == sum(2 * sum(ways) != len(ways) for ways in told)
    assert describe_mesh(mesh)["closed"] == winding.is_closed == (not odd)


@pytest.mark.parametrize("scale", [1.0, 2.0**-90, 2.0**90])
def test_closed_meshes_that_are_inside_out_are_found(scale):
    flat = trimesh.creation.icosphere(1)
    for mesh in (TORUS, trimesh.creation.box(), trimesh.creation.icosphere(2)):
        vertices = mesh.vertices * scale
        assert winding_of(vertices, mesh.faces).fault() is None
        assert winding_of(vertices, mesh.faces[:, ::-1]).fault() == "it is inside out"
    # A volume that vanishes has no sign, however it rounds: two sides of one sheet.
    assert winding_of((flat.vertices * [1, 1, 0] + [0.1, 0.2, 0.3]) * scale, flat.faces).fault() is None
    # One that nearly vanishes has the exact one: a slab of one unit in the last place.
    box = trimesh.creation.box()
    for end in (2.0, 0.0):
        heights = np.where(box.vertices[:, 2] > 0, np.nextafter(1.0, end), 1.0)
        slab = np.column_stack([box.vertices[:, :2], heights]) * scale
        assert (winding_of(slab, box.faces).fault() is None) == (end == 2.0)


def test_open_and_one_sided_parts():
    """An open sheet goes with the majority; a Moebius strip stays as it is."""
    grid = trimesh.creation.box().subdivide()
    keep = grid.triangles_center[:, 2] < 0.4
    chosen = np.zeros(keep.sum(), bool)
    chosen[:5] = True
    mended = orient_mesh(mesh_from_arrays(grid.vertices, turned(grid.faces[keep], chosen)))
    assert winding_of(mended.vertices, mended.faces).mixed_edges == 0
    corners = mended.vertices[mended.faces]
    assert (np.einsum("ij,ij->i", trimesh.triangles.cross(corners), corners.mean(1)) > 0).all()
    strip, rows = np.random.default_rng(0).normal(size=(5, 3)), [(k, (k + 1) % 5, (k + 2) % 5) for k in range(5)]
    mesh = mesh_from_arrays(strip, rows)
    assert winding_of(strip, rows).mixed_edges > 0
    np.testing.assert_array_equal(orient_mesh(mesh).faces, mesh.faces)


def test_every_lod_of_a_closed_mesh_is_closed():
    """Merges map edges to edges, so an even number of faces stays at each, folds and coincident faces among them."""
    rng = np.random.default_rng(1)
    meshes = [TORUS, trimesh.creation.icosphere(2)]
    models = [ab.Model.from_arrays(mesh.vertices, mesh.faces, base_faces=1) for mesh in meshes]
    models += [model_of(voxel_mesh(rng.integers(0, 4, (14, 3)), rng)) for _ in range(4)]
    folded = 0
    for model in models:
        assert model.winding.is_closed
        for lod in range(model.lod_max + 1):
            vertices, faces, _ = model.mesh_at(lod)
            assert find_winding(vertices, faces).is_closed, (model, lod)
            folded += len(faces) - len(np.unique(np.sort(faces, axis=1), axis=0))
    assert folded > 0, "some of them are folded"


def test_open_solids_are_refused_by_their_edges(device):
    torn = ab.Model.from_arrays(TORUS.vertices, TORUS.faces[1:], name="torn")
    scene = ab.Scene(device)
    told = r"'torn' is no solid.*3 edges belong to an odd number of faces: \("
    found = refused(ab.MeshError, told, scene.add, torn, solid=True)
    assert describe_mesh(mesh_from_arrays(TORUS.vertices, TORUS.faces[1:]))["solid"] == "no: not closed"
    corner = ", ".join(f"{x:.6g}" for x in TORUS.vertices[TORUS.faces[0][0]])
    assert f"({corner})" in str(found) and scene.object_count == 0
    refused(ValueError, "solid 1 is neither", scene.add, torn, solid=1)
    refused(ab.MeshError, "torn", ab.sweep, torn, torn, np.eye(4)[None], solid=True, device=device)
    # Three sheets that share an edge leave none open, and still have no inside.
    fin = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [-1, 1, 0], [-1, -1, 0.0]])
    fins = ab.Model.from_arrays(fin, [[0, 1, 2], [0, 1, 3], [0, 1, 4]])
    assert len(fins.winding.odd_edges) == 7
    assert scene.add(ab.Model.load(TORUS), solid=True) == 0


def test_wrong_winding_warns_once_where_it_matters(device):
    inverted = ab.Model.from_arrays(TORUS.vertices, TORUS.faces[:, ::-1], name="inverted")
    scene = scene_with(device, inverted, inverted, solid=True)
    scene.intersect(np.array([(0, 1)]), "faces")  # does not depend on it
    with pytest.warns(RuntimeWarning, match="'inverted': it is inside out; .*normals.*orient=True"):
        scene.intersect(np.array([(0, 1)]), "contacts")
    scene.add(inverted)
    scene.intersect(np.array([(0, 1)]), "contacts")
    other = ab.Model.from_arrays(TORUS.vertices, turned(TORUS.faces, np.arange(len(TORUS.faces)) < 9), name="mixed")
    with pytest.warns(RuntimeWarning, match="'mixed': neighbouring faces disagree .* mass"):
        ab.Dynamics(scene_with(device, other))


def test_orient_in_models_files_and_commands(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WARP_ABTREE_CACHE", str(tmp_path / "cache"))
    ball = trimesh.creation.icosphere(3)
    ball.faces = ball.faces[:, ::-1]
    ball.export("ball.obj")
    for _ in range(2):  # built, and opened from the cache
        assert ab.Model.load("ball.obj").winding.fault() is not None
        assert ab.Model.load("ball.obj", orient=True).winding.fault() is None
    assert ab.Model.from_arrays(ball.vertices, ball.faces, orient=True).winding.fault() is None
    main(["info", "ball.obj"])
    assert "inside out" in capsys.readouterr().out
    main(["build", "ball.obj", "ball.npz", "--orient", "--json"])
    capsys.readouterr()
    main(["info", "ball.npz", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["closed"] is True and found["winding"] == "outwards"
    assert found["mixed_edges"] == found["inside_out_faces"] == 0
    text = '[models.b]\nmesh = "ball.obj"\norient = true\n[[objects]]\nmodel = "b"\nsolid = true\n'
    loaded = load_scene(write_scene(tmp_path, text), device="cpu")
    assert loaded.scene.object_solid == [True] and loaded.models["b"].winding.fault() is None
    trimesh.Trimesh(ball.vertices, ball.faces[1:]).export("torn.obj")
    torn = write_scene(tmp_path, text.replace("ball.obj", "torn.obj"))
    refused(SceneError, r"objects\[0\].solid: .* is no solid.*edges belong", load_scene, torn, device="cpu")
