"""A child forked after queries, as PyTorch's DataLoader forks workers on Linux: an answer, or one clear error."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import warp_abtree as ab
from warp_abtree.query.cpu_threads import core_count

PROGRAM = """
import os, sys
import numpy as np, trimesh, warp as wp
wp.config.log_level = wp.LOG_WARNING
import warp_abtree as ab
device, other = sys.argv[1:3]
model = ab.Model.load(trimesh.creation.torus(1.0, 0.3, 24, 12))
poses = np.tile([0.0, 0, 0, 0, 0, 0, 1], (300, 1))
poses[:, 0] = np.linspace(0, 3, 300)
scene = ab.Scene(device)
for k in range(12):
    scene.add(model, pose=(0.4 * k, 0, 0, 0, 0, 0, 1))

def ask(where):
    swept = ab.sweep(model, model, poses, output="count", device=where)
    found = scene if where == device else ab.Scene(where)
    if found is not scene:
        for k in range(12):
            found.add(model, pose=(0.4 * k, 0, 0, 0, 0, 0, 1))
    return swept.tolist(), found.intersect(output="faces").faces.tolist()

expected = ask(device)
child = os.fork()
if child == 0:
    try:
        print("same" if ask(other) == expected else "another answer", flush=True)
    except RuntimeError as error:
        print(error, flush=True)
    os._exit(0)
_, status = os.waitpid(child, 0)
print(status, ask(device) == expected)
"""


def run(device, other):
    command = [sys.executable, "-c", PROGRAM, device, other]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, env={**os.environ, "PYTHONPATH": ROOT})
    assert done.returncode == 0, done.stderr
    return done.stdout.split("\n")


ROOT = os.pathsep.join([str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")])


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_forked_child(device):
    """On the CPU it answers, on several cores as its parent did; on a GPU it refuses. The parent goes on."""
    answer, parent = run(device, device)[:2]
    if ab.Scene(device).device.is_cuda:
        assert "cannot be used in a process forked after Warp started" in answer and "spawn" in answer
        assert run(device, "cpu")[0] == "same"
    else:
        assert answer == "same" and core_count() >= 1
    assert parent == "0 True"
