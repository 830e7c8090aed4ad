"""Levels of detail: python scenes/04_which_lod.py (docs/howto_lod.md)."""

import trimesh

import warp_abtree as ab

model = ab.Model.load(trimesh.creation.torus(1.0, 0.3, 96, 48))
scene = ab.Scene(device="cpu")
scene.add(model)
scene.add(model, pose=(0.5, 0, 0, 0.5**0.5, 0, 0, 0.5**0.5))

lods = [model.lod_max, model.lod_for(fraction=0.1), model.lod_for(tolerance=0.05), 0]  # the original to the base
results = []
for lod in lods:
    scene.set_lods([lod, lod])  # at any time; only what changes is refitted
    results.append(scene.intersect([(0, 1)], output="faces"))
    faces, error = len(model.mesh_at(lod)[1]), model.error_at(lod)  # no point of the original is farther away
    print(f"LOD {lod}: {faces} faces, error {error:.3g}, {results[-1].count[0]} face pairs")

coarse = lods[2]
scene.set_poses([(0, 0, 0, 0, 0, 0, 1), (0, 0, 1.0, 0, 0, 0, 1)])
scene.set_lods([coarse, coarse])
answer = scene.intersect([(0, 1)], within=2 * model.error_at(coarse))
print(answer.any, answer.apart)  # [False] [ True]: the originals, too, are proved apart
