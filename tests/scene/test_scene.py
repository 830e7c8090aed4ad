"""The scene: what it takes, what it refuses and how, and what holds across changes."""

import numpy as np
import pytest
import warp as wp
from helpers.samples import STILL, contact_poses, random_poses, raw_state, sample, true_faces
from helpers.scenes import everything
from oracles.triangle import pose_matrix

import warp_abtree as ab

NAN, INF = float("nan"), float("inf")
WRONG = (ValueError, TypeError)
TURN = np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1.0]])


def with_entry(array, index, value):
    array = np.array(array, float)
    array[index] = value
    return array


def pair_scene(device):
    scene = ab.Scene(device)
    scene.add(sample("small ball"), lod=30)
    scene.add(sample("box"), (0.5, 0.25, 0, 0, 0, 0, 1))
    scene.add(sample("small ball"), (0, 0.5, 0, 0, 0, 0, 1), world=-1, static=True, lod=12)
    scene.filter([(0, 1)])
    return scene


def check_refusal(scene, call, error, *words):
    """The call raises one clear error that names what is wrong, and leaves no trace."""
    before, arrays = everything(scene), scene.batch()
    with pytest.raises(error) as caught:
        call(scene)
    assert type(caught.value) in (ValueError, TypeError)
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message
    assert scene.batch() is arrays, "a refused call makes nothing anew"
    assert everything(scene) == before


# Bad input: what is given, and words that the message needs.

SKEWED = with_entry(TURN, (0, 0), 1e-4)
MIRROR = np.diag([1.0, 1.0, -1.0, 1.0])

BAD_POSES = {
    "not finite": (with_entry(STILL, 1, NAN), ["pose", "finite"]),
    "infinite": (with_entry(STILL, 0, INF), ["pose", "finite"]),
    "quaternion not finite": (with_entry(STILL, 5, NAN), ["pose", "finite"]),
    "not normalised": (with_entry(STILL, 6, 1.002), ["pose", "quaternion", "1.002"]),
    "no quaternion": (np.zeros(7), ["pose", "quaternion"]),
    "too short": (STILL[:6], ["pose", "shape"]),
    "too long": ([*STILL, 0.0], ["pose", "shape"]),
    "a number": (1.0, ["pose", "shape"]),
    "skewed": (SKEWED, ["pose", "rigid"]),
    "mirror": (MIRROR, ["pose", "rigid"]),
    "scaled": (2 * np.eye(4), ["pose", "rigid"]),
    "bad last row": (with_entry(np.eye(4), (3, 0), 1e-9), ["pose", "rigid"]),
    "matrix not finite": (with_entry(np.eye(4), (0, 3), INF), ["pose", "finite"]),
    "3 by 4": (np.eye(4)[:3], ["pose", "shape"]),
    "text": ("origin", ["pose"]),
    "none": (None, ["pose"]),
    "complex": (np.array(STILL, complex), ["pose"]),
    "ragged": ([0, 0, 0, [0, 0, 0, 1]], ["pose"]),
}


@pytest.mark.parametrize("case", BAD_POSES)
def test_add_refuses_pose(device, case):
    pose, words = BAD_POSES[case]
    check_refusal(pair_scene(device), lambda scene: scene.add(sample("box"), pose), WRONG, *words)


@pytest.mark.parametrize("case", BAD_POSES)
def test_set_poses_refuses(device, case):
    """The bad pose is the second of three; the message says which."""
    pose, words = BAD_POSES[case]
    array = np.asarray(pose) if case not in ("ragged", "none") else None
    good = np.eye(4) if array is not None and array.ndim == 2 else np.array(STILL)
    if array is not None and array.shape == good.shape and array.dtype.kind == "f":
        poses, words = np.stack([good, array, good]), [*words, "1"]
    else:
        poses = pose if case in ("none", "text") else [pose] * 3
    check_refusal(pair_scene(device), lambda scene: scene.set_poses(poses), WRONG, *words)


@pytest.mark.parametrize("count", [0, 2, 4])
def test_set_poses_refuses_count(device, count):
    poses = np.tile(STILL, (count, 1))
    check_refusal(pair_scene(device), lambda scene: scene.set_poses(poses), ValueError, "poses", str(count), "3")


BAD_OBJECTS = {
    "no model": (dict(model="box.obj"), TypeError, ["model", "str"]),
    "mesh for a model": (dict(model=None), TypeError, ["model", "NoneType"]),
    "world below -1": (dict(world=-2), ValueError, ["world", "-2"]),
    "world too large": (dict(world=2**31), ValueError, ["world"]),
    "half a world": (dict(world=0.5), ValueError, ["world", "0.5"]),
    "world not finite": (dict(world=NAN), ValueError, ["world", "nan"]),
    "world infinite": (dict(world=INF), ValueError, ["world", "inf"]),
    "world as text": (dict(world="main"), WRONG, ["world", "main"]),
    "no world": (dict(world=None), WRONG, ["world", "None"]),
    "importance": (dict(importance=4), ValueError, ["importance", "4"]),
    "importance not finite": (dict(importance=NAN), ValueError, ["importance"]),
    "LOD below": (dict(lod=-1), ValueError, ["LOD", "-1", "box"]),
    "LOD above": (dict(lod=999), ValueError, ["LOD", "999", "box"]),
    "half a LOD": (dict(lod=1.5), ValueError, ["LOD", "1.5"]),
    "LOD not finite": (dict(lod=NAN), ValueError, ["LOD", "nan"]),
    "LOD as text": (dict(lod="fine"), WRONG, ["LOD", "fine"]),
    "LOD as truth": (dict(lod=True), ValueError, ["LOD", "True"]),
}


@pytest.mark.parametrize("case", BAD_OBJECTS)
def test_add_refuses(device, case):
    options, error, words = BAD_OBJECTS[case]
    options = {"model": sample("box"), **options}
    check_refusal(pair_scene(device), lambda scene: scene.add(**options), error, *words)


BAD_LODS = {
    "too few": ([1, 2], ["lods", "(2,)", "3"]),
    "too many": ([1, 2, 3, 4], ["lods", "(4,)", "3"]),
    "a column": ([[1], [2], [3]], ["lods", "(3, 1)"]),
    "one for all": (3, ["lods", "()"]),
    "below": ([1, -1, 2], ["lods", "object 1", "-1"]),
    "above": ([1, 2, 10**6], ["lods", "object 2", "1000000"]),
    "far above": ([1, 2, 2**62], ["lods", "object 2"]),
    "halves": ([1, 0.5, 2], ["lods"]),
    "not finite": ([1, NAN, 2], ["lods"]),
    "infinite": ([1.0, INF, 2], ["lods"]),
    "text": (["a", "b", "c"], ["lods"]),
    "none": ([None] * 3, ["lods"]),
    "truths": ([True, False, True], ["lods"]),
    "ragged": ([1, [2], 3], ["lods"]),
}


@pytest.mark.parametrize("case", BAD_LODS)
def test_set_lods_refuses(device, case):
    lods, words = BAD_LODS[case]
    check_refusal(pair_scene(device), lambda scene: scene.set_lods(lods), WRONG, *words)


BAD_PAIRS = {
    "no such object": ([(0, 1), (0, 3)], ["pairs", "pair 1", "(0, 3)"]),
    "negative": ([(-1, 0)], ["pairs", "pair 0", "(-1, 0)"]),
    "huge": ([(0, 2**40)], ["pairs", "pair 0"]),
    "with itself": ([(0, 1), (1, 2), (2, 2)], ["pairs", "pair 2", "itself"]),
    "triples": ([(0, 1, 2)], ["pairs", "(1, 3)"]),
    "a row": ([0, 1], ["pairs", "(2,)"]),
    "halves": ([(0, 0.5)], ["pairs", "float64"]),
    "floats": ([(0.0, 1.0)], ["pairs", "float64"]),
    "truths": ([(False, True)], ["pairs", "bool"]),
    "text": ("all of them", ["pairs"]),
    "ragged": ([(0, 1), (1,)], ["pairs"]),
}


@pytest.mark.parametrize("case", BAD_PAIRS)
@pytest.mark.parametrize("method", ["intersect", "filter", "query"])
def test_pairs_are_refused(device, method, case):
    calls = {
        "intersect": lambda scene: scene.intersect(pairs, precision="exact"),
        "filter": lambda scene: scene.filter(pairs),
        "query": lambda scene: ab.Query(scene, pairs=pairs, precision="exact"),
    }
    pairs, words = BAD_PAIRS[case]
    check_refusal(pair_scene(device), calls[method], WRONG, *words)


@pytest.mark.parametrize(
    "options, words",
    [
        (dict(output="some"), ["output", "'some'"]),
        (dict(output=None), ["output", "None"]),
        (dict(precision="float16"), ["precision", "'float16'"]),
    ],
)
def test_options_are_refused(device, options, words):
    options = {"precision": "float32", **options}
    check_refusal(pair_scene(device), lambda scene: scene.intersect([(0, 1)], **options), ValueError, *words)
    check_refusal(pair_scene(device), lambda scene: ab.Query(scene, **options), ValueError, *words)


@pytest.mark.parametrize("value", [0, -1, 2**31, NAN, INF, "many"])
def test_query_refuses_capacity(device, value):
    check_refusal(pair_scene(device), lambda scene: ab.Query(scene, capacity=value), WRONG, "capacity", str(value))
    for name in ("hits", "pairs", "uncertain"):
        with pytest.raises(ValueError, match=f"buffers: {name} "):
            ab.Buffers(**{name: value})


@pytest.mark.parametrize("i", [-1, 3, 2**40, 0.5, NAN, INF, "first", None])
def test_tree_state_refuses(device, i):
    check_refusal(pair_scene(device), lambda scene: scene.tree_state(i), WRONG, "object", str(i))


@pytest.mark.parametrize("name", ["cuda:99", "tpu", 7, ""])
def test_missing_devices_are_named(name):
    with pytest.raises(ValueError, match=r"no device .* cpu"):
        ab.Scene(name)


def test_an_empty_scene(device):
    scene = ab.Scene(device)
    assert scene.object_count == 0 and len(scene.lods) == 0
    assert scene.broad_phase().shape == (0, 2)
    for call in (
        lambda: scene.set_poses(np.empty((0, 7))),
        lambda: scene.set_lods([]),
        lambda: scene.intersect([(0, 1)], precision="exact"),
        lambda: scene.tree_state(0),
        lambda: ab.Query(scene, precision="exact"),
    ):
        with pytest.raises(ValueError, match=r"no object|0 objects|outside"):
            call()
    scene.add(sample("box"))
    assert scene.intersect(precision="exact").pairs.shape == (0, 2)


# What is taken.


def placed(scene):
    pool = scene.batch().objects.pool
    return pool.rotation.numpy(), pool.position.numpy()


def test_quaternions_are_normalised_in_float64(device):
    scene = pair_scene(device)
    poses = random_poses(np.random.default_rng(1), 3, 5.0)
    poses[:, 3:] *= [[1.0009], [0.9991], [1.0]]
    scene.set_poses(poses)
    for pose, rotation, position in zip(poses, *placed(scene), strict=True):
        expected = pose_matrix(pose)
        np.testing.assert_array_equal(rotation, expected[0])
        np.testing.assert_array_equal(position, expected[1])
    added = ab.Scene(device)
    for pose in poses:
        added.add(sample("box"), pose)
    for one, other in zip(placed(scene), placed(added), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_matrices_are_taken_as_they_are(device, dtype):
    """Also those that are a rotation only within 1e-6; float32 is widened, not improved."""
    rng = np.random.default_rng(2)
    poses = np.tile(np.eye(4), (3, 1, 1))
    for pose, row in zip(poses, random_poses(rng, 3, 5.0), strict=True):
        pose[:3, :3], pose[:3, 3] = pose_matrix(row)
    poses[:, :3, :3] += rng.uniform(-1e-7, 1e-7, (3, 3, 3))
    poses = poses.astype(dtype)
    scene = pair_scene(device)
    scene.set_poses(poses)
    mixed = ab.Scene(device)
    for i, pose in enumerate(poses):
        mixed.add(sample("box"), pose)
        mixed.add(sample("box"), (i, 0, 0, 0, 0, 0, 1))
    for rotation, position in (placed(scene), [part[::2] for part in placed(mixed)]):
        np.testing.assert_array_equal(rotation, poses[:, :3, :3].astype(np.float64))
        np.testing.assert_array_equal(position, poses[:, :3, 3].astype(np.float64))


def test_arrays_of_every_kind_are_taken(device):
    scene = pair_scene(device)
    rows = np.array([STILL, (1, 2, 3, 0, 0, 1, 0), (0.5, 0, 0, 0, 1, 0, 0)])
    scene.set_poses(rows)
    expected = placed(scene)
    for poses in (rows.tolist(), rows.astype(np.float32), rows[::-1][::-1], wp.array(rows, device=device)):
        scene.set_poses(np.tile(STILL, (3, 1)))
        scene.set_poses(poses)
        for one, other in zip(placed(scene), expected, strict=True):
            np.testing.assert_array_equal(one, other)
    for lods in ((3, 2, 1), [3.0, 2.0, 1.0], np.array([3, 2, 1], np.uint8), wp.array([3, 2, 1], device=device)):
        scene.set_lods([0, 0, 0])
        scene.set_lods(lods)
        assert scene.lods.tolist() == [3, 2, 1]
    pairs = [(0, 1), (2, 0)]
    for given in (pairs, np.array(pairs, np.uint16), wp.array(pairs, dtype=wp.vec2i, device=device)):
        assert scene.intersect(given, precision="exact").pairs.tolist() == [[0, 1], [2, 0]]


# What holds across changes.


def test_add_keeps_poses_and_lods(device):
    scene = pair_scene(device)
    rng = np.random.default_rng(3)
    scene.set_poses(random_poses(rng, 3, 5.0))
    scene.set_lods([7, 3, 20])
    scene.intersect(precision="exact")
    before = placed(scene)
    states = [raw_state(scene, i) for i in range(3)]
    scene.add(sample("torus"), TURN, lod=5)
    scene.add(sample("box"))
    assert scene.lods.tolist() == [7, 3, 20, 5, sample("box").lod_max]
    for old, new in zip(before, placed(scene), strict=True):
        np.testing.assert_array_equal(new[:3], old)
    np.testing.assert_array_equal(placed(scene)[0][3], TURN[:3, :3])
    for i, state in enumerate(states):
        for name, value in raw_state(scene, i).items():
            np.testing.assert_array_equal(value, state[name])


def test_a_refused_object_spoils_no_query(device):
    scene = pair_scene(device)
    query = ab.Query(scene, precision="exact")
    query.launch()
    with pytest.raises(ValueError):
        scene.add(sample("box"), lod=-1)
    query.launch()
    scene.add(sample("box"))
    with pytest.raises(RuntimeError, match="new one"):
        query.launch()


def test_a_query_follows_poses_and_lods(device):
    """Launched again after every change; its answers are those of a scene made so from the start."""
    rng = np.random.default_rng(4)
    models = [sample("torus"), sample("capsule"), sample("torus"), sample("crumbs")]
    scene = ab.Scene(device)
    for model in models:
        scene.add(model)
    pairs = [(0, 1), (2, 0), (3, 1), (2, 3)]
    asked = ab.Query(scene, "faces", pairs=pairs, precision="exact")
    found = ab.Query(scene, "faces", precision="exact", capacity=20_000)
    hits = 0
    for _ in range(6):
        poses = random_poses(rng, 4, 0.6)
        lods = [int(rng.integers(10, model.lod_max)) for model in models]
        scene.set_poses(poses)
        scene.set_lods(lods)
        for query in (asked, found):
            query.launch()
            result = query.result()
            result.check()
            rows = []
            for p, (i, j) in enumerate(result.pairs.tolist()):
                low, high = min(i, j), max(i, j)
                faces = true_faces(models[low], lods[low], poses[low], models[high], lods[high], poses[high])
                faces = faces if i < j else faces[:, ::-1]
                rows += [(p, *face) for face in faces[np.lexsort(faces.T[::-1])].tolist()]
            assert list(map(tuple, result.faces.tolist())) == rows
            hits += len(rows)
        assert asked.result().pairs.tolist() == list(map(list, pairs))
    assert hits > 100


def test_scenes_do_not_mix(device):
    """Two scenes share models and nothing else."""
    rng = np.random.default_rng(5)
    ball, torus = sample("small ball"), sample("torus")
    first, second = ab.Scene(device), ab.Scene(device)
    pose_a, pose_b = contact_poses(rng, ball, ball.lod_max, torus, torus.lod_max)
    first.add(ball, pose_a)
    first.add(torus, pose_b)
    second.add(torus, lod=4)
    second.add(ball, pose_b, lod=9)
    before = first.intersect([(0, 1)], output="faces", precision="exact").faces
    second.set_lods([9, 60])
    second.set_poses([TURN, np.eye(4)])
    second.intersect([(0, 1)], precision="exact")
    np.testing.assert_array_equal(first.intersect([(0, 1)], output="faces", precision="exact").faces, before)
    np.testing.assert_array_equal(before[:, 1:], true_faces(ball, ball.lod_max, pose_a, torus, torus.lod_max, pose_b))


def test_names_of_a_model_may_repeat(device):
    """Models count by identity: two models of one name are two models."""
    vertices, faces, _ = sample("box").mesh_at(sample("box").lod_max)
    twins = [ab.Model.from_arrays(vertices * s, faces, name="same") for s in (1.0, 5.0)]
    scene = ab.Scene(device)
    for model in (*twins, twins[0]):
        scene.add(model)
    assert len(scene.models) == 2 and scene.object_model == [0, 1, 0]
    assert scene.tree_state(1).upper[1][0] > 4 * scene.tree_state(0).upper[1][0]
