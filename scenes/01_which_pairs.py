"""Intersecting pairs and their contacts: python scenes/01_which_pairs.py (docs/howto_pairs.md)."""

import numpy as np
import trimesh

import warp_abtree as ab

ring = ab.Model.load(trimesh.creation.torus(1.0, 0.3, 48, 24))  # or a file: ab.Model.load("ring.obj")
pipe = trimesh.creation.cylinder(0.35, 3.0, sections=48)
pipe.update_faces(np.abs(pipe.face_normals[:, 2]) < 0.5)  # no caps: meshes may be open

scene = ab.Scene(device="cpu")  # or "cuda:0"; without it Warp's default
scene.add(ring)  # object 0
scene.add(ring, pose=(1.0, 0, 0, 0.5**0.5, 0, 0, 0.5**0.5))  # object 1: x, y, z and a unit quaternion x, y, z, w
scene.add(ab.Model.load(pipe))  # object 2, in the hole of the first ring

pairs = scene.broad_phase()  # pairs whose boxes overlap, here all three
result = scene.intersect(pairs, output="contacts")  # or less, sooner: "any", "count", "faces"
result.check()  # raises if any work was lost
for (a, b), hit, count in zip(result.pairs, result.any, result.count):
    print(f"objects {a} and {b}:", f"{count} pairs of faces intersect" if hit else "free")
print(result.faces[:2])  # (k, 3): pair, face of its first object, face of its second, as numbered in the files
contact = result.contacts[0]  # one for each row of `faces`
print(contact["p0"], contact["p1"], contact["normal"])  # ends of the segment in which the two faces intersect
