"""`sweep` against a scene with an object a pose."""

import numpy as np
import pytest
import warp as wp
from samples import STILL, random_poses, sample

import warp_abtree as ab
from warp_abtree import pose_sweep


@pytest.fixture
def small_chunks(monkeypatch):
    monkeypatch.setattr(pose_sweep, "CHUNK", 7)


def ask_scene(device, models, poses, lods, **options):
    scene = ab.Scene(device)
    scene.add(models[0], STILL, lod=lods[0])
    for pose in poses:
        scene.add(models[1], pose, lod=lods[1])
    return scene.intersect([(0, i + 1) for i in range(len(poses))], **options)


@pytest.mark.parametrize("precision", ["exact", "float32"])
@pytest.mark.parametrize("names", [("torus", "soup"), ("torus", "torus")])
def test_same_as_a_scene(device, names, precision, small_chunks):
    models = [sample(name) for name in names]
    rng = np.random.default_rng(1)
    poses = np.concatenate([random_poses(rng, 13, 1.2), random_poses(rng, 13, 6.0)])
    lods = [models[0].lod_for(fraction=0.3), None]
    expected = ask_scene(device, models, poses, lods, output="faces", precision=precision)
    assert 3 < expected.any.sum() < 26
    options = {"lod_a": lods[0], "precision": precision, "device": device}
    for output in ("any", "count", "faces"):
        found = ab.sweep(*models, poses, output=output, **options)
        np.testing.assert_array_equal(found, getattr(expected, output))
        assert found.dtype == getattr(expected, output).dtype
    on_device = wp.array(poses, dtype=wp.float64, device=device)
    np.testing.assert_array_equal(ab.sweep(*models, on_device, **options), expected.any)


def test_no_poses(device):
    torus = sample("torus")
    for output, shape in (("any", (0,)), ("count", (0,)), ("faces", (0, 3))):
        assert ab.sweep(torus, torus, np.empty((0, 7)), output=output, device=device).shape == shape


def test_refused(device):
    torus, poses = sample("torus"), np.array([STILL, STILL], float)
    bad = poses.copy()
    bad[1, 2] = np.nan
    for what, error, options in (
        ("pose 1 is not finite", ValueError, {"poses": bad}),
        ("shape", ValueError, {"poses": poses[:, :6]}),
        ("LOD", ValueError, {"lod_b": torus.lod_max + 1}),
        ("output 'all'", ValueError, {"output": "all"}),
        ("ContactQuery", ValueError, {"output": "contacts"}),
        ("precision 'half'", ValueError, {"precision": "half"}),
        ("no device", ValueError, {"device": "cuda:99"}),
        ("not a Model", TypeError, {"model_b": "torus"}),
    ):
        asked = {"model_a": torus, "model_b": torus, "poses": poses, "device": device, **options}
        with pytest.raises(error, match=what):
            ab.sweep(**asked)
