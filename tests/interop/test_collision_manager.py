"""CollisionManager against trimesh's, which uses FCL; contacts on both surfaces; slots reused and released."""

import gc
import itertools
import math
import weakref

import numpy as np
import pytest
import trimesh
from helpers import refused
from oracles.distance import surface_distance
from oracles.inside import parity
from oracles.triangle import brute_force_faces

import warp_abtree as ab
from warp_abtree.interop import collision_manager, placed_shapes

pytest.importorskip("fcl")
from trimesh.collision import CollisionManager as TrimeshManager
from trimesh.transformations import rotation_matrix
from trimesh.transformations import translation_matrix as shift


def shapes():
    """Convex solids, surfaces with holes, an open sheet, and one of several parts."""
    rng, create = np.random.default_rng(0), trimesh.creation
    crumbs = [create.icosphere(subdivisions=0, radius=0.1) for _ in range(5)]
    sheet = create.icosphere(subdivisions=2, radius=0.8)
    return {
        "ball": create.icosphere(subdivisions=1, radius=0.5),
        "box": create.box((0.7, 0.9, 0.5)),
        "large box": create.box((2, 2, 2)),
        "cylinder": create.cylinder(0.3, 1.2, sections=12),
        "torus": create.torus(0.6, 0.2, 16, 8),
        "annulus": create.annulus(0.3, 0.5, 0.6, sections=12),
        "crumbs": trimesh.util.concatenate([part.apply_translation(rng.uniform(-0.5, 0.5, 3)) for part in crumbs]),
        "sheet": trimesh.Trimesh(sheet.vertices, sheet.faces[:60], process=False),
    }


SHAPES = shapes()


def random_transform(rng, spread, real=np.float32):
    matrix = trimesh.transformations.random_rotation_matrix(rng.random(3))
    matrix[:3, 3] = rng.uniform(-spread, spread, 3)
    return matrix.astype(real).astype(np.float64)


def both(device):
    return TrimeshManager(), ab.CollisionManager(device)


def of_both(managers, call, *arguments):
    for manager in managers:
        getattr(manager, call)(*arguments)


def fill(managers, rng, count, spread, prefix=""):
    for k in range(count):
        of_both(managers, "add_object", f"{prefix}{k}", SHAPES[rng.choice(list(SHAPES))], random_transform(rng, spread))


def assert_same_names(theirs, ours, call, *arguments):
    """Compare one call of both managers, with names and without; return the names. Other managers come in pairs."""
    theirs_of, ours_of = ([a[k] if isinstance(a, tuple) else a for a in arguments] for k in (0, 1))
    expected = getattr(theirs, call)(*theirs_of, return_names=True)
    assert getattr(ours, call)(*ours_of, return_names=True) == expected
    assert getattr(ours, call)(*ours_of) == getattr(theirs, call)(*theirs_of) == expected[0]
    return expected[1]


def test_names_in_a_scene_that_changes(device, monkeypatch):
    monkeypatch.setattr(collision_manager, "FIRST_PAIRS", 2)
    rng, hits, misses = np.random.default_rng(2), 0, 0
    managers = theirs, ours = both(device)
    fill(managers, rng, 8, 1.2)
    names = [str(k) for k in range(8)]
    for step in range(40):
        name = rng.choice(names)
        if step % 3 == 0:
            of_both(managers, "remove_object", name)
            names.remove(name)
        elif step % 3 == 1:
            name, mesh, transform = f"new {step}", SHAPES[rng.choice(list(SHAPES))], random_transform(rng, 1.2)
            of_both(managers, "add_object", name, mesh, transform)
            names.append(name)
        of_both(managers, "set_transform", names[step % len(names)], random_transform(rng, 1.2))
        found = assert_same_names(theirs, ours, "in_collision_internal")
        hits, misses = hits + len(found), misses + math.comb(len(names), 2) - len(found)
        mesh, transform = list(SHAPES.values())[step % len(SHAPES)], random_transform(rng, 1.2)
        assert_same_names(theirs, ours, "in_collision_single", mesh, transform)
    assert hits > 50 and misses > 50
    others = both(device)
    fill(others, rng, 5, 1.2, "other ")
    assert len(assert_same_names(theirs, ours, "in_collision_other", others)) > 3


@pytest.mark.parametrize("name", SHAPES)
def test_closed_meshes_are_solids(device, name):
    """As for trimesh where they are convex; what lies inside any other is found too."""
    mesh = SHAPES[name]
    crumb = trimesh.creation.icosphere(subdivisions=0, radius=0.01)
    theirs, ours = managers = both(device)
    of_both(managers, "add_object", name, mesh)
    inside = 0
    for at in itertools.product((-0.4, 0.0, 0.4), repeat=3):
        held = mesh.is_watertight and parity(crumb.vertices[0] + at, mesh.triangles)
        found, expected = (manager.in_collision_single(crumb, shift(at)) for manager in (ours, theirs))
        assert found == (expected or held) and (found == expected or not mesh.is_convex)
        inside += held
    surfaces = ab.CollisionManager(device, solids=False)
    surfaces.add_object(name, mesh)
    assert not surfaces.in_collision_single(crumb)
    assert inside > 0 or name in ("annulus", "crumbs", "sheet")


def distance_to_face(mesh, transform, face, point):
    corners = trimesh.transform_points(mesh.triangles[face], transform)[None]
    return np.linalg.norm(trimesh.triangles.closest_point(corners, point[None])[0] - point)


def test_contacts_lie_on_both_faces(device):
    rng = np.random.default_rng(3)
    ours = ab.CollisionManager(device)
    placed = {name: random_transform(rng, 0.5, np.float64) for name in SHAPES}
    for name, transform in placed.items():
        ours.add_object(name, SHAPES[name], transform)
    found, pairs, contacts = ours.in_collision_internal(return_names=True, return_data=True)
    assert found and {tuple(sorted(contact.names)) for contact in contacts} == pairs
    for contact in contacts[:: max(1, len(contacts) // 200)]:
        a, b = sorted(contact.names)
        for name in (a, b):
            gap = distance_to_face(SHAPES[name], placed[name], contact.index(name), contact.point)
            if gap > 1e-12:  # a component inside a solid
                ends = [distance_to_face(SHAPES[name], placed[name], contact.index(name), x) for x in contact.segment]
                assert min(ends) < 1e-12
                assert np.linalg.norm(contact.segment[0] - contact.segment[1]) <= contact.depth + 1e-9
        assert np.linalg.norm(contact.normal) == pytest.approx(1) and contact.depth >= 0


def test_face_pairs_against_brute_force(device):
    a, b, place = SHAPES["torus"], SHAPES["cylinder"], (0.5, 0.1, 0.02)
    ours, other = ab.CollisionManager(device), ab.CollisionManager(device)
    ours.add_object("a", a)
    other.add_object("b", b, shift(place))
    still, moved = [0, 0, 0, 0, 0, 0, 1], [*place, 0, 0, 0, 1]
    expected = brute_force_faces(a.vertices, a.faces, b.vertices, b.faces, still, moved).tolist()
    assert len(expected) > 20
    found, names, contacts = ours.in_collision_single(b, shift(place), return_names=True, return_data=True)
    assert found and names == {"a"} and [[x.index("a"), x.index("__external")] for x in contacts] == expected
    _, names, contacts = ours.in_collision_other(other, True, True)
    assert names == {("a", "b")} and [[x.index("a"), x.index("b")] for x in contacts] == expected


def test_a_component_inside_a_solid(device):
    ours, inner, hollow = (ab.CollisionManager(device) for _ in range(3))
    box = SHAPES["large box"]
    ours.add_object("box", box, shift((5, 0, 0)))
    crumb, at = trimesh.creation.box((0.2, 0.2, 0.2)), shift((5.5, 0, 0))
    inner.add_object("crumb", crumb, at)
    hollow.add_object("crumb", crumb)
    for answer, name, normal in (
        (ours.in_collision_single(crumb, at, True, True), "box", 1),
        (ours.in_collision_other(inner, True, True), "box", 1),
        (hollow.in_collision_single(box, shift((-0.5, 0, 0)), True, True), "__external", -1),
    ):
        found, names, (contact,) = answer
        # The side at 5.4 is deepest, 0.6 under the plane x = 6.
        assert found and len(names) == 1 and contact.depth == pytest.approx(0.6)
        assert np.allclose(contact.normal, [normal, 0, 0])
        assert contact.segment[0 if normal < 0 else 1][0] == pytest.approx(5.4 if name == "box" else -0.1)
        assert (box.triangles[contact.index(name)][:, 0] == 1).all()
    # One component of several is enough, and the solid may be the second of the pair.
    parts = trimesh.util.concatenate([crumb, crumb.copy().apply_translation((50, 0, 0))])
    assert ours.in_collision_single(parts, shift((-45, 0, 0)))
    assert not ours.in_collision_single(parts, shift((-40, 0, 0)))
    assert hollow.in_collision_single(box) and not hollow.in_collision_single(SHAPES["torus"])


@pytest.mark.slow
def test_distances_on_random_scenes(device):
    rng = np.random.default_rng(4)
    apart = 0
    for spread in (2.5, 4.0, 8.0):
        managers, others = both(device), both(device)
        fill(managers, rng, 5, spread)
        fill(others, rng, 4, spread, "other ")
        calls = [("internal", (name,)) for name in (None, *map(str, range(5)))] + [("other", ())]
        calls += [("single", (mesh, random_transform(rng, spread))) for mesh in SHAPES.values()]
        for kind, arguments in calls:
            named = {"return_name" if kind == "single" else "return_names": True}
            expected, found = (
                getattr(manager, f"min_distance_{kind}")(*(arguments if kind != "other" else (other,)), **named)
                for manager, other in zip(managers, others)
            )
            assert max(found[0], 0) == pytest.approx(max(expected[0], 0), abs=1e-5), (kind, arguments)
            assert found[1] == expected[1] if expected[0] > 1e-5 else found[0] <= 0
            apart += expected[0] > 1e-5
    assert apart > 15


def test_nearest_points(device):
    rng = np.random.default_rng(5)
    ours, placed = ab.CollisionManager(device), {}
    for k, (name, mesh) in enumerate(SHAPES.items()):
        placed[name] = random_transform(rng, 0, np.float64)
        placed[name][:3, 3] += 2.5 * np.array([k % 2, k // 2 % 2, k // 4])
        ours.add_object(name, mesh, placed[name])
    distance, names, data = ours.min_distance_internal(return_names=True, return_data=True)
    assert data.names == set(names) and data.distance == distance > 0
    points = [data.point(name) for name in names]
    assert np.linalg.norm(points[0] - points[1]) == pytest.approx(distance, rel=1e-12)
    for name, point in zip(names, points):
        assert distance_to_face(SHAPES[name], placed[name], data.index(name), point) < 1e-12
    # All pairs of faces: none is nearer.
    posed = {}
    for name, mesh in SHAPES.items():
        posed[name] = trimesh.transform_points(mesh.vertices, placed[name])[mesh.faces]
    least = min(surface_distance(a, b) for a, b in itertools.combinations(posed.values(), 2))
    assert distance == pytest.approx(least, rel=1e-12)


def test_managers_without_objects(device):
    theirs, ours = both(device)
    ball, none = SHAPES["ball"], (False, set(), [])
    assert ours.in_collision_internal(True, True) == theirs.in_collision_internal(True, True) == none
    assert ours.in_collision_single(ball, None, True, True) == none and ours.in_collision_other(ours) is False
    assert ours.min_distance_internal(return_names=True) == (math.inf, None)
    assert ours.min_distance_single(ball, return_name=True, return_data=True) == (math.inf, None, None)
    assert ours.min_distance_other(ours) == math.inf
    ours.add_object("one", ball)
    assert ours.in_collision_internal(True) == (False, set()) and ours.min_distance_internal() == math.inf


def test_replaced_and_changed_meshes(device):
    ours = ab.CollisionManager(device)
    mesh = trimesh.creation.box((1, 1, 1))
    ours.add_object("a", mesh)
    ball, at = SHAPES["ball"], shift((1.2, 0, 0))
    assert not ours.in_collision_single(ball, at)
    mesh.apply_scale(2)
    assert not ours.in_collision_single(ball, at), "what was added stays as it was"
    ours.add_object("a", mesh)
    assert ours.in_collision_single(ball, at)
    ours.remove_object("a")
    refused(ValueError, "a not in collision manager", ours.remove_object, "a")


def test_slots_are_reused_and_released(device):
    ours, other = ab.CollisionManager(device), ab.CollisionManager(device)
    for k in range(4):
        ours.add_object(k, SHAPES["ball"], shift((0.7 * k, 0, 0)))
    expected = {(0, 1), (1, 2), (2, 3)}
    assert ours.in_collision_internal(True) == (True, expected)
    for k in range(30):
        other.add_object(k, SHAPES["torus"], shift((0, 0, 0.4 * k)))
    before = ours._placed.scene
    for _ in range(3):
        ours.in_collision_single(SHAPES["box"])
        ours.add_object("x", SHAPES["box"])
        ours.remove_object("x")
    arrays = before.batch()
    ours.in_collision_single(SHAPES["box"])
    assert ours._placed.scene.batch() is arrays, "the second call uploads nothing but poses"
    assert ours._placed.scene is before and before.object_count == 5
    answers = [ours.in_collision_other(other, True) for _ in range(2)]
    assert answers[0] == answers[1] and len(answers[0][1]) > 2
    assert ours._placed.scene.object_count == 4, "more slots are free than used, and than 16"
    assert ours.in_collision_internal(True) == (True, expected)
    assert other.in_collision_internal(True)[0] and other._placed.scene.object_count == 30


def test_equal_meshes_share_a_model_that_goes_with_them(device):
    managers = [ab.CollisionManager(device) for _ in range(2)]
    mesh = trimesh.creation.box((1, 2, 3.25))
    for k, manager in enumerate(managers):
        manager.add_object(k, mesh.copy())
    model = managers[0]._placed.scene.models[0]
    assert managers[1]._placed.scene.models == [model]
    managers[0].add_object(2, model, shift((0.5, 0, 0)))
    assert managers[0].in_collision_internal() and managers[0]._placed.scene.models == [model]
    gone, known = weakref.ref(model), len(placed_shapes._SHAPES)
    del managers, manager, model
    gc.collect()
    assert gone() is None and len(placed_shapes._SHAPES) < known


def test_bad_input(device):
    ours = ab.CollisionManager(device)
    ball, eye, rigid = SHAPES["ball"], np.eye(4), "transform of 'a'.*not rigid"
    ours.add_object("a", ball)
    cases = [
        (lambda: ours.add_object("a", 3), ab.MeshError, "cannot load a mesh from int"),
        (lambda: ours.in_collision_single(trimesh.Trimesh()), ab.MeshError, "no faces"),
        (lambda: ours.set_transform("b", eye), ValueError, "b not in collision manager"),
        (lambda: ours.min_distance_internal("b"), ValueError, "b not in collision manager"),
        (lambda: ours.in_collision_other(TrimeshManager()), TypeError, r"not a warp_abtree\.CollisionManager"),
        (lambda: ours.min_distance_other(TrimeshManager()), TypeError, r"not a warp_abtree\.CollisionManager"),
        (lambda: ab.CollisionManager("nothing:7"), ValueError, "no device"),
    ]
    for bad, message in (
        (np.diag([1, 1, 2.0, 1]), rigid),
        (np.nan * eye, "not finite"),
        (np.eye(3), r"shape \(3, 3\), not \(4, 4\)"),
    ):
        cases += [
            (lambda bad=bad: ours.add_object("a", SHAPES["box"], bad), ValueError, message),
            (lambda bad=bad: ours.set_transform("a", bad), ValueError, message),
            (lambda bad=bad: ours.in_collision_single(ball, bad), ValueError, message.replace("'a'", "'__external'")),
        ]
    for call, kind, message in cases:
        refused(kind, message, call)
    assert ours.in_collision_single(ball, return_names=True) == (True, {"a"})
    assert ours._placed.scene.object_count == 2 and collision_manager.EXTERNAL == "__external"


def test_first_contacts(device):
    manager = ab.CollisionManager(device)
    assert manager.first_contact_internal({}, return_names=True) == (1.0, None)
    box = trimesh.creation.box()
    for name, x in (("a", 0.0), ("b", 3.0), ("c", -4.0)):
        manager.add_object(name, box, shift((x, 0, 0)))
    assert manager.first_contact_internal({}) == 1.0
    # b reaches a after 2 of 4, c after 3 of 4.
    ends = {"b": shift((-1.0, 0.1, 0.2)), "c": shift((0.0, 0.1, 0.2))}
    time, names = manager.first_contact_internal(ends, return_names=True)
    assert names == ("a", "b") and time == pytest.approx(0.5, abs=1e-6) and time <= 0.5
    # What moves ends nowhere: the objects stand where they stood.
    assert manager.first_contact_internal(ends) == time and not manager.in_collision_internal()
    manager.remove_object("b")
    assert manager.first_contact_internal({"c": shift((0.0, 0.1, 0.2))}) == pytest.approx(0.75, abs=1e-6)
    manager.set_transform("c", shift((0.2, 0, 0)))
    assert manager.first_contact_internal({}, return_names=True) == (0.0, ("a", "c"))
    manager.set_transform("c", shift((-4, 0, 0)))
    for ends, message in (
        ({"d": np.eye(4)}, "d not in"),
        ({"c": 2 * np.eye(4)}, "not rigid"),
        ({"c": rotation_matrix(np.pi, (0, 0, 1))}, "half a revolution"),
    ):
        refused(ValueError, message, manager.first_contact_internal, ends)


def test_depths_as_of_convex_solids(device):
    """Balls and boxes that a straight way frees: the depth that FCL finds by expanding a polytope."""
    theirs, ours = managers = both(device)
    of_both(managers, "add_object", "box", trimesh.creation.box((4, 4, 4)))
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    for sink in (0.05, 0.2, 0.4):
        at = shift((0.1, 0.2, 2.5 - sink))
        distance, data = ours.min_distance_single(ball, at, return_data=True)
        assert distance == data.distance == pytest.approx(theirs.min_distance_single(ball, at), abs=1e-5)
        assert distance == pytest.approx(-sink, abs=1e-9)
        _, contacts = ours.in_collision_single(ball, at, return_data=True)
        assert all(contact.depth == pytest.approx(sink, abs=1e-9) for contact in contacts) and contacts
        assert ours.min_distance_internal() == math.inf
    surfaces = ab.CollisionManager(device, solids=False)
    surfaces.add_object("box", trimesh.creation.box((4, 4, 4)))
    assert surfaces.min_distance_single(ball, shift((0.1, 0.2, 2.1))) == 0
    _, contacts = surfaces.in_collision_single(ball, shift((0.1, 0.2, 2.4)), return_data=True)
    assert all(contact.depth == pytest.approx(0.1, abs=1e-9) for contact in contacts) and contacts


@pytest.mark.parametrize("solids", [True, False])
@pytest.mark.parametrize(
    ("first", "second", "offset", "depth"),
    [
        ((12, 12, 1), (1, 1, 10), (0, 0, 0), 5.5),
        ((6, 1, 1), (1, 6, 0.6), (0, 0, 0), 0.8),
        ((1, 1, 1), (0.5, 0.5, 0.5), (0.1, 0.2, 0.73), 0.02),
        ((1, 1, 1), (1, 1, 1), (0, 0, 1), 0),
    ],
    ids=["pin through a plate", "crossing bars", "press fit", "touching"],
)
def test_depths_are_penetration_depths(device, first, second, offset, depth, solids):
    """Of all contacts of a pair, in both orders and turned as one; moved by their ways out, objects come free."""
    ours, other = (ab.CollisionManager(device, solids) for _ in range(2))
    turn = trimesh.transformations.random_rotation_matrix(np.array([0.3, 0.1, 0.8]))
    place = shift((3, -2, 1)) @ turn if depth else np.eye(4)
    ours.add_object("a", trimesh.creation.box(first), place)
    ours.add_object("far", trimesh.creation.box(first), shift((99, 0, 0)))
    at, mesh = place @ shift(offset), trimesh.creation.box(second)
    other.add_object("b", mesh, at)
    answers = [ours.in_collision_other(other, return_data=True), other.in_collision_other(ours, return_data=True)]
    ours.add_object("b", mesh, at)
    answers.append(ours.in_collision_internal(return_data=True))
    for hit, contacts in answers:
        assert hit and contacts
        for contact in contacts:
            assert contact.names == {"a", "b"} and contact.depth == pytest.approx(depth, abs=1e-9)
            assert np.linalg.norm(contact.way_out("a")) == pytest.approx(contact.depth)
            np.testing.assert_array_equal(contact.way_out("a"), -contact.way_out("b"))
    for name, start in (("a", place), ("b", at)) if depth else ():
        for part, expected in ((1 - 1e-6, True), (1 + 1e-9, False)):
            moved = start.copy()
            moved[:3, 3] += part * contacts[0].way_out(name)
            ours.set_transform(name, moved)
            assert ours.in_collision_internal() == expected
        ours.set_transform(name, start)
