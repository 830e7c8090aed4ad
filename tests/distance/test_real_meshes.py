"""Real meshes at very many poses, beside python-fcl: distances, brackets, and zeros where the exact test says so."""

import numpy as np
import pytest
from helpers.questions import scene_of
from helpers.samples import STILL, random_poses, sample
from oracles.peers import fcl_object
from oracles.triangle import quaternion_matrix

import warp_abtree as ab

fcl = pytest.importorskip("fcl")

PAIRS = (("cow", "rocker-arm"), ("fandisk", "cow"), ("stanford-bunny", "fandisk"), ("fcl-env", "fcl-rob"))
POSES = 500


@pytest.mark.slow
@pytest.mark.parametrize("names", PAIRS, ids="-".join)
def test_equals_fcl(device, names):
    a, b = map(sample, names)
    poses = random_poses(np.random.default_rng(1), POSES, 1.5)  # positions of B's centre about A's
    poses[:, :3] += a.centre - np.array([quaternion_matrix(q) @ b.centre for q in poses[:, 3:]])
    scene = scene_of(device, [(a, None, STILL, b, None, pose) for pose in poses])
    pairs = np.arange(2 * POSES).reshape(-1, 2)
    query = ab.DistanceQuery(scene, pairs)
    result = query.run()
    np.testing.assert_array_equal(result.distance == 0, scene.intersect(pairs).any)
    still, other = (fcl_object(*model.mesh_at(model.lod_max)[:2]) for model in (a, b))
    truth = []
    for pose in poses:
        other.setTransform(fcl.Transform(quaternion_matrix(pose[3:]), pose[:3]))
        truth.append(max(0.0, fcl.distance(still, other, fcl.DistanceRequest(), fcl.DistanceResult())))
    truth, apart = np.array(truth), ~result.any
    assert 20 < apart.sum() and result.any.any()
    # FCL's own rounding is about that of the brackets.
    np.testing.assert_allclose(result.distance[apart], truth[apart], rtol=1e-12, atol=1e-14)
    lower, upper = result.bracket.T
    assert (lower <= truth * (1 + 1e-13)).all() and (truth * (1 - 1e-13) <= upper)[apart].all()
    assert (upper - lower)[apart].max() < 1e-12
    # From the start again, with slabs, and from the answer.
    for forgets in (True, False):
        if forgets:
            query.forget()
        again = query.run()
        for name in ("distance", "bracket", "points", "point_faces"):
            np.testing.assert_array_equal(getattr(again, name), getattr(result, name))
