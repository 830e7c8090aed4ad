"""Whole runs of frames: nothing is loaded in one, and worlds alone are what they are among others."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.bodies import ring_and_ball

import warp_abtree as ab
from warp_abtree.lod.controllers import PaperController, ToleranceController
from warp_abtree.lod.timing import STAGES
from warp_abtree.lod.view import Camera

ROOT = Path(__file__).resolve().parents[2]


WARMED_UP = """
import sys, numpy as np, trimesh, warp_abtree as ab
device, kind = sys.argv[1:]
ring = ab.Model.load(trimesh.creation.torus(0.5, 0.15, major_sections=64, minor_sections=24))
scene = ab.Scene(device=device)
for i in range(3):
    scene.add(ring, (0.3 * i, 0, 0, 0, 0, 0, 1))
top = ring.lod_max
motion = ab.Dynamics(scene).motion() if kind == "bodies" else None
steps = [(top, top - 1, 0), (top, top - 1, top - 1), (0, 1, 2), (top, top, top)]
lods = lambda time: np.array(steps[min(round(60 * time), 3)])
if kind == "budget":
    lods = ab.PredictiveController(scene, 1e6, ab.Camera.look_at((0, 0, 9), (0, 0, 0)))
frame = ab.Frame(scene, motion, lods)
before = scene.lods.tolist(), scene.batch().objects.pool.position.numpy().tobytes()
frame.warm_up()
assert before == (scene.lods.tolist(), scene.batch().objects.pool.position.numpy().tobytes()) and not frame.history
print("warm", flush=True)
frame.run(8)
print(sum(row.lods_changed for row in frame.history), frame.history[-1].hits)
"""


@pytest.mark.parametrize("kind", ["bodies", "budget", "lods"])
@pytest.mark.slow
def test_nothing_is_loaded_after_the_warm_up(device, kind):
    """In a process of its own, where nothing is loaded yet; Warp says what it loads."""
    words = [sys.executable, "-c", WARMED_UP, device, kind]
    said = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    before, after = said.split("warm\n")
    assert "load on device" in before and "load on device" not in after, after
    changed, hits = map(int, after.split())
    assert changed >= 3 and hits > 0


def motion_of(worlds):
    """Return the motion of the objects of some worlds and of one, the last, that is in all of them."""
    rng = np.random.default_rng(7)
    rows = [(rng.uniform(-0.8, 0.8, (4, 3)), rng.uniform(-1, 1, (4, 3)), rng.uniform(1, 3, 4)) for _ in range(3)]
    place, velocity, rate = (np.concatenate([*(rows[w][k] for w in worlds), 0 * rows[0][k][:1]]) for k in range(3))
    return ab.Kinematic(place, velocity=velocity, axis=(1, 2, 3), rate=rate)


def run_worlds(device, worlds, kind, moved):
    """Run some of three worlds together; return LODs, pairs and hits by world and frame."""
    scene, motion = ab.Scene(device=device), motion_of(worlds)
    for place, world in enumerate(worlds):
        for i in range(4):
            scene.add(ring_and_ball()[i % 2], world=place, importance=1 + (world + i) % 3)
    scene.add(ring_and_ball()[0], world=-1, static=True)
    scene.set_poses(motion.poses(0.0))
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), far=10.0)
    lods = PaperController(scene, 8.0, camera) if kind == "paper" else ToleranceController(scene, 0.01, camera)
    if moved == "bodies":
        motion = ab.Dynamics(scene, gravity=(0, 0, -3), velocity=motion.velocity).motion()
    ticks = np.cumsum(np.random.default_rng(3).uniform(0, 1.5e-3, 30 * (len(STAGES) + 1)))
    frame = ab.Frame(scene, motion, lods, clock=iter(ticks.tolist()).__next__, output="faces")
    found = {world: [] for world in worlds}
    for _ in range(30):
        result = frame.step()
        for place, world in enumerate(worlds):
            mine = np.append(np.arange(4 * place, 4 * place + 4), 4 * len(worlds))
            kept = np.isin(result.pairs, mine).all(1)
            pairs = np.searchsorted(mine, result.pairs[kept]).tolist()
            seen = [scene.lods[mine].tolist(), pairs, result.count[kept].tolist()]
            if scene.device.is_cpu:  # warps start a pair deeper the more of them share it
                seen.append(result.node_tests[kept].tolist())
            if result.faces is not None:
                seen.append(result.faces[kept[result.faces[:, 0]], 1:].tolist())
            found[world].append(seen)
    return found


@pytest.mark.parametrize("moved", ["as told", "bodies"])
@pytest.mark.parametrize("kind", ["paper", "tolerance"])
def test_worlds_alone_and_together_are_the_same(device, kind, moved):
    """On one clock. (A predicted budget is shared by all that is in the scene, so it is another alone.)"""
    found = run_worlds(device, (0, 1, 2), kind, moved)
    assert len({str(seen[0]) for seen in found[1]}) > (1 if kind == "tolerance" else 3), "LODs change"
    assert found[0] != found[1] and any(seen[2] for seen in found[2])
    for world in range(3):
        assert run_worlds(device, (world,), kind, moved)[world] == found[world]
