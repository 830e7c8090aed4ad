"""Contacts with a gap: face pairs, separations, points and normals against integers, and what a gap leaves alone."""

import itertools

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers import refused
from helpers.bodies import box, model_of
from helpers.contacts import check_mirrored, exact_normal, summary, unit
from helpers.faults import describe
from helpers.nested import speck_cases
from helpers.questions import pairs_of, random_case, scene_of
from helpers.samples import STILL, sample
from helpers.scenes import scene_with
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from oracles.distance import brute_distances
from oracles.triangle import into_frame_of_a, quaternion_matrix
from oracles.triangle_distance import near_faces

import warp_abtree as ab
from warp_abtree import testing

NAMES = ("box", "small ball", "crumbs", "soup", "torus", "capsule", "lattice soup", "twins", "grid", "three", "one")


def corners_of(model, lod):
    vertices, faces, ids = model.mesh_at(lod)
    return vertices[faces], ids


def check_rows(rows, case, gap, close=1e-13):
    """Compare a pair's contacts with the oracle's; return how many faces cross, and how many are near."""
    model_a, lod_a, pose_a, model_b, lod_b, pose_b = case
    (a, ids_a), (b, ids_b) = corners_of(model_a, lod_a), corners_of(model_b, lod_b)
    b = into_frame_of_a(b.reshape(-1, 3), pose_a, pose_b).reshape(-1, 3, 3)
    size = max(np.abs(a).max(), np.abs(b).max())
    pairs, separations, met = near_faces(a, b, gap)
    doubtful = ~met & (np.abs(separations - gap) <= close * size)
    wanted = {
        (int(ids_a[i]), int(ids_b[j])): (s, m, sure)
        for (i, j), s, m, sure in zip(pairs, separations, met, ~doubtful)
        if m or s < gap or not sure
    }
    found = {tuple(row["faces"].tolist()): row for row in rows}
    assert len(found) == len(rows)
    assert set(found) <= set(wanted)
    assert {key for key, (_, _, sure) in wanted.items() if sure} <= set(found)
    r = quaternion_matrix(pose_a[3:])
    place_a, place_b = ({int(f): k for k, f in enumerate(ids)} for ids in (ids_a, ids_b))
    for key, row in found.items():
        s, m, _ = wanted[key]
        assert (row["separation"] < 0) == m and row["separation"] != 0
        assert abs(row["separation"] - s) <= (1e-8 if m else close) * size
        if not m:
            faces = a[place_a[key[0]]], b[place_b[key[1]]]
            ends = (row[["p0", "p1"]].tolist() - np.array(pose_a[:3])) @ r
            for end, face in zip(ends, faces):
                assert brute_distances(end[None], face[None]).max() <= 1e-12 * size
            between = row["p1"] - row["p0"]
            assert abs(np.linalg.norm(between) - row["separation"]) <= 1e-12 * size
            if row["separation"] > 1e-3 * size:
                np.testing.assert_allclose(row["normal"], between / np.linalg.norm(between), atol=1e-8)
            for name, face in zip(("normal_a", "normal_b"), faces):
                np.testing.assert_allclose(row[name], r @ unit(exact_normal(face)), atol=1e-9)
            assert not row["coplanar"]
            assert abs(np.linalg.norm(row["normal"]) - 1) < 1e-14
    return int(met.sum()), int((~met & (separations < gap)).sum())


def cases_of(seed, count, faces=40):
    rng, cases, gaps = np.random.default_rng(seed), [], []
    for k in range(count):
        case = random_case(rng, rng.choice(NAMES, 2), faces)
        away = rng.normal(size=3)
        case[5][:3] += (k % 3) * 0.1 * away / np.linalg.norm(away)
        cases.append(case)
        gaps.append(rng.choice([0.0, 0.01, 0.1, 0.3]))
    return cases, np.array(gaps)


def test_equals_brute_force(device, regime):
    cases, gaps = cases_of(1, 36)
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    result = scene.intersect(pairs, output="contacts", gap=gaps)
    result.check()
    rows = [result.contacts[result.contacts["pair"] == p] for p in range(len(cases))]
    totals = [check_rows(*each) for each in zip(rows, cases, gaps)]
    met, near = np.array(totals).T
    assert met.sum() > 300 and near.sum() > 200 and (met == 0).any()
    np.testing.assert_array_equal(result.any, met > 0)
    np.testing.assert_array_equal(result.count, np.bincount(result.contacts["pair"], minlength=len(cases)))
    np.testing.assert_array_equal(result.faces, np.column_stack([result.contacts["pair"], result.contacts["faces"]]))
    check_mirrored(result.contacts, scene.intersect(pairs[:, ::-1], output="contacts", gap=gaps).contacts)


corner = st.tuples(*[st.integers(-3, 3).map(float) | st.sampled_from([0.1, 1 / 3, 0.5, 1e-9])] * 3)


@st.composite
def triangles(draw):
    """Two triangles with corners on a small lattice: coplanar, parallel, touching, and without area."""
    corners = draw(st.lists(corner, min_size=6, max_size=6))
    a, b = np.array(corners[:3]), np.array(corners[3:])
    if draw(st.booleans()):
        b[:, 2] = a[:, 2] = a[0, 2]
        b[:, 2] += draw(st.sampled_from([0.0, 0.25, 1e-7, 1e-15]))
    return a, b


@settings(deadline=None, max_examples=80, suppress_health_check=list(HealthCheck))
@given(triangles(), st.sampled_from([0.0, 0.25, 1.0, 3.0]))
def test_single_faces_equal_integers(device, pair, gap):
    if any(len(np.unique(corners, axis=0)) < 3 for corners in pair):
        return
    models = [ab.Model.from_arrays(corners, [[0, 1, 2]]) for corners in pair]
    if any(model.face_count == 0 for model in models):
        return
    case = (models[0], 0, np.array(STILL), models[1], 0, np.array(STILL))
    for warps in (False, True) if device == "cpu" else (True,):
        with testing.regime(warps=warps):
            result = scene_of(device, [case]).intersect([(0, 1)], output="contacts", gap=gap)
        check_rows(result.contacts, case, gap)


def test_without_more_faces_nothing_changes(device, regime):
    """What crosses has the bits that it has without a gap; so have sums over the pair but for their rounding."""
    cases, _ = cases_of(2, 24, 300)
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    pairs[::2] = pairs[::2, ::-1]
    plain = scene.intersect(pairs, output="contacts")
    for gap in (0.0, 0.05):
        result = scene.intersect(pairs, output="contacts", gap=gap)
        crossing = result.contacts[result.contacts["separation"] < 0]
        for name in plain.contacts.dtype.names:
            np.testing.assert_array_equal(crossing[name], plain.contacts[name])
        assert (len(result.contacts) > len(crossing)) == (gap > 0)
        np.testing.assert_array_equal(result.any, plain.any)
        for name in ("point", "normal"):
            room = 1e-9 * (gap > 0)
            np.testing.assert_allclose(result.pair_contacts[name], plain.pair_contacts[name], rtol=room, atol=room)
    for p in np.flatnonzero(plain.any)[:5]:
        point, _ = summary(plain.contacts[plain.contacts["pair"] == p])
        np.testing.assert_allclose(result.pair_contacts["point"][p], point, atol=1e-9)


def test_same_bits_on_every_path_and_device(device):
    cases, gaps = cases_of(3, 30, 200)
    pairs = pairs_of(cases)
    found = []
    for where, options in (
        *[("cpu", {"warps": False, "cpu_threads": threads}) for threads in (1, 2)],
        *[(device, {"warps": warps}) for warps in (True, None)],
        (device, {"plain_tests": 0}),  # slabs of subtrees wherever they can be
    ):
        with testing.regime(**options):
            found.append(describe(scene_of(where, cases).intersect(pairs, output="contacts", gap=gaps)))
    assert all(other == found[0] for other in found[1:])


@pytest.mark.parametrize("other", [[(1, 1, 0), (1, 2, 1), (2, 1, 1)], [(1, 1, 0), (5, 1, 0), (1, 5, 0)]])
def test_faces_that_touch_or_overlap_in_a_plane_cross_by_the_least_depth(device, other):
    floor = [(0, 0, 0), (4, 0, 0), (0, 4, 0)]
    models = [ab.Model.from_arrays(np.array(corners, float), [[0, 1, 2]]) for corners in (floor, other)]
    for placed, dtype in itertools.product((models, models[::-1]), (np.float64, np.float32)):
        result = scene_with(device, *placed).intersect([(0, 1)], output="contacts", gap=9.0, contact_dtype=dtype)
        assert result.contacts["separation"].tolist() == [-(2.0**-126)] and result.any[0]


@pytest.mark.parametrize("turn", [(0, 0, 0, 1), (0.5, 0.5, 0.5, 0.5), (0, 0.6, 0, 0.8)])
def test_a_gap_reaches_as_far_as_it_says(device, regime, turn):
    """Sheets over one another at a distance that a little less does not reach, and a little more does."""
    up = quaternion_matrix(turn) @ [0, 0, 0.3]
    scene = scene_with(device, *[(sample("grid"), (*place, *turn)) for place in ((0, 0, 0), up)])
    assert len(scene.intersect([(0, 1)], output="contacts", gap=0.3 * (1 - 1e-12)).contacts) == 0
    found = scene.intersect([(0, 1)], output="contacts", gap=0.3 * (1 + 1e-12)).contacts
    # Each face and the six around it, and those that share a corner, are 0.3 apart.
    faces, _ = corners_of(sample("grid"), sample("grid").lod_max)
    shared = (faces[:, None, :, None] == faces[None, :, None]).all(4).any((2, 3))
    assert len(found) == shared.sum()


def test_the_broad_phase_is_wider(device):
    """Boxes 0.01 apart are pairs where that, or more, is asked; also of the operator, and of objects' own gaps."""
    scene = scene_with(device, *[(box(1, 1, 1), (x, 0, 0, 0, 0, 0, 1)) for x in (0.0, 1.01, 2.03)])
    assert len(scene.broad_phase()) == 0 == len(scene.intersect(output="contacts").pairs)
    for asked in ({"within": 0.015}, {"gap": 0.015, "output": "contacts"}, {"output": "distance", "beyond": 0.015}):
        assert scene.intersect(**asked).pairs.tolist() == [[0, 1]]
        assert len(scene.intersect(**{**asked, **{k: 0.03 for k in asked if k != "output"}}).pairs) == 2
    assert len(scene.broad_phase()) == 0
    assert ab.Query(scene, "any", within=0.015).run().pairs.tolist() == [[0, 1]]
    result = ab.ContactQuery(scene, gap=0.015).run()
    assert result.pairs.tolist() == [[0, 1]]
    np.testing.assert_allclose(result.contacts["separation"].min(), 0.01, rtol=1e-12)
    rows = np.zeros((3, 4))
    rows[:, 3] = 0.004, 0.008, 0.011
    own = wp.array(rows, dtype=wp.vec4d, device=device)
    query = ab.ContactQuery(scene, gap=own)
    assert query.run().pairs.tolist() == [[0, 1]]
    assert (query.result().contacts["separation"] < 0.012).all() and len(query.result().contacts)
    rows[:, 3] = 0.0, 0.011, 0.011
    own.assign(rows)
    query.launch()
    assert sorted(map(tuple, query.result().pairs.tolist())) == [(0, 1), (1, 2)]
    # Two that move together come no nearer.
    rows[:] = [(0.0, 0.9, 0.0, 0.0), (0.0, 0.9, 0.0, 0.0), (-0.025, 0.9, 0.0, 0.0)]
    own.assign(rows)
    result = query.run()
    assert set(map(tuple, result.pairs[result.contacts["pair"]].tolist())) == {(1, 2)}
    assert ab.ContactQuery(scene, gap=np.array([0.0, 0.011, 0.011])).run().contacts["separation"].max() < 0.022


def test_other_pairs_and_gaps(device):
    cases, gaps = cases_of(7, 10, 100)
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    expected = [describe(scene.intersect(pairs[k:], output="contacts", gap=gaps[k:])) for k in (0, 4)]
    query = ab.ContactQuery(scene, pairs[:2], gap=0.5)
    for k, wanted in zip((0, 4), expected):
        query.set_pairs(pairs[k:], gap=gaps[k:])
        assert describe(query.run()) == wanted
    query.set_pairs(pairs, gap=0.01)
    assert describe(query.run()) == describe(scene.intersect(pairs, output="contacts", gap=0.01))
    assert describe(ab.ContactQuery(scene, pairs, gap=0.01).run()) == describe(query.result())


def test_capture_and_room(device, regime):
    cases, gaps = cases_of(9, 12, 200)
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    query = ab.ContactQuery(scene, pairs, gap=gaps)
    result = query.run()
    expected = describe(result)
    with wp.ScopedCapture(device) as capture:
        query.launch()
    query.hits.total.fill_(-1)
    query.contacts.separation.fill_(0)
    wp.capture_launch(capture.graph)
    assert describe(query.result()) == expected
    tight = ab.ContactQuery(scene, pairs, capacity=ab.Buffers(hits=3, uncertain=5), gap=gaps)
    tight.launch()
    with pytest.raises(ab.CapacityError, match=r"room for [35]"):
        tight.result().check()
    assert describe(tight.run()) == expected
    frame = ab.Pipeline(scene, output="contacts", pairs=pairs, capacity=ab.Buffers(hits=10**5), gap=gaps)
    frame.launch()
    frame.check()
    np.testing.assert_array_equal(frame.result().faces, result.faces)


def test_nothing_is_allocated_without_a_gap(device):
    scene = scene_of(device, cases_of(10, 2)[0])
    query = ab.ContactQuery(scene, [(0, 1)])
    for owner, name in ((query.hits, "gap"), (query.hits, "apart"), (query.contacts, "separation")):
        array = getattr(owner, name)
        assert array is None or array.shape == (0,) or array.ptr is None
    assert "separation" not in query.run().contacts.dtype.names


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1e-300, "wide", [0.1, 0.2], None])
def test_bad_gaps_are_refused(device, bad):
    scene = scene_of(device, cases_of(11, 2)[0])
    if bad is None:
        for output in ("any", "count", "faces", "distance"):
            refused(ValueError, "gap means nothing", scene.intersect, [(0, 1)], output=output, gap=0.1)
        refused(ValueError, "precision", scene.intersect, [(0, 1)], output="contacts", gap=0.1, precision="float32")
        refused(ValueError, "made without gap", ab.ContactQuery(scene, [(0, 1)]).set_pairs, [(0, 1)], gap=0.1)
        return
    for ask in (
        lambda: scene.intersect([(0, 1)], output="contacts", gap=bad),
        lambda: scene.intersect(output="contacts", gap=bad),
        lambda: ab.ContactQuery(scene, [(0, 1)], gap=bad),
        lambda: ab.ContactQuery(scene, gap=bad),
    ):
        refused(ValueError, "gap: ", ask)


def test_huge_gaps_reach_everything(device, regime):
    scene = scene_with(device, box(1, 1, 1), (model_of(trimesh.creation.icosphere(1)), (3.0, 0, 0, 0, 0, 0, 1)))
    for gap in (1e3, 1e30, 1e300, 1.7e308):
        assert len(scene.intersect([(0, 1)], output="contacts", gap=gap).contacts) == 12 * 80


@pytest.mark.parametrize("far", [1e17, 1e18, 1e19, 1e22, 1e25, 1e30])
def test_objects_nearer_than_a_huge_gap_have_all_their_faces(device, regime, far):
    """About 2^60 of their sizes apart, where float32 cuts gaps off, and farther."""
    for size, axis in itertools.product((1e-10, 1.0), range(3)):
        part = model_of(trimesh.creation.box((size,) * 3))
        scene = scene_with(device, part, (part, (*(far * size * np.eye(3)[axis]), 0, 0, 0, 1)))
        assert len(scene.intersect([(0, 1)], output="contacts", gap=1.1 * far * size).contacts) == 12 * 12


@pytest.mark.parametrize("gap", [1e-3, 3e-5])
def test_faces_a_little_nearer_than_a_gap_are_found(device, regime, gap):
    """By less than float32 tells, far from the middle of a large object: none is lost."""
    cases, distances = speck_cases(np.random.default_rng(2), 60, gap, gap)
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    for part, finds in ((1 + 1e-9, True), (1 - 1e-9, False)):
        result = scene.intersect(pairs, output="contacts", gap=distances * part)
        assert not result.any.any()
        # Of both objects the first face, and no other.
        np.testing.assert_array_equal(result.contacts["pair"], pairs[:, 0] // 2 if finds else [])
        assert (result.contacts["faces"] == 0).all()
