"""Winding: open edges, neighbours that disagree and parts that are inside out, against loops; and what mends them."""

import json

import numpy as np
import pytest
import trimesh
from helpers import refused
from helpers.scenes import scene_with
from helpers.solids import model_of, turned, voxel_mesh
from helpers.viewer import write_scene
from hypothesis import given, settings
from hypothesis import strategies as st

import warp_abtree as ab
from warp_abtree.app import SceneError, load_scene
from warp_abtree.app.cli.main import main
from warp_abtree.model.mesh import describe_mesh, mesh_from_arrays, orient_mesh
from warp_abtree.model.winding import find_winding
from warp_abtree.simulate.body_state import mass_properties

TORUS = trimesh.creation.torus(1, 0.3, major_sections=12, minor_sections=8)


def winding_of(vertices, faces):
    mesh = mesh_from_arrays(vertices, faces)
    return find_winding(mesh.vertices, mesh.faces, mesh.dropped_faces)


@settings(max_examples=200, deadline=None)
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
    for mesh in (TORUS, trimesh.creation.box(), trimesh.creation.icosphere(2)):
        vertices = mesh.vertices * scale
        assert winding_of(vertices, mesh.faces).fault() is None
        assert winding_of(vertices, mesh.faces[:, ::-1]).fault() == "it is inside out"
    # A volume that vanishes has no sign, however it rounds: two sides of one sheet.
    flat = (trimesh.creation.icosphere(1).vertices * [1, 1, 0] + [0.1, 0.2, 0.3]) * scale
    assert winding_of(flat, trimesh.creation.icosphere(1).faces).fault() is None


def test_volumes_that_nearly_vanish_have_the_exact_sign():
    """A slab of one unit in the last place, far from the origin, at an angle."""
    box = trimesh.creation.box()
    for direction in (1, -1):
        vertices = box.vertices.copy()
        vertices[:, 2] = 1.0
        top = box.vertices[:, 2] > 0
        vertices[top, 2] = np.nextafter(1.0, 2.0 if direction > 0 else 0.0)
        assert (winding_of(vertices, box.faces).fault() is None) == (direction > 0)


def test_open_and_one_sided_parts():
    """An open sheet goes with the majority; a Moebius strip stays as it is."""
    grid = trimesh.creation.box().subdivide()
    keep = grid.triangles_center[:, 2] < 0.4
    chosen = np.zeros(keep.sum(), bool)
    chosen[:5] = True
    mended = orient_mesh(mesh_from_arrays(grid.vertices, turned(grid.faces[keep], chosen)))
    assert winding_of(mended.vertices, mended.faces).mixed_edges == 0
    middle = mended.vertices[mended.faces]
    normals = np.cross(middle[:, 1] - middle[:, 0], middle[:, 2] - middle[:, 0])
    assert (np.einsum("ij,ij->i", normals, middle.mean(1)) > 0).all()
    n = 9
    angle = 2 * np.pi * np.arange(n) / n
    along, up = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1), np.array([0, 0, 1.0])
    across = np.cos(angle / 2)[:, None] * up + np.sin(angle / 2)[:, None] * along
    strip = np.concatenate([along + 0.3 * across, along - 0.3 * across])
    rows = []
    for i in range(n):
        j, k = (i + 1, n + i + 1) if i + 1 < n else (n, 0)
        rows += [(i, n + i, j), (j, n + i, k)]
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


def test_the_mass_of_a_mended_body_is_its_own():
    inverted = ab.Model.from_arrays(TORUS.vertices, TORUS.faces[:, ::-1], name="inverted")
    with pytest.warns(RuntimeWarning, match="mass"):
        assert mass_properties(inverted).volume > 1.2 * TORUS.volume  # of the hull
    mended = ab.Model.from_arrays(TORUS.vertices, TORUS.faces[:, ::-1], orient=True)
    assert mass_properties(mended).volume == pytest.approx(TORUS.volume)
