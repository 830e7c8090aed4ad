"""Nuts on their bolts in Newton: they stay on the thread when turned and hammered, on the scene that users copy."""

import importlib.util
import pathlib

import numpy as np
import pytest
import trimesh

import warp_abtree as ab

pytest.importorskip("newton")


@pytest.fixture(scope="module")
def scene():
    path = pathlib.Path(__file__).parents[2] / "scenes/newton_nut_and_bolt.py"
    spec = importlib.util.spec_from_file_location("newton_nut_and_bolt", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def make_nuts(scene, solver, device, count, hammer=0.0, tolerance=None):
    parts = scene.make_bolt(16, 6), scene.make_nut(16, 3)
    assert all(trimesh.Trimesh(*part).is_volume and trimesh.Trimesh(*part).volume > 0 for part in parts)
    bolt, nut = (ab.Model.from_arrays(*part) for part in parts)
    height = scene.find_height(bolt, nut, scene.PITCH, 2 * scene.PITCH)
    model = scene.build_model(bolt, nut, height, scene.PITCH, count, device)
    return scene.Nuts(model, bolt, nut, solver, scene.PITCH, hammer, tolerance=tolerance)


def test_hammered_nuts_stay_on_their_threads(scene, device):
    """At most the thread's play off it, while a blow alone would carry a nut through most of a pitch in a step."""
    nuts = make_nuts(scene, "xpbd", device, 2, 0.5)
    nuts.run(0.3)
    assert (nuts.turned < -0.1).all() and abs(np.subtract(*nuts.turned)) > 0.001, "each has a speed of its own"
    assert (nuts.lag < scene.PITCH / 8).all(), nuts.lag


def test_nuts_at_lods_within_a_tolerance_stay_on_their_threads(scene, device):
    nuts = make_nuts(scene, "xpbd", device, 2, 0.5, tolerance=4e-5)
    assert (nuts.found.scene.lods < [model.lod_max for model in nuts.found.scene.models * 2]).all()
    nuts.run(0.2)
    assert (nuts.turned < -0.05).all() and (nuts.lag < scene.PITCH / 8).all(), nuts.lag


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["xpbd", "mujoco"])
def test_nuts_follow_the_pitch(scene, device, solver):
    if solver == "mujoco":
        pytest.importorskip("mujoco_warp")
    nuts = make_nuts(scene, solver, device, 1)
    nuts.run(1.5)
    assert (nuts.turned < -1).all()
    np.testing.assert_allclose(nuts.travel(), 1, atol=0.05)
