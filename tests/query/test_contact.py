"""Contacts: ends against exact clipping, definitions, symmetries, and sums over object pairs."""

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers.contacts import check_summaries, distance, exact_normal, lies_in_plane, shared_polygon, unit
from helpers.samples import STILL, contact_poses, sample, soup
from oracles.triangle import _cross, into_frame_of_a, quaternion_matrix

import warp_abtree as ab
from warp_abtree.kernels.triangle.segment import intersect_faces

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

VECTORS = ("p0", "p1", "normal_a", "normal_b", "normal")
QUARTER = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0)


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


def two(device, name_a, name_b, pose_a=STILL, pose_b=STILL):
    scene = ab.Scene(device)
    models = [model_of(name_a), model_of(name_b)]
    for model, pose in zip(models, (pose_a, pose_b), strict=True):
        scene.add(model, pose)
    return scene, models


def contacts_of(scene, pairs=((0, 1),), **options):
    result = scene.intersect(np.array(pairs), output="contacts", **options)
    result.check()
    return result


def triangles(model, faces):
    vertices, corners, ids = model.mesh_at(model.lod_max)
    return vertices[corners[np.searchsorted(ids, faces)]]


CASES = {
    "balls": ("ball", "torus", (0.4, 0.7, 0.1, 0.1, 0.7, 0.1, 0.7)),
    "soups": ("soup", "ball", (0.1, 0.2, -0.1, 0.5, 0.5, 0.5, 0.5)),
    "lattice soups": ("lattice soup", "lattice soup", (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)),
    "turned lattice soups": ("lattice soup", "lattice soup", (0.0, 1.0, 1.0, 0.5, 0.5, 0.5, 0.5)),
    "twins": ("twins", "twins", STILL),
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
    name_a, name_b, pose = CASES[case]
    pose = np.asarray(pose) / np.append(np.ones(3), np.full(4, np.linalg.norm(pose[3:])))
    scene, models = two(device, name_a, name_b, pose_b=pose)
    result = contacts_of(scene)
    rows = result.contacts
    assert len(rows) > 10
    check_fields(result)
    for row in rows[np.random.default_rng(0).permutation(len(rows))[:120]]:
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
        along = unit(_cross(*normals)) @ (row["p1"] - row["p0"])
        assert row["coplanar"] or along >= -room


def check_fields(result):
    """Every hit once and in order, no NaN, unit normals as defined, the sum over each pair as defined."""
    rows = result.contacts
    np.testing.assert_array_equal(np.column_stack([rows["pair"], rows["faces"]]), result.faces)
    assert rows["pair"].dtype == np.int32 and rows["coplanar"].dtype == bool
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


def mirror(contacts):
    """Contacts as of the pairs named the other way."""
    turned = contacts.copy()
    for x, y in (("p0", "p1"), ("normal_a", "normal_b")):
        turned[x], turned[y] = contacts[y], contacts[x]
    turned["faces"] = contacts["faces"][:, ::-1]
    turned["normal"] = -contacts["normal"]
    return turned[np.lexsort((*turned["faces"].T[::-1], turned["pair"]))]


@pytest.mark.parametrize(
    "names", [("ball", "torus"), ("lattice soup", "soup"), ("twins", "twins"), ("crumbs", "crumbs")]
)
def test_batches_in_the_world(device, names):
    """Random poses: fields, mirrored pairs, repeated runs, and contacts that move along with a common motion."""
    rng = np.random.default_rng(3)
    models = [sample(name) for name in names]
    lods = [model.lod_max for model in models]
    scene, poses = ab.Scene(device), []
    for _ in range(6):
        pair = contact_poses(rng, models[0], lods[0], models[1], lods[1])
        for model, pose in zip(models, pair, strict=True):
            scene.add(model, pose)
            poses.append(pose)
    poses.append(np.array([50.0, 0, 0, 0, 0, 0, 1]))
    scene.add(models[0], poses[-1])
    pairs = np.append(np.arange(12).reshape(-1, 2), [[0, 12]], 0)
    result = contacts_of(scene, pairs)
    assert result.count[:-1].sum() > 20 and result.count[-1] == 0
    check_fields(result)
    for row in result.contacts[rng.permutation(len(result.contacts))[:60]]:
        for side in range(2):
            pose = poses[2 * row["pair"] + side]
            corners = triangles(models[side], row["faces"][side])
            corners = corners @ quaternion_matrix(pose[3:]).T + pose[:3]
            for end in (row["p0"], row["p1"]):
                assert distance(corners, end) < 4e-12
    again = contacts_of(scene, pairs)
    assert again.contacts.tobytes() == result.contacts.tobytes()
    assert again.pair_contacts.tobytes() == result.pair_contacts.tobytes()
    swapped = contacts_of(scene, pairs[:, ::-1])
    check_fields(swapped)
    np.testing.assert_array_equal(swapped.contacts, mirror(result.contacts))
    some = result.count > 0
    for name, sign in (("point", 1), ("normal", -1), ("depth", 1)):
        before = result.pair_contacts[name][some]
        np.testing.assert_allclose(swapped.pair_contacts[name][some], sign * before, rtol=1e-6, atol=1e-9)


def test_contacts_name_their_faces_and_need_no_pickle(device, tmp_path):
    """DESIGN: structured, `pair, faces, p0, p1, ...`; what is kept on disk comes back to the bit."""
    scene, _ = two(device, "ball", "torus", pose_b=CASES["flat"][2])
    result = contacts_of(scene, [(1, 0)])
    assert len(result.contacts) > 10
    assert result.contacts.dtype.names == ("pair", "faces", *VECTORS, "coplanar")
    assert result.contacts.dtype["faces"] == np.dtype((np.int32, (2,)))
    np.testing.assert_array_equal(result.contacts["faces"], result.faces[:, 1:])
    np.save(tmp_path / "one.npy", result.contacts, allow_pickle=False)
    np.savez(tmp_path / "some.npz", contacts=result.contacts, pair_contacts=result.pair_contacts)
    read = np.load(tmp_path / "one.npy", allow_pickle=False)
    with np.load(tmp_path / "some.npz", allow_pickle=False) as file:
        for back in (read, file["contacts"]):
            assert back.dtype == result.contacts.dtype and back.tobytes() == result.contacts.tobytes()
        assert file["pair_contacts"].tobytes() == result.pair_contacts.tobytes()


def test_common_motion(device):
    """A quarter turn and a shift by whole numbers are exact on a lattice, and so are the contacts."""
    scene, _ = two(device, "lattice soup", "lattice soup", pose_b=(1.0, 0, 0, 0, 0, 0, 1))
    still = contacts_of(scene)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = np.tile(np.eye(4), (2, 1, 1))
    moved[:, :3, :3] = turn
    moved[0, :3, 3] = 4.0, -8.0, 16.0
    moved[1, :3, 3] = turn @ [1.0, 0, 0] + [4.0, -8.0, 16.0]
    scene.set_poses(moved)
    result = contacts_of(scene)
    np.testing.assert_array_equal(result.faces, still.faces)
    for name in VECTORS[2:]:
        np.testing.assert_array_equal(result.contacts[name], still.contacts[name] @ turn.T)
    for name in VECTORS[:2]:
        np.testing.assert_allclose(result.contacts[name], still.contacts[name] @ turn.T + [4, -8, 16], atol=1e-14)


@pytest.mark.parametrize("names", [("soup", "ball"), ("lattice soup", "lattice soup")])
def test_powers_of_two_scale_every_bit(device, names):
    pose = np.array([0.3, 0.2, 0.1, 0.1, 0.2, 0.3, 0.9])
    pose[3:] /= np.linalg.norm(pose[3:])
    if names[0] == names[1]:
        pose = np.array([1.0, 0, 0, 0, 0, 0, 1])
    plain = None
    for k in (0, -60, -7, 60):
        scene = ab.Scene(device)
        for i, name in enumerate(names):
            mesh = sample(name).mesh_at(sample(name).lod_max)
            model = ab.Model.from_arrays(np.ldexp(mesh[0], k), mesh[1])
            scene.add(model, np.append(np.ldexp(pose[:3], k), pose[3:]) if i else STILL)
        result = contacts_of(scene)
        plain = plain or result
        for name in result.contacts.dtype.names:
            shift = k if name in ("p0", "p1") else 0
            wanted = np.ldexp(plain.contacts[name], shift) if shift else plain.contacts[name]
            np.testing.assert_array_equal(result.contacts[name], wanted)
        for name in result.pair_contacts.dtype.names:
            shift = k if name in ("point", "depth") else 0
            wanted = np.ldexp(plain.pair_contacts[name], shift) if shift else plain.pair_contacts[name]
            np.testing.assert_array_equal(result.pair_contacts[name], wanted)


# Known cases.


def one_pair(device, a, b):
    """The only contact of one triangle with another; each model has one face."""
    scene = ab.Scene(device)
    for corners in (a, b):
        scene.add(ab.Model.from_arrays(np.array(corners, float), [[0, 1, 2]]))
    result = contacts_of(scene)
    check_fields(result)
    assert len(result.contacts) == 1
    return result.contacts[0], result.pair_contacts[0]


FLOOR = [(0, 0, 0), (2, 0, 0), (0, 2, 0)]


@pytest.mark.parametrize(
    "other, ends, normal, coplanar",
    [
        ([(0.5, 0.5, -1), (0.5, 0.5, 1), (1.5, 0.5, 1)], [(0.5, 0.5, 0), (1, 0.5, 0)], (0, -1, 1), False),
        ([(0.5, 0.5, 0), (0, 1, 1), (1, 1, 1)], [(0.5, 0.5, 0)] * 2, None, False),  # a corner on the face
        ([(2, 0, 0), (4, 0, 1), (4, 0, -1)], [(2, 0, 0)] * 2, None, False),  # a corner shared
        ([(1, -1, -1), (1, 1, 1), (1, -3, -1)], [(1, 0, 0)] * 2, None, False),  # edge across edge
        ([(0, 0, 0), (2, 0, 0), (0, 0, 2)], [(0, 0, 0), (2, 0, 0)], None, False),  # an edge shared
        ([(0, 0, 0), (0, 2, 0), (2, 0, 0)], [(2, 0, 0), (0, 2, 0)], (0, 0, 1), True),  # opposite windings
        (FLOOR, [(2, 0, 0), (0, 2, 0)], (0, 0, 1), True),  # itself
        ([(1, 1, 0), (3, 1, 0), (1, 3, 0)], [(1, 1, 0)] * 2, (0, 0, 1), True),  # coplanar, touching in a point
        ([(0.5, 0.5, -1), (0.5, 0.5, 0), (0.5, 0.5, 1)], [(0.5, 0.5, 0)] * 2, (0, 0, 1), False),  # a segment through
        ([(-1, 0.5, 0), (1, 0.5, 0), (3, 0.5, 0)], [(0, 0.5, 0), (1.5, 0.5, 0)], (0, 0, 1), False),  # one in the plane
    ],
)
def test_two_faces(device, other, ends, normal, coplanar):
    for a, b, sign in ((FLOOR, other, 1), (other, FLOOR, -1)):
        contact, summed = one_pair(device, a, b)
        got = sorted(map(tuple, (contact["p0"], contact["p1"])))
        np.testing.assert_allclose(got, sorted(ends), atol=1e-15)
        assert contact["coplanar"] == coplanar
        np.testing.assert_allclose(summed["point"], np.mean(ends, 0), atol=1e-15)
        if normal is not None:
            # Faces that look the same way: the normal is the lower object's, whichever it is.
            turn = 1 if np.allclose(contact["normal_a"], contact["normal_b"]) else sign
            np.testing.assert_allclose(contact["normal"], turn * np.array(normal) / np.linalg.norm(normal), atol=1e-15)


@pytest.mark.parametrize(
    "other, ends",
    [
        ([(0.5, -1, 0), (0.5, 1, 0), (0.5, 3, 0)], [(0.5, 0, 0)] * 2),
        ([(1.5, 0, 0), (2, 0, 0), (4, 0, 0)], [(1.5, 0, 0), (2, 0, 0)]),
        ([(2, 0, 0), (2, 0, 1), (2, 0, 2)], [(2, 0, 0)] * 2),
    ],
    ids=["across", "along", "touching"],
)
def test_two_segments(device, other, ends):
    """Faces without area have no normals; the contact's points from one centre to the other."""
    contact, _ = one_pair(device, [(0, 0, 0), (1, 0, 0), (2, 0, 0)], other)
    np.testing.assert_array_equal(sorted(map(tuple, (contact["p0"], contact["p1"]))), ends)
    assert not contact["normal_a"].any() and not contact["normal_b"].any() and not contact["coplanar"]
    direction = (np.min(other, 0) + np.max(other, 0)) / 2 - [1, 0, 0]
    np.testing.assert_allclose(contact["normal"], direction / np.linalg.norm(direction), atol=1e-6)


def test_boxes(device):
    """A unit box pressed 0.1 deep into the top of a wide one."""
    wide, cube = trimesh.creation.box((4, 4, 1)), trimesh.creation.box()
    scene = ab.Scene(device)
    scene.add(ab.Model.from_arrays(wide.vertices, wide.faces))
    scene.add(ab.Model.from_arrays(cube.vertices, cube.faces), (0.25, 0.5, 0.9, 0, 0, 0, 1))
    result = contacts_of(scene, [(0, 1), (1, 0)])
    for p, sign in ((0, 1), (1, -1)):
        rows, summed = result.contacts[result.contacts["pair"] == p], result.pair_contacts[p]
        assert np.isclose(np.linalg.norm(rows["p1"] - rows["p0"], axis=1).sum(), 4.0)
        np.testing.assert_allclose(summed["point"], (0.25, 0.5, 0.5), atol=1e-15)
        np.testing.assert_allclose(summed["normal"], (0, 0, sign), atol=1e-15)
        assert abs(summed["depth"] - 0.1) < 1e-6


def test_depth_without_an_area(device):
    """A tip that touches: the overlap along the normal of the faces that touch, or of the boxes if that is less."""
    wide, tip = trimesh.creation.box((4, 4, 1)), np.array([[0.25, 0.5, 0.5], [1, 0, 2], [1, 2, 1], [-2, 0, 2]])
    tetrahedron = trimesh.Trimesh(tip, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], process=False)
    models = [ab.Model.from_arrays(mesh.vertices, mesh.faces) for mesh in (wide, tetrahedron)]
    scene = ab.Scene(device)
    for model in models:
        scene.add(model)
    result = contacts_of(scene, [(0, 1), (1, 0)])
    rows = result.contacts[result.contacts["pair"] == 0]
    normal = result.pair_contacts["normal"][0]
    assert len(rows) > 2 and (rows["p0"] == tip[0]).all() and (rows["p1"] == tip[0]).all()
    faces = (triangles(models[0], rows["faces"][:, 0]) @ normal).max() - (
        triangles(models[1], rows["faces"][:, 1]) @ normal
    ).min()
    boxes = [np.array(np.meshgrid(*mesh.bounds.T)).reshape(3, -1).T @ normal for mesh in (wide, tetrahedron)]
    wanted = min(faces, boxes[0].max() - boxes[1].min())
    assert wanted > 0
    np.testing.assert_allclose(result.pair_contacts["depth"], [wanted] * 2, rtol=1e-6)


@pytest.mark.parametrize("overlap", [0.05, 0.2, 0.5, 1.0])
def test_balls(device, overlap):
    """Two unit balls: a circle, the normal from one to the other, and a depth as far off as is said."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    model = ab.Model.from_arrays(ball.vertices, ball.faces)
    scene, d = ab.Scene(device), 2 - overlap
    axis = np.array([0.48, 0.6, 0.64])
    scene.add(model, (1, 2, 3, 0, 0, 0, 1))
    scene.add(model, (*((1, 2, 3) + d * axis), 0.3, 0, 0, np.sqrt(0.91)))
    result = contacts_of(scene)
    radius = np.linalg.norm(np.cross(result.contacts["p0"] - [1, 2, 3], axis), axis=1)
    np.testing.assert_allclose(radius, np.sqrt(1 - d * d / 4), rtol=0.04)
    summed = result.pair_contacts[0]
    np.testing.assert_allclose(summed["point"], (1, 2, 3) + d / 2 * axis, atol=0.01)
    assert summed["normal"] @ axis > 0.9999
    assert 0.9 < summed["depth"] / (overlap * (2 + d) / (2 * d)) < 1.1


def test_tori(device):
    """Two tori through each other: every end lies near both smooth surfaces."""
    torus = trimesh.creation.torus(1.0, 0.35, 64, 32)
    model = ab.Model.from_arrays(torus.vertices, torus.faces)
    scene = ab.Scene(device)
    scene.add(model)
    scene.add(model, (0.9, 0, 0.1, 1, 0, 0, 0))
    rows = contacts_of(scene).contacts
    assert len(rows) > 50
    for end in ("p0", "p1"):
        for x in (rows[end], (rows[end] - [0.9, 0, 0.1]) * [1, -1, -1]):
            tube = np.hypot(np.hypot(x[:, 0], x[:, 1]) - 1, x[:, 2])
            np.testing.assert_allclose(tube, 0.35, atol=0.005)


@wp.kernel
def join_faces_kernel(corners: wp.array2d(dtype=wp.vec3d), ends_out: wp.array2d(dtype=wp.vec3d)):
    i = wp.tid()
    corner = wp.zeros(shape=(6,), dtype=wp.vec3d)
    for k in range(6):
        corner[k] = corners[i, k]
    p0, p1, coplanar = intersect_faces(wp.float64(1.0), corner)
    ends_out[i, 0] = p0
    ends_out[i, 1] = p1
    ends_out[i, 2] = wp.vec3d(wp.float64(coplanar))


def test_faces_that_do_not_meet_get_a_point_between(device):
    """As rounded signs may report: random triangles, segments and points, a hair apart."""
    rng = np.random.default_rng(5)
    corners = rng.normal(size=(300, 6, 3))
    corners[100:150, 2] = corners[100:150, 1]
    corners[150:200, 1:3] = corners[150:200, :1]
    corners[:200, 3:] += [6.0, 0, 0]
    gap = 1e-9
    corners[200:, :3, 2], corners[200:, 3:, 2] = 0.0, gap
    corners[200:, 3:, :2] = 0.9 * corners[200:, :3, :2].mean(1, keepdims=True) + 0.1 * corners[200:, :3, :2]
    ends = wp.zeros((300, 3), dtype=wp.vec3d, device=device)
    wp.launch(
        join_faces_kernel, dim=300, inputs=[wp.array(corners, dtype=wp.vec3d, device=device), ends], device=device
    )
    p = ends.numpy()[:, 0]
    assert np.isfinite(p).all() and (p == ends.numpy()[:, 1]).all()
    away = np.array([[distance(c[:3], x), distance(c[3:], x)] for c, x in zip(corners, p, strict=True)])
    assert away[200:].max() < gap
    assert np.abs(away[:, 0] - away[:, 1]).max() < 1e-9
    assert (away.sum(1)[:200] < [np.linalg.norm(c[:3, None] - c[3:], axis=2).min() + 1e-9 for c in corners[:200]]).all()


@pytest.mark.slow
def test_rounded_signs_give_whole_contacts(device):
    scene, _ = two(device, "small ball", "small ball", pose_b=(1e-7, 0, 0, 0, 0, 0, 1))
    check_fields(contacts_of(scene, precision="float32"))
