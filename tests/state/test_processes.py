"""A process in trouble: a real Ctrl-C while threads work, and a fork after queries."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.scenes import add_objects

import warp_abtree as ab
from warp_abtree.checks.cpu_threads import core_count

FORK = """
import os, sys
import numpy as np, trimesh, warp as wp
wp.config.log_level = wp.LOG_WARNING
import warp_abtree as ab
model = ab.Model.load(trimesh.creation.torus(1.0, 0.3, 24, 12), base_faces=4)
def make(device):
    scene = ab.Scene(device)
    for k in range(5):
        scene.add(model, pose=(0.4 * k, 0.1, 0, 0, 0, 0, 1))
    return scene
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


def run(*devices):
    """Return what a forked child says that asks on the other device, and then its parent."""
    path = os.pathsep.join([str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")])
    options = {"capture_output": True, "text": True, "timeout": 300, "env": {**os.environ, "PYTHONPATH": path}}
    done = subprocess.run([sys.executable, "-c", FORK, *devices], **options)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_forked_child(device):
    """As PyTorch's DataLoader forks: on the CPU it answers, on a GPU it refuses in one error. The parent goes on."""
    answer, parent = run(device, device)
    if ab.Scene(device).device.is_cuda:
        assert "cannot be used in a process forked after Warp started" in answer and "spawn" in answer
        assert run(device, "cpu")[0] == "same"
    else:
        assert answer == "same"
    assert parent == "0 True"


def test_a_real_interruption():
    """SIGINT while threads of several cores are at work: they have let go of the arrays before it is raised."""
    if core_count() < 2:
        pytest.skip("one core")
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        pytest.skip("SIGINT is ignored, as in the background of a shell")
    scene = add_objects("cpu", ["torus"] * 60, seed=6, spread=0.5)
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
