"""The scene: what it takes, and what holds across changes."""

import numpy as np
import pytest
from helpers.questions import sort_rows, to_matrix
from helpers.samples import random_poses, raw_state, sample, true_faces
from helpers.scenes import TURN, add_objects, pair_scene
from oracles.triangle import pose_matrix

import warp_abtree as ab


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
    poses = np.array([to_matrix(*pose_matrix(row)) for row in random_poses(rng, 3, 5.0)])
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


def test_add_keeps_poses_and_lods(device):
    scene = pair_scene(device)
    scene.set_poses(random_poses(np.random.default_rng(3), 3, 5.0))
    scene.set_lods([7, 3, 20])
    before, states = placed(scene), [raw_state(scene, i) for i in range(3)]
    scene.add(sample("torus"), TURN, lod=5)
    scene.add(sample("box"))
    assert scene.lods.tolist() == [7, 3, 20, 5, sample("box").lod_max]
    for old, new in zip(before, placed(scene), strict=True):
        np.testing.assert_array_equal(new[:3], old)
    np.testing.assert_array_equal(placed(scene)[0][3], TURN[:3, :3])
    np.testing.assert_equal([raw_state(scene, i) for i in range(3)], states)


def test_a_query_follows_poses_and_lods(device):
    """Launched again after every change; its answers are those of a scene made so from the start."""
    rng, hits, pairs = np.random.default_rng(4), 0, [[0, 1], [2, 0], [3, 1], [2, 3]]
    scene = add_objects(device, ["torus", "capsule", "torus", "crumbs"])
    models = [scene.models[m] for m in scene.object_model]
    asked, found = (ab.Query(scene, "faces", pairs=given, capacity=20_000) for given in (pairs, None))
    for _ in range(6):
        poses = random_poses(rng, 4, 0.6)
        lods = [int(rng.integers(10, model.lod_max)) for model in models]
        scene.set_poses(poses)
        scene.set_lods(lods)
        for query in (asked, found):
            query.launch()
            result = query.result()
            result.check()
            for p, (i, j) in enumerate(np.sort(result.pairs).tolist()):
                faces = true_faces(models[i], lods[i], poses[i], models[j], lods[j], poses[j])
                faces = faces if result.pairs[p, 0] == i else sort_rows(faces[:, ::-1])
                np.testing.assert_array_equal(result.faces[result.faces[:, 0] == p][:, 1:], faces)
                hits += len(faces)
        assert asked.result().pairs.tolist() == pairs
    assert hits > 100


def test_names_of_a_model_may_repeat(device):
    """Models count by identity: two models of one name are two models."""
    vertices, faces, _ = sample("box").mesh_at(sample("box").lod_max)
    twins = [ab.Model.from_arrays(vertices * s, faces, name="same") for s in (1.0, 5.0)]
    scene = ab.Scene(device)
    for model in (*twins, twins[0]):
        scene.add(model)
    assert len(scene.models) == 2 and scene.object_model == [0, 1, 0]
    assert scene.tree_state(1).upper[1][0] > 4 * scene.tree_state(0).upper[1][0]
