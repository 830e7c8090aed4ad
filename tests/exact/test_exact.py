"""What exact answers imply: they follow the geometry, and nothing else, under every change that keeps or maps it."""

from functools import cache

import numpy as np
import pytest
from helpers.questions import QUARTERS, ask, coarse, sort_rows, to_matrix
from helpers.samples import SHAPES, STILL, contact_poses, random_poses, sample, true_faces

import warp_abtree as ab

LATTICE_NAMES = ("torus", "crumbs", "lattice soup")


def ask_faces(device, model_a, pose_a, model_b, pose_b):
    return ask(device, [(model_a, None, pose_a, model_b, None, pose_b)]).faces[:, 1:]


@cache
def lattice_mesh(name):
    """Return a shape whose coordinates are even multiples of 2^-8, faces in order, and its model."""
    vertices, faces = SHAPES[name]()
    vertices = np.round(vertices * 64) / 64
    return vertices, np.asarray(faces), ab.Model.from_arrays(vertices, faces, base_faces=len(faces))


def lattice_cases(rng, count):
    """Pairs of lattice meshes at quarter turns and lattice positions: every x' is exact, and much touches."""
    for _ in range(count):
        a, b = rng.choice(LATTICE_NAMES, 2)
        shifts = rng.integers(-16, 17, (2, 3)) / 32
        turns = [QUARTERS[k] for k in rng.integers(0, len(QUARTERS), 2)]
        yield a, to_matrix(turns[0], shifts[0]), b, to_matrix(turns[1], shifts[1])


@pytest.fixture(scope="module")
def posed():
    """Lattice meshes at poses, the same for every test."""
    return list(lattice_cases(np.random.default_rng(1), 10))


@pytest.fixture
def plain(device, posed):
    """What meets in each of them."""
    faces = [ask_faces(device, lattice_mesh(a)[2], pa, lattice_mesh(b)[2], pb) for a, pa, b, pb in posed]
    assert sum(map(len, faces)) > 1000
    return faces


def test_lattice_meshes_equal_brute_force(posed, plain):
    for (a, pose_a, b, pose_b), faces in zip(posed, plain):
        (*_, model_a), (*_, model_b) = lattice_mesh(a), lattice_mesh(b)
        truth = true_faces(model_a, model_a.lod_max, pose_a, model_b, model_b.lod_max, pose_b)
        np.testing.assert_array_equal(faces, truth)


def test_swapped_objects_mirror_the_answer(device, posed, plain):
    """Where poses are exact, it is the same in either object's frame, hence in either order of the objects."""
    for (a, pose_a, b, pose_b), faces in zip(posed, plain):
        swapped = ask_faces(device, lattice_mesh(b)[2], pose_b, lattice_mesh(a)[2], pose_a)
        np.testing.assert_array_equal(swapped, sort_rows(faces[:, ::-1]))


def test_a_common_exact_motion_changes_nothing(device, posed, plain):
    rng = np.random.default_rng(2)
    for (a, pose_a, b, pose_b), faces in zip(posed, plain):
        for step in (2.0**-6, 2.0**24):
            motion = to_matrix(QUARTERS[rng.integers(len(QUARTERS))], step * rng.integers(-1000, 1000, 3))
            moved = ask_faces(device, lattice_mesh(a)[2], motion @ pose_a, lattice_mesh(b)[2], motion @ pose_b)
            np.testing.assert_array_equal(moved, faces)


def split_faces(vertices, faces):
    """Cut each face in four at the middles of its edges, which are exact; face f becomes 4 f .. 4 f + 3."""
    corners = vertices[faces]
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab_, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = np.stack([np.stack(t, 1) for t in ((a, ab_, ca), (ab_, b, bc), (ca, bc, c), (bc, ca, ab_))], 1)
    return parts.reshape(-1, 3), np.arange(12 * len(faces)).reshape(-1, 3)


def test_splitting_faces_changes_nothing(device, posed, plain):
    split = {}
    for name in LATTICE_NAMES:
        split[name] = ab.Model.from_arrays(*split_faces(*lattice_mesh(name)[:2]), base_faces=10**6)
    for (a, pose_a, b, pose_b), faces in zip(posed, plain):
        parts = ask_faces(device, split[a], pose_a, split[b], pose_b)
        np.testing.assert_array_equal(np.unique(parts // 4, axis=0), faces)


def test_the_order_of_faces_and_corners_changes_nothing(device, posed, plain):
    rng = np.random.default_rng(3)
    for (a, pose_a, b, pose_b), faces in zip(posed, plain):
        models, orders = [], []
        for name in (a, b):
            vertices, corners, _ = lattice_mesh(name)
            orders.append(rng.permutation(len(corners)))
            turned = rng.permuted(corners[orders[-1]], axis=1)
            place = rng.permutation(len(vertices))
            models.append(ab.Model.from_arrays(vertices[np.argsort(place)], place[turned], base_faces=10**6))
        found = ask_faces(device, models[0], pose_a, models[1], pose_b)
        found = np.stack([orders[0][found[:, 0]], orders[1][found[:, 1]]], 1)
        np.testing.assert_array_equal(sort_rows(found), faces)


# --- scale and distance ----------------------------------------------------------------------------------------------


def work_of(result):
    return np.stack(
        [result.count, result.node_tests, result.triangle_tests, result.float64_tests, result.exact_tests], 1
    )


def test_scaling_by_powers_of_two_changes_no_bit(device):
    """Every power from 2^-60 to 2^60, in one batch: the same faces after the same tests of each kind."""
    rng = np.random.default_rng(4)
    meshes = [SHAPES[name]() for name in ("crumbs", "small ball", "grid")]
    models = [ab.Model.from_arrays(*mesh, base_faces=10**6) for mesh in meshes]
    poses = contact_poses(rng, models[0], models[0].lod_max, models[1], models[1].lod_max, spread=5.0)
    twin = poses[0]
    beside = np.array(STILL) + (0.3, 0.1, 0, 0, 0, 0, 0)  # in the same plane, no corner in common
    cases = []
    for k in range(-60, 61):
        by = np.array([2.0**k] * 3 + [1.0] * 4)
        a, b, sheet = (ab.Model.from_arrays(np.ldexp(v, k), f, base_faces=10**6) for v, f in meshes)
        cases += [(a, None, poses[0] * by, b, None, poses[1] * by), (a, None, twin * by, a, None, twin * by)]
        cases.append((sheet, None, STILL, sheet, None, beside * by))
    result = ask(device, cases)
    # Faces that meet, and tests of boxes, faces, in float64 and by exact signs: so many at least.
    for first, least in enumerate([(20, 20, 20, 0, 0), (20, 20, 20, 1, 0), (20, 20, 20, 20, 20)]):
        work = work_of(result)[first::3]
        np.testing.assert_array_equal(work, np.broadcast_to(work[0], work.shape))
        assert (work[0] >= least).all()
        faces = [result.faces[result.faces[:, 0] == p][:, 1:] for p in range(first, len(cases), 3)]
        for other in faces:
            np.testing.assert_array_equal(other, faces[0])


PAIRS = [("warp:bunny", "warp:bear"), ("torus", "ball")]


def check_all(device, cases):
    """Compare cases, in one batch, with exact brute force; return how many faces meet."""
    result = ask(device, cases)
    for p, (model_a, _, pose_a, model_b, _, pose_b) in enumerate(cases):
        truth = true_faces(model_a, model_a.lod_max, pose_a, model_b, model_b.lod_max, pose_b)
        np.testing.assert_array_equal(result.faces[result.faces[:, 0] == p][:, 1:], truth)
    return result.count


def contact(rng, names):
    models = [ab.Model.from_arrays(*coarse(name), base_faces=10**6) for name in names]
    poses = contact_poses(rng, models[0], models[0].lod_max, models[1], models[1].lod_max)
    return models, poses


@pytest.mark.parametrize("names", PAIRS, ids="-".join)
@pytest.mark.slow
def test_every_scale_is_exact(device, names):
    """1e-6 to 1e6 by powers of ten; that scaling rounds, so each size is a case of its own."""
    _, poses = contact(np.random.default_rng(5), names)
    cases = []
    for power in range(-6, 7):
        scale = 10.0**power
        a, b = (ab.Model.from_arrays(coarse(n)[0] * scale, coarse(n)[1], base_faces=10**6) for n in names)
        by = np.array([scale] * 3 + [1.0] * 4)
        cases.append((a, None, poses[0] * by, b, None, poses[1] * by))
    assert (check_all(device, cases) > 0).all()


@pytest.mark.parametrize("names", PAIRS, ids="-".join)
def test_every_distance_from_the_origin_is_exact(device, names):
    """Up to 1e7 model sizes, of the poses and of the models' own coordinates."""
    models, poses = contact(np.random.default_rng(6), names)
    way = np.array([1.0, -0.7, 0.3])
    cases = []
    for power in (*range(8), 13):
        far = 10.0**power * way
        shift = np.concatenate([far, np.zeros(4)])
        cases.append((models[0], None, poses[0] + shift, models[1], None, poses[1] + shift))
        a, b = (ab.Model.from_arrays(coarse(n)[0] + far, coarse(n)[1], base_faces=10**6) for n in names)
        cases.append((a, None, STILL, b, None, STILL))
        turned = random_poses(np.random.default_rng(power), 1, 1.0)[0]
        cases.append((a, None, turned, a, None, turned))
    # Every face on its twin, or nearly so, still and turned.
    shifts = [np.array([shift, 0, 0, 0, 0, 0, 0]) for shift in (0.0, 2.0**-45, 2.0**-20)]
    for model in models:
        cases += [
            (model, None, pose, model, None, pose + shift) for pose in (np.array(STILL), turned) for shift in shifts
        ]
    counts = check_all(device, cases)
    assert (counts[2:27:3] > 0).all() and (counts[27:] > 0).all() and counts.sum() > 1000
    assert (counts[[27, 33]] >= [model.face_count for model in models]).all()


@pytest.mark.parametrize("size", [2.0**-90, 1.0, 2.0**90])
@pytest.mark.parametrize("far", [0.0, 1e3, 1e7, 1e15])
def test_boxes_that_just_touch_are_never_pruned(device, size, far):
    """Single faces that share one corner in A's frame, at any pose: margins decide whether they are found."""
    rng = np.random.default_rng(7)
    pose = random_poses(rng, 60, far * size)
    corners = rng.normal(size=(60, 3, 3)) * size
    cases = []
    for k in range(0, 60, 2):
        middle = rng.normal(size=3) * far * size
        a, b = (ab.Model.from_arrays(corners[k + i] + middle, [[0, 1, 2]]) for i in (0, 1))
        pose_b = to_matrix(np.eye(3), 0)
        pose_b[:3, 3] = (corners[k, 0] + middle) - (corners[k + 1, 0] + middle)
        cases.append((a, None, to_matrix(np.eye(3), 0), b, None, pose_b))
        pose[k + 1, 3:] = pose[k, 3:]
        pose[k + 1, :3] = pose[k, :3]
        cases.append((a, None, pose[k], a, None, pose[k + 1]))
    assert check_all(device, cases).sum() > 5


# --- order and buffers -----------------------------------------------------------------------------------------------


def test_batches_buffers_and_precisions_do_not_matter(device):
    rng = np.random.default_rng(8)
    scene = ab.Scene(device)
    for name in ("torus", "crumbs", "soup", "torus", "twins", "twins"):
        scene.add(sample(name), random_poses(rng, 1, 0.5)[0])
    scene.add(sample("twins"), STILL)
    scene.add(sample("twins"), STILL)
    scene.add(sample("grid"), STILL)
    scene.add(sample("grid"), np.array(STILL) + (0.3, 0.1, 0, 0, 0, 0, 0))  # in one plane
    pairs = np.array([(i, j) for i in range(10) for j in range(10) if i != j])
    whole = scene.intersect(pairs, output="faces")
    assert whole.float64_tests.sum() > whole.exact_tests.sum() > 100
    for trial in range(6):
        order = rng.permutation(len(pairs))
        capacities = rng.integers(1, 2 * whole.float64_tests.sum(), 2)
        scene.intersect(pairs[order], output="faces", precision="float32")
        query = ab.Query(scene, pairs=pairs[order], capacity=ab.Buffers(capacities[0], uncertain=capacities[1]))
        if trial % 2:
            query.run()
        result = query.run()
        np.testing.assert_array_equal(work_of(result), work_of(whole)[order])
        faces = result.faces.copy()
        faces[:, 0] = order[faces[:, 0]]
        np.testing.assert_array_equal(sort_rows(faces), whole.faces)
