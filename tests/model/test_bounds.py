"""A traversal reads the nodes of its trees alone: beyond them lie records that lead it far out of memory."""

import subprocess
import sys

import pytest
from conftest import ROOT

CODE = """
import numpy as np
import trimesh
import warp as wp

import warp_abtree as ab

ball = trimesh.creation.icosphere(2)
scene = ab.Scene("cpu")
scene.add(ab.Model.from_arrays(ball.vertices, ball.faces))
scene.add(ab.Model.from_arrays(np.array([[-99.0, -99, 0], [99, -99, 0], [0, 99, 0]]), [[0, 1, 2]]))
states = scene.batch().states.pool
nodes = states.node_box.numpy()
poison = np.full((4096, 4), 2**29 + 12345, np.int32).view(np.float32)
states.node_box = wp.array(np.concatenate([nodes, poison]), dtype=wp.vec4, device="cpu")
query = ab.Query(scene, "faces", pairs=[(0, 1)])
poses = np.tile(np.eye(4), (2, 1, 1))
for z in np.linspace(-0.9, 0.9, 40):
    poses[0, :3, 3] = z / 3, 0, z
    scene.set_poses(poses)
    assert query.run().any.all()
"""


@pytest.mark.slow
def test_nothing_beyond_the_nodes_is_read():
    """In a process of its own: reading there ends it."""
    done = subprocess.run([sys.executable, "-c", CODE], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
