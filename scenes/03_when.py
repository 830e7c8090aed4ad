"""First contacts of moving objects: python scenes/03_when.py (docs/howto_motion.md)."""

import numpy as np
import trimesh

import warp_abtree as ab

ring = ab.Model.load(trimesh.creation.torus(1.0, 0.3))
ball = ab.Model.load(trimesh.creation.icosphere(subdivisions=3, radius=0.4))
starts = np.array([[0, 0, 0, 0, 0, 0, 1], [0, 0, 2, 0, 0, 0, 1], [1.1, 0, 2, 0, 0, 0, 1]])
ends = np.array([[0, 0, 0, 0, 0, 0, 1], [0, 0, -2, 0, 0, 0.6, 0.8], [1.1, 0, -2, 0, 0, 0.6, 0.8]])

scene = ab.Scene(device="cpu")
scene.add(ring)
scene.add(ball, pose=starts[1])  # above the hole
scene.add(ball, pose=starts[2])  # above the ring

result = scene.first_contact([(0, 1), (0, 2)], ends)  # from where objects stand, to `ends`
print(result.clear)  # [ True False]: through the hole, and into the ring
print(result.time)  # 1 where clear; else never late, and early by `tolerance` at most
print(result.undecided)  # [False False]
