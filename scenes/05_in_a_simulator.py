"""In a simulator, contacts of many worlds: python scenes/05_in_a_simulator.py (docs/howto_simulator.md)."""

import numpy as np
import trimesh

import warp_abtree as ab

worlds, rings, step = 6, 4, 0.01
peg = trimesh.creation.cylinder(0.3, 2.4, sections=24)
plate = trimesh.creation.box((2.4, 2.4, 0.2), trimesh.transformations.translation_matrix((0, 0, -1.2)))
ring = ab.Model.load(trimesh.creation.torus(0.6, 0.2, 24, 12))

poses = np.tile([0.0, 0, 0, 0, 0, 0, 1], (1 + worlds * rings, 1))
poses[1:, :2] = np.random.default_rng(0).uniform(-0.04, 0.04, (worlds * rings, 2))
poses[1:, 2] = np.tile(0.7 * np.arange(rings) - 0.4, worlds)
scene = ab.Scene(device="cpu")
scene.add(ab.Model.load(trimesh.util.concatenate([peg, plate])), world=-1, static=True)  # object 0, in every world
scene.add_many(ring, poses[1:], worlds=np.repeat(np.arange(worlds), rings))

pose_input = ab.PoseInput(scene)
query = ab.ContactQuery(scene, gap=step, capacity=ab.Buffers(hits=20_000))  # allocates once, grows never
for _ in range(150):
    pose_input.launch(poses)  # also arrays on the device, of PyTorch, JAX or CuPy
    query.launch()  # both only launch: beside a solver on the device they go into its CUDA graph
    found = query.result()
    found.check()  # raises if there were more contacts
    pose_input.check()  # and if a pose was none, of an object that then stayed where it was
    room = np.full(len(poses), step)  # in the place of a solver: each ring falls as far as it is apart
    upper = found.pairs[found.contacts["pair"], 1]  # of a pair of rings the second is above
    np.minimum.at(room, upper, np.maximum(found.contacts["separation"], 0))
    poses[1:, 2] -= room[1:]
print(len(found.contacts), "contacts in", worlds, "worlds")
print(np.round(poses[1:, 2].reshape(worlds, rings)[:3], 2))  # heights: stacked on the plate
