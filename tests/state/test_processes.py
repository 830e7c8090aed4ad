"""A process in trouble: a real Ctrl-C while threads work, a fork after queries, a kernel cache not to be written."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.samples import random_poses, sample

import warp_abtree as ab
from warp_abtree.checks.cpu_threads import core_count

START = """
import os, sys, tempfile
import numpy as np, trimesh, warp as wp
wp.config.log_level = wp.LOG_WARNING
import warp_abtree as ab
model = ab.Model.load(trimesh.creation.torus(1.0, 0.3, 24, 12), base_faces=4)
def make(device):
    scene = ab.Scene(device)
    for k in range(5):
        scene.add(model, pose=(0.4 * k, 0.1, 0, 0, 0, 0, 1))
    return scene
"""
FORK = """
device, other = sys.argv[1:3]
poses = np.tile([0.0, 0, 0, 0, 0, 0, 1], (300, 1))
poses[:, 0] = np.linspace(0, 3, 300)
scene = make(device)
def ask(where):
    swept = ab.sweep(model, model, poses, output="count", device=where)
    asked = scene if where == device else make(where)
    return swept.tolist(), asked.intersect(output="faces").faces.tolist()
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
CACHE = """
wp.config.kernel_cache_dir = tempfile.mkdtemp()
scene = make("cpu")
scene.batch()
kept, wp.config.kernel_cache_dir = wp.config.kernel_cache_dir, sys.argv[1]
for call in (lambda: scene.set_lods([model.lod_max - 1] * 5), lambda: scene.intersect(output="faces")):
    try:
        call()
        print("not refused")
    except Exception as error:
        print("refused", type(error).__name__)
wp.config.kernel_cache_dir = kept
faces = scene.intersect(output="faces").faces
same = np.array_equal(faces, make("cpu").intersect(output="faces").faces)
print(scene.lods.tolist() == [model.lod_max] * 5 and same and len(faces) > 50)
"""


def run(program, *arguments):
    """Return the lines that a program prints."""
    path = os.pathsep.join([str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")])
    command, environment = [sys.executable, "-c", START + program, *arguments], {**os.environ, "PYTHONPATH": path}
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_forked_child(device):
    """As PyTorch's DataLoader forks: on the CPU it answers, on a GPU it refuses in one error. The parent goes on."""
    answer, parent = run(FORK, device, device)
    if ab.Scene(device).device.is_cuda:
        assert "cannot be used in a process forked after Warp started" in answer and "spawn" in answer
        assert run(FORK, device, "cpu")[0] == "same"
    else:
        assert answer == "same"
    assert parent == "0 True"


@pytest.mark.slow
def test_a_kernel_cache_that_cannot_be_written(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("in the place of the cache")
    first, second, whole = run(CACHE, str(blocked / "cache"))
    assert first.startswith("refused") and second.startswith("refused") and whole == "True"


def test_a_real_interruption():
    """SIGINT while threads of several cores are at work: they have let go of the arrays before it is raised."""
    if core_count() < 2:
        pytest.skip("one core")
    scene = ab.Scene("cpu")
    for pose in random_poses(np.random.default_rng(6), 60, 0.5):
        scene.add(sample("torus"), pose)
    expected = scene.intersect(output="count").count
    main = threading.main_thread().ident
    for delay in np.linspace(0.001, 0.05, 12):
        timer = threading.Timer(delay, signal.pthread_kill, (main, signal.SIGINT))
        try:
            timer.start()
            for _ in range(1000):
                scene.intersect(output="count")
            time.sleep(1)
        except KeyboardInterrupt:
            pass
        timer.join()
        np.testing.assert_array_equal(scene.intersect(output="count").count, expected)
