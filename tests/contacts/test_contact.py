"""Contacts: ends against exact clipping, definitions, symmetries, and sums over object pairs."""

import numpy as np
import pytest
from helpers.contacts import check_mirrored, check_summaries, exact_normal, lies_in_plane, unit
from helpers.samples import SHAPES, STILL, contact_poses, sample, soup
from helpers.scenes import scene_with
from oracles.distance import brute_distances
from oracles.triangle import cross, into_frame_of_a, quaternion_matrix, shared_polygon

import warp_abtree as ab

VECTORS = ("p0", "p1", "normal_a", "normal_b", "normal")


def slivers(count, seed):
    """Triangles about 1e-12 times as wide as long through the origin, nearly in one plane; some are segments."""
    rng = np.random.default_rng(seed)
    along = rng.normal(size=(count, 3)) * [1, 1, 0]
    width = np.where(rng.random((count, 1)) < 0.2, 0.0, 1e-12) * rng.normal(size=(count, 3))
    third = width + rng.uniform(-0.3, 0.7, (count, 1)) * along
    corners = np.stack([-0.3 * along, 0.7 * along, third], 1)
    corners[-1] = np.eye(3) - 0.3
    return corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)


def model_of(name):
    if name == "slivers":
        return ab.Model.from_arrays(*slivers(80, 0))
    if name == "flat soup":
        vertices, faces = soup(120, 4, lattice=4)
        return ab.Model.from_arrays(vertices * [1, 1, 0], faces)
    return sample(name)


def contacts_of(device, *placed, pairs=((0, 1),), **options):
    """Return the contacts of a scene of (model, pose)."""
    result = scene_with(device, *placed).intersect(np.array(pairs), output="contacts", **options)
    result.check()
    return result


def triangles(model, faces):
    vertices, corners, ids = model.mesh_at(model.lod_max)
    return vertices[corners[np.searchsorted(ids, faces)]]


CASES = {
    "soups": ("soup", "ball", (0.1, 0.2, -0.1, 0.5, 0.5, 0.5, 0.5)),
    "lattice soups": ("lattice soup", "lattice soup", (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)),
    "turned lattice soups": ("lattice soup", "lattice soup", (0.0, 1.0, 1.0, 0.5, 0.5, 0.5, 0.5)),
    "nearly twins": ("small ball", "small ball", (1e-15, 0.0, 0.0, 0.0, 1e-9, 0.0, 1.0)),
    "boxes": ("box", "box", (0.5, 0.25, 0.0, 0.0, 0.0, 0.0, 1.0)),
    "flat": ("flat soup", "flat soup", (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)),
    "slivers": ("slivers", "slivers", (1e-13, 0.0, 0.0, 0.0, 0.0, 0.3, 0.9)),
    "slivers in place": ("slivers", "slivers", STILL),
    "grid": ("grid", "lattice soup", STILL),
}


@pytest.mark.parametrize("case", CASES)
def test_ends_and_normals_equal_exact_clipping(device, case):
    """Both ends are corners of the exact intersection, and as far apart as its farthest corners."""
    *names, pose = CASES[case]
    models, pose = [model_of(name) for name in names], np.array(pose)
    pose[3:] /= np.linalg.norm(pose[3:])
    result = contacts_of(device, (models[0], STILL), (models[1], pose))
    rows = result.contacts
    assert len(rows) > 10
    check_fields(result)
    for row in rows[np.random.default_rng(0).permutation(len(rows))[:60]]:
        a = triangles(models[0], row["faces"][0])
        b = into_frame_of_a(triangles(models[1], row["faces"][1]), STILL, pose)
        polygon = shared_polygon(a, b)
        room = 4e-12 * max(np.ptp(a, axis=0).max(), np.ptp(b, axis=0).max()) + 1e-15 * np.abs([a, b]).max()
        for end in (row["p0"], row["p1"]):
            assert np.linalg.norm(polygon - end, axis=1).min() <= room
        widest = np.linalg.norm(polygon[:, None] - polygon, axis=2).max()
        assert abs(np.linalg.norm(row["p1"] - row["p0"]) - widest) <= 2 * room
        normals = exact_normal(a), exact_normal(b)
        np.testing.assert_allclose(row["normal_a"], unit(normals[0]), atol=1e-12)
        np.testing.assert_allclose(row["normal_b"], unit(normals[1]), atol=1e-12)
        in_plane = lies_in_plane(b, a)
        assert row["coplanar"] == (any(normals[0]) and any(normals[1]) and in_plane)
        along = unit(cross(*normals)) @ (row["p1"] - row["p0"])
        assert row["coplanar"] or along >= -room


def check_fields(result):
    """Every hit once and in order, no NaN, unit normals as defined, the sum over each pair as defined."""
    rows = result.contacts
    np.testing.assert_array_equal(np.column_stack([rows["pair"], rows["faces"]]), result.faces)
    assert rows.dtype.names == ("pair", "faces", *VECTORS, "coplanar") and rows["coplanar"].dtype == bool
    assert rows["pair"].dtype == np.int32 and not (rows.dtype.hasobject or result.pair_contacts.dtype.hasobject)
    for name in VECTORS:
        assert rows[name].shape == (len(rows), 3) and rows[name].dtype == np.float64 and np.isfinite(rows[name]).all()
    np.testing.assert_allclose(np.linalg.norm(rows["normal"], axis=1), 1.0, atol=1e-15)
    length = np.linalg.norm(rows["normal_a"], axis=1), np.linalg.norm(rows["normal_b"], axis=1)
    assert all(((np.abs(x - 1) < 1e-15) | (x == 0)).all() for x in length)
    difference = rows["normal_a"] - rows["normal_b"]
    size = np.linalg.norm(difference, axis=1)
    clear = size > 2.0**-20
    np.testing.assert_allclose(rows["normal"][clear], difference[clear] / size[clear, None], atol=1e-15)
    lower = np.where((result.pairs[rows["pair"], 0] < result.pairs[rows["pair"], 1])[:, None], 1, -1)
    alike = ~clear & (length[0] > 0)
    np.testing.assert_allclose(rows["normal"][alike], (lower * rows["normal_a"])[alike], atol=1e-6)
    check_summaries(result)


@pytest.mark.parametrize("names", [("lattice soup", "soup"), ("twins", "twins"), ("crumbs", "torus")])
def test_batches_in_the_world(device, names):
    rng = np.random.default_rng(3)
    models = [sample(name) for name in names]
    a, b = models
    poses = [pose for _ in range(6) for pose in contact_poses(rng, a, a.lod_max, b, b.lod_max)]
    placed = [*zip(models * 6, poses), (a, (50.0, 0, 0, 0, 0, 0, 1))]
    pairs = np.append(np.arange(12).reshape(-1, 2), [[0, 12]], 0)
    result = contacts_of(device, *placed, pairs=pairs)
    assert result.count[:-1].sum() > 20 and result.count[-1] == 0
    check_fields(result)
    for row in result.contacts[rng.permutation(len(result.contacts))[:60]]:
        for side in range(2):
            pose = poses[2 * row["pair"] + side]
            corners = triangles(models[side], row["faces"][side])
            corners = corners @ quaternion_matrix(pose[3:]).T + pose[:3]
            assert brute_distances(np.array([row["p0"], row["p1"]]), corners[None]).max() < 4e-12
            normal = row["normal_b" if side else "normal_a"]
            if normal.any():
                np.testing.assert_allclose(normal, unit(exact_normal(corners)), atol=1e-9)
    again = contacts_of(device, *placed, pairs=pairs)
    assert again.contacts.tobytes() == result.contacts.tobytes()
    assert again.pair_contacts.tobytes() == result.pair_contacts.tobytes()
    swapped = contacts_of(device, *placed, pairs=pairs[:, ::-1])
    check_fields(swapped)
    check_mirrored(result.contacts, swapped.contacts)
    some = result.count > 0
    for name, sign in (("point", 1), ("normal", -1)):
        before = result.pair_contacts[name][some]
        np.testing.assert_allclose(swapped.pair_contacts[name][some], sign * before, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("gap", [None, 0.1])
def test_powers_of_two_scale_every_bit(device, gap):
    plain, (soup_mesh, ball_mesh) = None, (SHAPES[name]() for name in ("soup", "ball"))
    turn = np.array([0.1, 0.2, 0.3, 0.9]) / np.linalg.norm([0.1, 0.2, 0.3, 0.9])
    for k in (0, -60, 60):
        a, b = (ab.Model.from_arrays(np.ldexp(vertices, k), faces) for vertices, faces in (soup_mesh, ball_mesh))
        options = {} if gap is None else {"gap": np.ldexp(gap, k)}
        result = contacts_of(device, (a, STILL), (b, [*np.ldexp([0.3, 0.2, 0.1], k), *turn]), **options)
        plain = result if plain is None else plain
        for rows, wanted in ((result.contacts, plain.contacts), (result.pair_contacts, plain.pair_contacts)):
            for name in rows.dtype.names:
                scaled = name in ("p0", "p1", "separation", "point")
                np.testing.assert_array_equal(rows[name], np.ldexp(wanted[name], k) if scaled else wanted[name])


FLOOR, ROD = [(0, 0, 0), (2, 0, 0), (0, 2, 0)], [(0, 0, 0), (1, 0, 0), (2, 0, 0)]
# Two faces, the ends of their contact, its normal, and whether they are coplanar.
KNOWN = {
    "across": (FLOOR, [(0.5, 0.5, -1), (0.5, 0.5, 1), (1.5, 0.5, 1)], [(0.5, 0.5, 0), (1, 0.5, 0)], (0, -1, 1), False),
    "a corner shared": (FLOOR, [(2, 0, 0), (4, 0, 1), (4, 0, -1)], [(2, 0, 0)] * 2, None, False),
    "opposite windings": (FLOOR, [(0, 0, 0), (0, 2, 0), (2, 0, 0)], [(2, 0, 0), (0, 2, 0)], (0, 0, 1), True),
    "a segment through": (FLOOR, [(0.5, 0.5, z) for z in (-1, 0, 1)], [(0.5, 0.5, 0)] * 2, (0, 0, 1), False),
    "segment in the plane": (FLOOR, [(x, 0.5, 0) for x in (-1, 1, 3)], [(0, 0.5, 0), (1.5, 0.5, 0)], (0, 0, 1), False),
    # Faces without area have no normals; the contact's points from one centre to the other.
    "segments across": (ROD, [(0.5, y, 0) for y in (-1, 1, 3)], [(0.5, 0, 0)] * 2, (-0.5, 1, 0), False),
    "segments along": (ROD, [(1.5, 0, 0), (2, 0, 0), (4, 0, 0)], [(1.5, 0, 0), (2, 0, 0)], (1, 0, 0), False),
}


@pytest.mark.parametrize("case", KNOWN)
def test_known_faces(device, case):
    one, other, ends, normal, coplanar = KNOWN[case]
    for a, b, sign in ((one, other, 1), (other, one, -1)):
        faces = [ab.Model.from_arrays(np.array(corners, float), [[0, 1, 2]]) for corners in (a, b)]
        result = contacts_of(device, (faces[0], STILL), (faces[1], STILL))
        check_fields(result)
        (contact,), (summed,) = result.contacts, result.pair_contacts
        got = sorted(map(tuple, (contact["p0"], contact["p1"])))
        np.testing.assert_allclose(got, sorted(ends), atol=1e-15)
        assert contact["coplanar"] == coplanar
        assert one is FLOOR or not (contact["normal_a"].any() or contact["normal_b"].any())
        np.testing.assert_allclose(summed["point"], np.mean(ends, 0), atol=1e-15)
        if normal is not None:
            # Faces that look the same way: the normal is the lower object's, whichever it is.
            same_way = contact["normal_a"].any() and np.allclose(contact["normal_a"], contact["normal_b"])
            wanted = (1 if same_way else sign) * np.array(normal) / np.linalg.norm(normal)
            np.testing.assert_allclose(contact["normal"], wanted, atol=1e-15 if one is FLOOR else 1e-6)


def test_rounded_signs_give_whole_contacts(device):
    """Of faces that do not meet too, as rounded signs may report: a point between them."""
    ball = sample("small ball")
    result = contacts_of(device, (ball, STILL), (ball, (1e-7, 0, 0, 0, 0, 0, 1)), precision="float32")
    check_fields(result)
    for row in result.contacts[:: len(result.contacts) // 100]:
        for k in range(2):
            corners = triangles(ball, row["faces"][k]) + [1e-7 * k, 0, 0]
            assert brute_distances(np.array([row["p0"], row["p1"]]), corners[None]).max() < 2e-7
