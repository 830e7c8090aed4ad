"""Gradients of distances: against differences of distances, where witnesses are unique and where they are not."""

import pickle

import numpy as np
import pytest
import trimesh
from conftest import slow_rows
from helpers.questions import captured, in_a_row, pairs_of, parted_cases, scene_of, starts_of, to_matrix
from helpers.samples import sample
from helpers.scenes import scene_with
from helpers.solids import moved
from oracles.triangle import quaternion_matrix

import warp_abtree as ab
from warp_abtree.scene.posed_objects import PosedObjects

STEP = 1e-6
SIGNED = {"output": "distance", "signed": True}
SOLIDS = [("torus", "ball"), ("capsule", "torus"), ("small ball", "capsule")]
SURFACES = [("torus", "soup"), ("lattice soup", "capsule"), ("crumbs", "ball"), ("twins", "one"), ("box", "three")]


def turned_matrix(pose, axis, angle):
    turn = trimesh.transformations.rotation_matrix(angle, np.eye(3)[axis])[:3, :3]
    return to_matrix(turn @ quaternion_matrix(pose[3:]), pose[:3])


def slopes_of(scene, pairs, poses, options):
    """Return slopes of distances before and after the poses along each motion, (p, 2, 6) each."""
    asked = {"output": "distance", **options}
    still = np.array([turned_matrix(pose, 0, 0.0) for pose in poses])
    scene.set_poses(still)
    here = scene.intersect(pairs, **asked).distance
    slopes = np.empty((2, len(pairs), 2, 6))
    for k in range(2):
        for axis in range(6):
            for side, step in enumerate((-STEP, STEP)):
                matrices = still.copy()
                for i in pairs[:, k]:
                    if axis < 3:
                        matrices[i, axis, 3] += step
                    else:
                        matrices[i] = turned_matrix(poses[i], axis - 3, step)
                scene.set_poses(matrices)
                slopes[side, :, k, axis] = (scene.intersect(pairs, **asked).distance - here) / step
    scene.set_poses(poses)
    return slopes


@pytest.mark.parametrize(
    "names, count, options",
    [(SURFACES, 40, {}), (SOLIDS, 40, {"signed": True}), *slow_rows((SURFACES, 300, {}), (SOLIDS, 150, SIGNED))],
    ids=["surfaces", "solids", "1,500 surfaces", "450 solids"],
)
def test_gradients_are_slopes(device, names, count, options):
    """Each lies between the slopes before and after, which agree where the nearest points are unique; of any LOD."""
    rng = np.random.default_rng(3)
    cases = parted_cases(rng, names * count, faces=150)
    scene, pairs = scene_of(device, cases, solid="signed" in options), pairs_of(cases)
    pairs[::2] = pairs[::2, ::-1]
    result = scene.intersect(pairs, **{"output": "distance", **options})
    counts = result.distance > 1e-3, result.distance < 0, ~result.any & (result.distance <= 1e-3)
    assert counts[0].mean() > 0.2 and counts[2].mean() < 0.05 and ("signed" not in options or counts[1].mean() > 0.1)
    assert not result.gradient[result.distance == 0].any()
    before, after = slopes_of(scene, pairs, starts_of(cases), options)
    asked = counts[0] | counts[1]
    # Between kinks a distance bends by the square of the arm over itself.
    bend = 1e-7 + (4 * STEP * (1 + 1 / np.maximum(np.abs(result.distance), 1e-3)))[:, None, None]
    low, high = np.minimum(before, after) - bend, np.maximum(before, after) + bend
    inside = ((low <= result.gradient) & (result.gradient <= high)).all((1, 2))
    unique = (np.abs(after - before) < 1e-2).all((1, 2))
    assert inside[asked].all() and unique[asked].mean() > 0.8
    middle = (before + after) / 2
    np.testing.assert_allclose(result.gradient[unique & asked], middle[unique & asked], rtol=0, atol=5e-3)
    smooth = (np.abs(after - before) < 1e-5).all((1, 2)) & asked
    assert smooth.mean() > 0.1
    np.testing.assert_allclose(result.gradient[smooth], middle[smooth], rtol=0, atol=1e-6)
    along = np.linalg.norm(result.gradient[asked, :, :3], axis=2)
    np.testing.assert_allclose(along, 1, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(result.gradient[:, 0, :3], -result.gradient[:, 1, :3])


BOX = ab.Model.load(trimesh.creation.box((4, 4, 4)))
BEAMS = [ab.Model.load(trimesh.creation.box(size)) for size in ((9, 1, 1), (1, 9, 1))]


@pytest.mark.parametrize("other, z, options, along", [
    (BOX, 4.5, {}, 1.0),  # side over side: any of their points may be the witness
    (BOX, 4.5, {"signed": True}, 1.0),
    (BOX, 3.75, {"signed": True}, 1.0),  # pressed in by 0.25
    (BOX, 4 + 1e-9, {}, 1.0),
    (BOX, 4.0, {"signed": True}, 0.0),  # touching
    (BOX, 3.75, {}, 0.0),  # surfaces that cross
    (BOX, 1e39, {}, 1.0),
    (BOX, 1e200, {}, 1.0),
    (BOX, 6.0, {"beyond": 1.0}, 0.0),  # proved farther apart
    (BOX, 0.0, {"signed": True}, 0.0),  # coincident
])  # fmt: skip
def test_witnesses_that_are_not_unique_and_distance_0(device, other, z, options, along):
    scene = scene_with(device, (BOX, {"solid": True}), (other, moved(z=z), {"solid": True}))
    for pair in ((0, 1), (1, 0)):
        (gradient,) = scene.intersect([pair], "distance", **options).gradient
        place = pair.index(1)
        np.testing.assert_allclose(gradient[place, :3], [0, 0, along], rtol=0, atol=1e-6 if z == 4 + 1e-9 else 1e-15)
        np.testing.assert_allclose(gradient[1 - place, :3], [0, 0, -along], rtol=0, atol=1e-6)
        # The arm ends on both sides: by 2 at most of either axis, and none along z.
        assert np.isfinite(gradient).all() and (along or not gradient.any())
        assert (np.abs(gradient[:, 3:5]) <= 2 + 1e-6).all() and np.abs(gradient[:, 5]).max() < 1e-5


def test_crossing_solids_without_a_depth_have_none(device):
    """Two beams crossed, with no sample of either inside the other, and a ball in a box."""
    objects = [(BEAMS[0], {"solid": True}), (BEAMS[1], moved(2.7, 2.7, 0.25), {"solid": True})]
    result = scene_with(device, *objects).intersect([(0, 1)], **SIGNED)
    assert result.any.all() and result.distance == 0 and not result.gradient.any()
    scene = scene_with(device, (BOX, {"solid": True}), (sample("small ball"), {"solid": True}))
    result = scene.intersect([(0, 1)], "distance")
    assert result.any.all() and not result.gradient.any()


def test_launches_of_every_kind_give_the_same(device):
    cases = parted_cases(np.random.default_rng(5), [("torus", "soup"), ("box", "crumbs")] * 6)
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    result = scene.intersect(pairs, "distance")
    expected = result.gradient.tobytes()
    assert result.gradient.shape == (12, 2, 6) and result.gradient.dtype == np.float64
    posed = PosedObjects(device)
    for case in cases:
        for model, lod, pose in (case[:3], case[3:]):
            posed.add(model, pose, lod=lod)
    query = ab.DistanceQuery(posed, pairs)
    replay = captured(query)
    for _ in range(2):
        replay()
        assert query.result().gradient.tobytes() == expected
    on_device = query.run(device=True)
    scene.set_poses(np.tile([0.0, 0, 0, 0, 0, 0, 1], (24, 1)))
    posed.set_poses(np.tile([0.0, 0, 0, 0, 0, 0, 1], (24, 1)))
    query.launch()
    assert on_device.gradient.numpy().tobytes() == expected
    assert pickle.loads(pickle.dumps(result)).gradient.tobytes() == expected
    assert repr(result) == "Result(pairs=12, any, points, distance, bracket, point_faces, gradient)"
    assert repr(on_device) == repr(result)
    assert "gradient" not in result.rows()[0] and scene.intersect(pairs).gradient is None
    row = in_a_row(device, "box", (0, 1.5, 9)).intersect(None, "distance", beyond=1.0)
    np.testing.assert_array_equal(row.gradient[:, :, :3], [[[-1, 0, 0], [1, 0, 0]]])
    assert scene.intersect(np.empty((0, 2), int), "distance").gradient.shape == (0, 2, 6)
