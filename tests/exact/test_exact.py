"""Exact answers: they follow the geometry alone, under all that keeps or maps it; random and hostile input."""

from functools import cache

import numpy as np
import pytest
import trimesh
from helpers import refused
from helpers.questions import QUARTERS, ask, coarse, sort_rows, to_matrix
from helpers.samples import SHAPES, STILL, contact_poses, model_of_faces, random_poses, sample, true_faces
from helpers.viewer import SCENE
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.app import SceneError, load_scene

LATTICE_NAMES = ("torus", "crumbs", "lattice soup")


def ask_faces(device, model_a, pose_a, model_b, pose_b):
    return ask(device, [(model_a, None, pose_a, model_b, None, pose_b)]).faces[:, 1:]


@cache
def lattice_mesh(name):
    """Return a shape whose coordinates are even multiples of 2^-8, faces in order, and its model."""
    vertices, faces = SHAPES[name]()
    vertices = np.round(vertices * 64) / 64
    return vertices, np.asarray(faces), ab.Model.from_arrays(vertices, faces, base_faces=len(faces))


@pytest.fixture(scope="module")
def posed():
    """Pairs of lattice meshes at quarter turns and lattice positions, and which faces meet: every x' is exact."""
    rng, found = np.random.default_rng(1), []
    for _ in range(10):
        names = rng.choice(LATTICE_NAMES, 2)
        shifts = rng.integers(-16, 17, (2, 3)) / 32
        poses = [to_matrix(QUARTERS[k], x) for k, x in zip(rng.integers(0, len(QUARTERS), 2), shifts)]
        a, b = (lattice_mesh(name)[2] for name in names)
        found.append((names, poses, true_faces(a, a.lod_max, poses[0], b, b.lod_max, poses[1])))
    assert sum(len(faces) for *_, faces in found) > 1000
    return found


@cache
def split(name):
    """Return a lattice mesh with each face cut in four at the middles of its edges; face f becomes 4 f .. 4 f + 3."""
    vertices, faces, _ = lattice_mesh(name)
    return ab.Model.from_arrays(*trimesh.remesh.subdivide(vertices, faces), base_faces=10**6)


def shuffle(rng, name):
    """Return a lattice mesh with its vertices, faces and their corners in another order, and that of the faces."""
    vertices, corners, _ = lattice_mesh(name)
    order, place = rng.permutation(len(corners)), rng.permutation(len(vertices))
    turned = place[rng.permuted(corners[order], axis=1)]
    return ab.Model.from_arrays(vertices[np.argsort(place)], turned, base_faces=10**6), order


CHANGES = ("none", "swapped objects", "a common motion", "a common motion, far", "split faces", "another order")


@pytest.mark.parametrize("change", CHANGES)
def test_answers_follow_the_geometry(device, posed, change):
    """Where poses are exact, in either object's frame, after a common exact motion, and for any mesh of the surface."""
    rng = np.random.default_rng(2)
    for names, (pose_a, pose_b), expected in posed:
        a, b = (lattice_mesh(name)[2] for name in names)
        if change == "swapped objects":
            found = sort_rows(ask_faces(device, b, pose_b, a, pose_a)[:, ::-1])
        elif change == "split faces":
            found = np.unique(ask_faces(device, split(names[0]), pose_a, split(names[1]), pose_b) // 4, axis=0)
        elif change == "another order":
            (a, order_a), (b, order_b) = (shuffle(rng, name) for name in names)
            found = ask_faces(device, a, pose_a, b, pose_b)
            found = sort_rows(np.stack([order_a[found[:, 0]], order_b[found[:, 1]]], 1))
        else:
            step = {"none": 0.0, "a common motion": 2.0**-6, "a common motion, far": 2.0**24}[change]
            motion = to_matrix(QUARTERS[rng.integers(len(QUARTERS))], step * rng.integers(-1000, 1000, 3))
            motion = motion if step else np.eye(4)
            found = ask_faces(device, a, motion @ pose_a, b, motion @ pose_b)
        np.testing.assert_array_equal(found, expected)


def work_of(result):
    names = ("count", "node_tests", "triangle_tests", "float64_tests", "exact_tests")
    return np.stack([getattr(result, name) for name in names], 1)


def test_scaling_by_powers_of_two_changes_no_bit(device):
    """Every power from 2^-60 to 2^60, in one batch: the same faces after the same tests of each kind."""
    rng = np.random.default_rng(4)
    meshes = [SHAPES[name]() for name in ("crumbs", "small ball", "grid")]
    models = [ab.Model.from_arrays(*mesh, base_faces=10**6) for mesh in meshes]
    poses = contact_poses(rng, models[0], models[0].lod_max, models[1], models[1].lod_max, spread=5.0)
    beside = np.array(STILL) + (0.3, 0.1, 0, 0, 0, 0, 0)  # in the same plane, no corner in common
    cases = []
    for k in range(-60, 61):
        by = np.array([2.0**k] * 3 + [1.0] * 4)
        a, b, sheet = (ab.Model.from_arrays(np.ldexp(v, k), f, base_faces=10**6) for v, f in meshes)
        cases += [(a, None, poses[0] * by, b, None, poses[1] * by), (a, None, poses[0] * by, a, None, poses[0] * by)]
        cases.append((sheet, None, STILL, sheet, None, beside * by))
    result = ask(device, cases)
    # Faces that meet, and tests of boxes, faces, in float64 and by exact signs: so many at least.
    for first, least in enumerate([(20, 20, 20, 0, 0), (20, 20, 20, 1, 0), (20, 20, 20, 20, 20)]):
        work = work_of(result)[first::3]
        np.testing.assert_array_equal(work, np.broadcast_to(work[0], work.shape))
        assert (work[0] >= least).all()
        faces = [result.faces[result.faces[:, 0] == p][:, 1:].tolist() for p in range(first, len(cases), 3)]
        assert all(other == faces[0] for other in faces)


def check_all(device, cases):
    """Compare cases, in one batch, with exact brute force; return how many faces meet."""
    result = ask(device, cases)
    for p, (model_a, _, pose_a, model_b, _, pose_b) in enumerate(cases):
        truth = true_faces(model_a, model_a.lod_max, pose_a, model_b, model_b.lod_max, pose_b)
        np.testing.assert_array_equal(result.faces[result.faces[:, 0] == p][:, 1:], truth)
    return result.count


@pytest.mark.parametrize("names", [("warp:bunny", "warp:bear"), ("torus", "ball")], ids="-".join)
def test_every_distance_from_the_origin_is_exact(device, names):
    """Up to 1e7 model sizes, of the poses and of the models' own coordinates."""
    meshes = [coarse(name, 250) for name in names]
    models = [ab.Model.from_arrays(*mesh, base_faces=10**6) for mesh in meshes]
    poses = contact_poses(np.random.default_rng(6), models[0], models[0].lod_max, models[1], models[1].lod_max)
    way = np.array([1.0, -0.7, 0.3])
    cases = []
    for power in (*range(8), 13):
        far = 10.0**power * way
        shift = np.concatenate([far, np.zeros(4)])
        cases.append((models[0], None, poses[0] + shift, models[1], None, poses[1] + shift))
        a, b = (ab.Model.from_arrays(vertices + far, faces, base_faces=10**6) for vertices, faces in meshes)
        cases.append((a, None, STILL, b, None, STILL))
        turned = random_poses(np.random.default_rng(power), 1, 1.0)[0]
        cases.append((a, None, turned, a, None, turned))
    # Every face on its twin, or nearly so, still and turned.
    shifts = [np.array([shift, 0, 0, 0, 0, 0, 0]) for shift in (0.0, 2.0**-45, 2.0**-20)]
    for model in models:
        for pose in (np.array(STILL), turned):
            cases += [(model, None, pose, model, None, pose + shift) for shift in shifts]
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
        a, b = (model_of_faces(corners[k + i] + middle) for i in (0, 1))
        pose_b = to_matrix(np.eye(3), (corners[k, 0] + middle) - (corners[k + 1, 0] + middle))
        cases += [(a, None, np.eye(4), b, None, pose_b), (a, None, pose[k], a, None, pose[k])]
    assert check_all(device, cases).sum() > 5


def test_batches_buffers_and_precisions_do_not_matter(device):
    rng = np.random.default_rng(8)
    scene = ab.Scene(device)
    for name in ("torus", "crumbs", "soup", "torus", "twins", "twins"):
        scene.add(sample(name), random_poses(rng, 1, 0.5)[0])
    for name in ("twins", "twins", "grid"):
        scene.add(sample(name))
    scene.add(sample("grid"), (0.3, 0.1, 0, 0, 0, 0, 1))  # in one plane with the other
    pairs = np.array([(i, j) for i in range(10) for j in range(10) if i != j])
    # Slabs of an object serve several pairs in a row, so that tests depend on these; boxes alone do not.
    with testing.regime(plain_tests=10**9):
        whole = ab.Query(scene, pairs=pairs).run()
    assert whole.float64_tests.sum() > whole.exact_tests.sum() > 100
    for trial in range(6):
        order = rng.permutation(len(pairs))
        capacities = rng.integers(1, 2 * whole.float64_tests.sum(), 2)
        scene.intersect(pairs[order], output="faces", precision="float32")
        by_boxes = trial < 4
        with testing.regime(plain_tests=10**9 if by_boxes else 3):
            query = ab.Query(scene, pairs=pairs[order], capacity=ab.Buffers(capacities[0], uncertain=capacities[1]))
        if trial % 2:
            query.run()
        result = query.run()
        np.testing.assert_array_equal(result.count, whole.count[order])
        if by_boxes or query.uses_warps():
            np.testing.assert_array_equal(work_of(result), work_of(whole)[order])
        faces = result.faces.copy()
        faces[:, 0] = order[faces[:, 0]]
        np.testing.assert_array_equal(sort_rows(faces), whole.faces)


relaxed = settings(deadline=None, max_examples=250, suppress_health_check=[HealthCheck.function_scoped_fixture])

hostile = st.sampled_from([float("nan"), float("inf"), -float("inf"), 1.7e308, -1e200])
tiny = st.sampled_from([-0.0, 5e-324, -1e-300, 2.0**-290, 1e-60, -1e-17])


@st.composite
def soups(draw):
    """Few corners on a small lattice, so that they often coincide and align, of any size; some tiny, a few hostile."""
    corner = st.integers(-3, 3).map(float) | st.sampled_from([0.1, 1 / 3, -2.7])
    if draw(st.booleans()):
        corner = corner | tiny
    if draw(st.integers(0, 7)) == 7:
        corner = corner | hostile
    vertices = draw(st.lists(st.tuples(corner, corner, corner), min_size=3, max_size=9))
    last = len(vertices) - 1 + (draw(st.integers(0, 15)) == 15)
    index = st.integers(-(draw(st.integers(0, 15)) == 15), last)
    faces = draw(st.lists(st.tuples(index, index, index), min_size=1, max_size=12))
    scale = 2.0 ** draw(st.sampled_from([0, 0, 0, 0, 30, -30, 95, -95, 120, -120]))
    with np.errstate(over="ignore", invalid="ignore"):
        return np.array(vertices) * scale, np.array(faces)


position = st.floats(-2.0, 2.0) | st.sampled_from([0.0, 0.0, 1.0, 1e300, -1e300, 1e-300])
turn = st.sampled_from(
    [(0, 0, 0, 1), (0, 0, 0, -1), (1, 0, 0, 0), (0.5, 0.5, 0.5, 0.5), (0, 0, 0.6, 0.8), (0.1, 0.7, 0.1, 0.7)]
    + [(0, 0, 0, 1.0005), (0, 0, 0, 1.1), (0, 0, 0, 0), (float("nan"), 0, 0, 1)]
)


@relaxed
@given(soups(), soups(), st.tuples(position, position, position), turn, st.data())
@pytest.mark.slow
def test_meshes_and_poses(device, soup_a, soup_b, place, turned, data):
    try:
        a, b = (ab.Model.from_arrays(*soup) for soup in (soup_a, soup_b))
    except ab.MeshError as error:
        assert "\n" not in str(error)
        return
    size = np.abs(a.progressive.vertex_pos).max() if data.draw(st.booleans()) else 1.0
    pose = (*(float(x if abs(x) > 2 else x * size) for x in place), *turned)
    scene = ab.Scene(device)
    lods = [data.draw(st.integers(0, model.lod_max)) for model in (a, b)]
    scene.add(a, lod=lods[0])
    try:
        scene.add(b, pose, lod=lods[1])
    except ValueError as error:
        assert "pose" in str(error) and "\n" not in str(error)
        assert scene.object_count == 1
        return
    result = scene.intersect([(0, 1)], output="faces")
    result.check()
    if np.abs(np.asarray(pose[:3])).max() < 1e200:  # beyond, the oracle's own arithmetic overflows
        truth = true_faces(a, lods[0], STILL, b, lods[1], pose)
        np.testing.assert_array_equal(result.faces[:, 1:], truth)
    assert result.any[0] == (len(result.faces) > 0)


@relaxed
@given(st.data())
@pytest.mark.slow
def test_scene_files(tmp_path, data):
    """Damage a scene file by lines and characters: it loads, or one SceneError names the file."""
    text = list(SCENE)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(text) - 1))
        kind = data.draw(st.sampled_from(["drop", "put", "cut", "twice"]))
        if kind == "put":
            text.insert(at, data.draw(st.sampled_from(list('[]{}="-.0179aen,\n#\x00\\é'))))
        elif kind == "twice":
            text[at:at] = text[at : at + data.draw(st.integers(1, 40))]
        else:
            del text[at : at + (1 if kind == "drop" else data.draw(st.integers(1, 40)))]
    path = tmp_path / "scene.toml"
    path.write_text("".join(text), encoding="utf-8")
    try:
        load_scene(path, device="cpu")
    except SceneError as error:
        assert "scene.toml" in str(error) and "\n" not in str(error)


@pytest.mark.parametrize("junk", [b"", b"\xff\xfe", b"PK\x03\x04", b"\x93NUMPY", b"[scene", b"v 0 0 0\nf 1 2 3\n"])
def test_any_file_for_any_other(tmp_path, junk):
    readers = {"a.npz": ab.Model.open, "a.obj": ab.Model.load, "a.ply": ab.Model.load}
    for name, read in {**readers, **({"a.toml": load_scene} if junk else {})}.items():
        (tmp_path / name).write_bytes(junk)
        refused((ab.ModelError, ab.MeshError, SceneError), name.replace(".", r"\."), read, tmp_path / name)
