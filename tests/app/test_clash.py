"""`warp-abtree clash` and `find_clashes`: parts of known geometry, python-fcl, files written, and bad input."""

import csv
import json

import numpy as np
import PIL.Image
import pytest
import trimesh
from helpers import refused
from helpers.viewer import run_command as run
from oracles.peers import fcl_object
from trimesh.transformations import rotation_matrix, translation_matrix

import warp_abtree as ab
from warp_abtree.app.cli.clash_command import CLASH_KINDS, assembly_size, find_clashes

PLATE = trimesh.creation.annulus(5, 30, 10, sections=64)  # its hole of radius 5 is along z
CUBE = trimesh.creation.box((10, 10, 10))


def pin(radius, sections=64):
    return trimesh.creation.cylinder(radius, 40, sections=sections)


def tray(extents):
    box = trimesh.creation.box(extents)
    box.update_faces(box.face_normals[:, 2] < 0.5)
    return box


def source_of(parts):
    source = trimesh.Scene()
    for name, (mesh, *shift) in parts.items():
        source.add_geometry(mesh, name, name, transform=translation_matrix(shift or (0, 0, 0)))
    return source


def scene_of(device, parts, solid="closed"):
    return ab.scene_from_trimesh(source_of(parts), device=device, base_faces=10**6, solid=solid)


# Two parts, and what is true of them: kind, distance, bounds of the depth, whether faces intersect.
ON_EDGE = CUBE.copy().apply_transform(rotation_matrix(np.pi / 4, [0, 0, 1]))
TRAY = tray((10, 10, 10))
BARS = (trimesh.creation.box((100, 4, 4)), 0, 0, 0), (trimesh.creation.box((3, 90, 1)), 13, 3, 0.5)
KNOWN = {
    "press fit of 0.02": ((PLATE, 0, 0, 4), (pin(5.02),), "interference", 0, (0.0199, 0.0201), True),
    "pin with play": ((PLATE, 0, 0, 4), (pin(4.75),), "clearance", 0.25 * np.cos(np.pi / 64), (0, 0), False),
    "gap of 0.5": ((CUBE,), (CUBE, 0, 10.5, 0), "clearance", 0.5, (0, 0), False),
    "walls in contact": ((CUBE,), (CUBE, 10, 3, 1), "touching", 0, (0, 0), True),
    "an edge on a wall": ((CUBE,), (ON_EDGE, 5 + 50**0.5 - 1e-9, 0, 0), "touching", 0, (0, 1e-8), True),
    "pressed in by 1": ((CUBE,), (trimesh.creation.box((4, 4, 4)), 0, 0, 6), "interference", 0, (0.999, 1.001), True),
    "no corner inside": (*BARS, "interference", 0, (0.5, 2.0001), True),
    "the same twice": ((CUBE,), (CUBE,), "interference", 0, (2, 5.001), True),
    "one inside": ((CUBE,), (trimesh.creation.icosphere(2, 1.0),), "interference", 0, (4, 5), False),
    "crossing trays": ((TRAY,), (tray((3, 3, 20)),), "interference", 0, None, True),
    "a sheet through a solid": ((CUBE,), (tray((90, 90, 2)), 20, -7, 0), "interference", 0, (3.5, 4.001), True),
    "in an open tray": ((TRAY,), (trimesh.creation.box((1, 1, 1)),), "clearance", 4.5, (0, 0), False),
    "on an open tray": ((TRAY,), (trimesh.creation.box((2, 2, 2)), 1, 0, -6), "touching", 0, (0, 0), True),
}


@pytest.mark.parametrize("case", KNOWN)
@pytest.mark.parametrize("turned", [False, True])
def test_parts_of_known_geometry(device, case, turned):
    """As they stand, exactly, and turned and moved together, which rounds coordinates."""
    first, second, kind, distance, depth, meet = KNOWN[case]
    scene = scene_of(device, {"a": first, "b": second})
    if turned:
        place = translation_matrix([3, -7, 20]) @ rotation_matrix(1.1, [1, 2, 3])
        shifts = [translation_matrix(part[1:] or (0, 0, 0)) for part in (first, second)]
        scene.set_poses(np.array([place @ shift for shift in shifts]))
    (found,) = find_clashes(scene, within=6)
    assert (found.first, found.second, found.kind, found.pair) == ("a", "b", kind, (0, 1))
    assert found.distance == pytest.approx(distance, abs=1e-6)
    if not turned or kind == "interference":
        assert (found.faces > 0) == meet
    assert found.open == tuple(name for name, part in {"a": first, "b": second}.items() if not part[0].is_watertight)
    if depth is None:
        assert found.penetration is None
    else:
        assert depth[0] - 1e-6 <= found.penetration <= depth[1] + 1e-6
    nearer = find_clashes(scene, within=distance - 0.01) if distance else []
    assert not nearer, "what is farther is left out"


def test_order_and_tolerance(device):
    parts = {"plate": (PLATE, 0, 0, 4), "pin": (pin(5.02),), "block": (CUBE, 20, 0, 14), "lid": (CUBE, 20, 0, 24.5)}
    parts |= {"ball": (trimesh.creation.icosphere(2, 1.0), 20, 0, 14)}
    scene = scene_of(device, parts)
    expected = [
        ("block", "ball", "interference"),
        ("plate", "pin", "interference"),
        ("plate", "block", "touching"),
        ("block", "lid", "clearance"),
    ]
    assert [(c.first, c.second, c.kind) for c in find_clashes(scene, within=2)] == expected
    kinds = {(c.first, c.second): c.kind for c in find_clashes(scene, tolerance=0.021)}
    assert kinds == {("block", "ball"): "interference", ("plate", "pin"): "touching", ("plate", "block"): "touching"}
    assert ("block", "lid") in {(c.first, c.second) for c in find_clashes(scene, tolerance=0.5)}
    # What was removed does not count for the size of the assembly, of which the tolerance is a part.
    size = assembly_size(scene)
    far = scene.add(ab.Model.load(CUBE), (1e9, 0, 0, 0, 0, 0, 1))
    assert assembly_size(scene) > 1e9
    scene.remove(far)
    assert assembly_size(scene) == size
    assert [(c.first, c.second, c.kind) for c in find_clashes(scene, within=2)] == expected
    for name, value in (("within", -1), ("within", np.nan), ("tolerance", np.inf)):
        refused(ValueError, f"{name}: .* is no distance of 0 or more", find_clashes, scene, **{name: value})


def test_balls_have_the_kinds_and_distances_of_fcl(device):
    fcl = pytest.importorskip("fcl")
    rng = np.random.default_rng(4)
    radii = np.array([0.5, 0.8, 1.1])
    meshes = [trimesh.creation.icosphere(3, radius) for radius in radii]
    centres = rng.uniform(0, 7, (24, 3))
    scene = scene_of(device, {f"{i}": (meshes[i % 3], *centre) for i, centre in enumerate(centres)})
    found = {clash.pair: clash for clash in find_clashes(scene, within=0.4)}
    assert {clash.kind for clash in found.values()} == {"interference", "clearance"}
    poses = np.hstack([centres, [(0, 0, 0, 1)] * 24])
    objects = [fcl_object(meshes[i % 3].vertices, meshes[i % 3].faces, pose) for i, pose in enumerate(poses)]
    for i in range(24):
        for j in range(i + 1, 24):
            apart = fcl.distance(objects[i], objects[j], fcl.DistanceRequest(), fcl.DistanceResult())
            (r, s), d = (radii[[i % 3, j % 3]], np.linalg.norm(centres[i] - centres[j]))
            deep = max(s - abs(d - r), r - abs(d - s))  # of the deepest point of one sphere in the other
            clash = found.pop((i, j), None)
            assert (clash is None) == (apart > 0.4)
            if clash is not None and apart > 0:
                assert clash.kind == "clearance" and clash.distance == pytest.approx(apart, abs=1e-6)
            elif clash is not None:
                assert clash.kind == "interference" and abs(clash.penetration - deep) < 0.02
    assert not found


@pytest.fixture
def assembly(tmp_path, monkeypatch):
    """Work in a folder with an assembly of a press fit, a gap of 0.5, two that touch and an open part."""
    monkeypatch.chdir(tmp_path)
    parts = {"plate": (PLATE, 0, 0, 4), "pin": (pin(5.02),), "block": (CUBE, 20, 0, 14)}
    source = source_of(parts | {"lid": (CUBE, 20, 0, 24.5), "tray": (tray((9, 9, 9)), 0, 60, 0)})
    source.export("assembly.glb")
    return source


def test_command(assembly, capsys, device):
    words = ("clash", "assembly.glb", "--within", 2, "--csv", "out.csv", "--glb", "out.glb", "--device", device)
    shown = json.loads(run(capsys, *words, "--json", status=1)[0])
    kinds = [(row["first"], row["second"], row["kind"]) for row in shown["pairs"]]
    assert kinds == list(zip(("plate", "plate", "block"), ("pin", "block", "lid"), CLASH_KINDS))
    assert [shown[kind] for kind in CLASH_KINDS] == [1, 1, 1] and shown["open"] == ["tray"] and shown["objects"] == 5
    assert shown["tolerance"] == pytest.approx(1e-6 * np.linalg.norm(np.ptp(assembly.bounds, axis=0)), rel=1e-6)
    with open("out.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["first"], row["second"], row["kind"]) for row in rows] == kinds
    assert float(rows[0]["penetration"]) == shown["pairs"][0]["penetration"] == pytest.approx(0.02, abs=1e-4)
    assert float(rows[2]["distance"]) == pytest.approx(0.5, abs=1e-6)
    written = trimesh.load_scene("out.glb")
    assert sorted(written.graph.nodes_geometry) == sorted([*assembly.graph.nodes_geometry, "curves of contact"])
    curves = written.geometry[written.graph["curves of contact"][1]]
    assert np.linalg.norm(curves.vertices[:, :2], axis=1).max() < 5.03, "the pin's, not the block's"
    text, _ = run(capsys, *words[:-4], "--device", device, status=1)
    assert "plate" in text and "open " in text and "tolerance" in text
    run(capsys, "clash", "assembly.glb", "--tolerance", 0.1, "--device", device, status=0)
    pytest.importorskip("pyvista")
    run(capsys, "clash", "assembly.glb", "--picture", "out.png", "--device", device, status=1)
    assert min(PIL.Image.open("out.png").size) > 100
