"""A real Ctrl-C while threads are at work, and a kernel cache that cannot be written."""

import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from helpers.samples import random_poses, sample

import warp_abtree as ab
from warp_abtree.query.cpu_threads import core_count


def test_a_real_interruption(monkeypatch):
    """SIGINT while threads of several cores are at work: they have let go of the arrays before it is raised."""
    if core_count() < 2:
        pytest.skip("one core")
    scene = ab.Scene("cpu")
    rng = np.random.default_rng(6)
    for pose in random_poses(rng, 60, 0.5):
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


CACHE_PROGRAM = """
import sys, tempfile
import numpy as np, trimesh, warp as wp
wp.config.log_level = wp.LOG_WARNING
wp.config.kernel_cache_dir = tempfile.mkdtemp()
import warp_abtree as ab
model = ab.Model.load(trimesh.creation.torus(1.0, 0.3, 16, 8), base_faces=4)
def make():
    scene = ab.Scene("cpu")
    for k in range(3):
        scene.add(model, pose=(0.3 * k, 0.1, 0, 0, 0, 0, 1))
    return scene
scene = make()
scene.batch()
kept, wp.config.kernel_cache_dir = wp.config.kernel_cache_dir, sys.argv[1]
for call in (lambda: scene.set_lods([model.lod_max - 1] * 3), lambda: scene.intersect(output="faces")):
    try:
        call()
        print("not refused")
    except Exception as error:
        print("refused", type(error).__name__)
wp.config.kernel_cache_dir = kept
lods, faces = scene.lods.tolist(), scene.intersect(output="faces").faces
print(lods == [model.lod_max] * 3 and np.array_equal(faces, make().intersect(output="faces").faces) and len(faces) > 50)
"""


@pytest.mark.slow
def test_a_kernel_cache_that_cannot_be_written(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("in the place of the cache")
    command = [sys.executable, "-c", CACHE_PROGRAM, str(blocked / "cache")]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=300, env={**os.environ, "PYTHONPATH": os.getcwd()}
    )
    lines = done.stdout.split("\n")
    assert done.returncode == 0, done.stderr
    assert lines[0].startswith("refused") and lines[1].startswith("refused") and lines[2] == "True", done.stdout
