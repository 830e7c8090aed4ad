"""Faces that are listed an even number of times: what such solids hold, by exact rays, and that they say so."""

import warnings

import numpy as np
import pytest
import trimesh
from helpers import refused
from oracles.inside import parity

import warp_abtree as ab
from warp_abtree.model.mesh import describe_mesh, mesh_from_arrays

BOX = trimesh.creation.box()
BALL = trimesh.creation.icosphere(1, radius=0.1)


def turned(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)


def at(x, mesh=BOX):
    return trimesh.Trimesh(mesh.vertices + [x, 0, 0], mesh.faces, process=False)


WALL = trimesh.Trimesh(BOX.vertices, BOX.faces[BOX.face_normals[:, 0] > 0.5], process=False)
INNER = trimesh.Trimesh(0.6 * BOX.vertices, BOX.faces, process=False)
# Meshes, where balls are put, and how many faces hold nothing.
CASES = {
    "once": ([BOX], (0.0,), 0),
    "twice": ([BOX, BOX], (0.0,), 24),
    "double-sided": ([BOX, turned(BOX)], (0.0,), 24),
    "three times": ([BOX, turned(BOX), BOX], (0.0,), 0),
    "four times": ([BOX, BOX, turned(BOX), BOX], (0.0,), 48),
    "one of two bodies": ([BOX, BOX, at(3)], (0.0, 3.0), 24),
    "a body in a doubled one": ([BOX, BOX, INNER], (0.0,), 24),
    "bodies that share a wall": ([BOX, at(1)], (0.0, 1.0), 0),
    "a wall in a body, of two sides": ([BOX, at(-0.5, WALL), turned(at(-0.5, WALL))], (0.0,), 0),
    "a sheet of two sides": ([WALL, turned(WALL)], (0.0,), 4),
}


def quietly(call, *arguments, **options):
    """Return what a call answers, and its warnings of solids."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        answer = call(*arguments, **options)
    return answer, [str(each.message) for each in said if "as a solid" in str(each.message)]


@pytest.mark.parametrize("name", CASES)
def test_what_holds_nothing_says_so(device, name):
    meshes, places, count = CASES[name]
    mesh = trimesh.util.concatenate(meshes)
    model = ab.Model.from_arrays(mesh.vertices, mesh.faces, base_faces=10**6, name="body")
    welded = mesh_from_arrays(mesh.vertices, mesh.faces)
    listed, whole = np.sort(welded.faces, axis=1).tolist(), count == len(welded.faces)
    assert {listed.count(listed[f]) % 2 for f in model.winding.doubled} <= {0} and len(model.winding.doubled) == count
    told = describe_mesh(welded)["solid"]
    if count:
        assert told.startswith("holds nothing: all" if whole else "holds less")
        assert f"{count} faces are listed an even number of times" in told
    else:
        assert told == "yes"
    scene = ab.Scene(device)
    _, said = quietly(scene.add, model, solid=True)
    assert len(said) == (count > 0)
    if count:
        assert "'body'" in said[0] and f"{count} faces are listed an even number of times" in said[0]
        assert ("holds nothing: all" in said[0]) == whole
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            refused(RuntimeWarning, "as a solid", scene.add, model, solid=True)
            assert scene.object_count == 1
            ab.Scene(device).add(model)  # as a surface it is as good as any
    ball = ab.Model.load(BALL)
    points = [(x + 0.01, 0.02, 0.03) for x in places]
    poses = [(*point, 0, 0, 0, 1) for point in points]
    held = [parity(np.array(point), mesh.vertices[mesh.faces]) for point in points]
    scene.add_many([ball] * len(poses), poses)
    assert scene.intersect([(0, 1 + k) for k in range(len(places))]).any.tolist() == held
    manager = ab.CollisionManager(device)
    _, said = quietly(manager.add_object, ("link", 3), mesh)
    assert len(said) == (count > 0) and all("\"('link', 3)\"" in each for each in said)
    place = trimesh.transformations.translation_matrix
    assert [manager.in_collision_single(BALL, place(point)) for point in points] == held
    _, said = quietly(ab.CollisionManager(device, solids=False).add_object, "body", mesh)
    assert not said
    found, said = quietly(ab.sweep, model, ball, poses, solid=(True, False), device=device)
    assert found.tolist() == held and len(said) == (count > 0)


def test_the_warning_points_to_the_line_that_called_the_library():
    doubled = trimesh.util.concatenate([BOX, BOX])
    model, scene = ab.Model.load(doubled), ab.Scene("cpu")
    for ask in (
        lambda: scene.add(model, solid=True),
        lambda: scene.add_many([model, model], [(0, 0, 0, 0, 0, 0, 1)] * 2, solids=True),
        lambda: ab.scene_from_trimesh(trimesh.Scene(doubled), device="cpu", solid=True),
        lambda: ab.contains(model, [(0, 0, 0)], device="cpu"),
    ):
        with pytest.warns(RuntimeWarning, match="as a solid holds nothing") as caught:
            ask()
        assert {warning.filename for warning in caught} == {__file__}
