"""Gradients: python scenes/07_place_without_overlap.py moves things of 64 worlds apart (docs/howto_gradients.md)."""

import numpy as np
import trimesh

import warp_abtree as ab

bowl, mug, plate, bottle = (  # outlines, turned about z
    [(0, 0), (0.5, 0.1), (0.9, 0.5), (0.8, 0.5), (0.45, 0.2), (0, 0.1), (0, 0)],
    [(0, 0), (0.45, 0), (0.5, 0.05), (0.5, 1), (0.42, 1), (0.42, 0.1), (0, 0.1), (0, 0)],
    [(0, 0), (0.7, 0), (1, 0.15), (1, 0.2), (0.65, 0.08), (0, 0.08), (0, 0)],
    [(0, 0), (0.35, 0), (0.35, 0.9), (0.12, 1.2), (0.12, 1.5), (0, 1.5), (0, 0)],
)
meshes = [trimesh.creation.revolve(np.array(line, float), sections=24) for line in (bowl, mug, plate, bottle)]
meshes += [trimesh.creation.box((1.2, 0.8, 0.25)), trimesh.creation.torus(0.5, 0.15, 24, 12)]
meshes += [trimesh.creation.icosphere(2, 0.3), trimesh.creation.annulus(0.25, 0.45, 0.4, sections=24)]
models = [ab.Model.load(mesh.subdivide_to_size(0.35)) for mesh in meshes]  # depths are of corners and the like
rng, worlds, margin, size = np.random.default_rng(0), 64 if __name__ == "__main__" else 2, 0.05, len(models)
poses = np.hstack([rng.uniform(-1, 1, (worlds * size, 3)), np.tile([0.0, 0, 0, 1], (worlds * size, 1))])
scene, first = ab.Scene(device="cpu"), poses
scene.add_many(models * worlds, poses, worlds=np.repeat(np.arange(worlds), size), solids=True)
pairs = np.stack(np.triu_indices(size, 1), 1) + size * np.arange(worlds)[:, None, None]
query = ab.DistanceQuery(scene, pairs.reshape(-1, 2), signed=True, beyond=margin)
for step in range(400):
    found = query.run()
    loss = np.maximum(margin - found.distance, 0)  # its gradient is minus that of the distance, or 0
    left = loss.reshape(worlds, -1).sum(1)
    if step % 20 == 0 or not left.any():
        print(f"step {step}: loss {left.sum():.3f}, {(left == 0).sum()} of {worlds} worlds are free")
    if not left.any():
        break
    slope = np.zeros((worlds * size, 6))
    np.add.at(slope, found.pairs[loss > 0], -found.gradient[loss > 0])
    square = (slope.reshape(worlds, -1) ** 2).sum(1)  # for steps of Polyak's length, in each world its own
    slope *= np.repeat(1.5 * left / np.maximum(square, 1e-9), size)[:, None] * [1, 1, 1, 0.5, 0.5, 0.5]
    poses, turn, axis, real = scene.poses, -slope[:, 3:] / 2, scene.poses[:, 3:6], scene.poses[:, 6:]
    poses[:, :3] += 0.01 * rng.normal(size=slope[:, :3].shape) * np.repeat(left > 0, size)[:, None] - slope[:, :3]
    poses[:, 3:] += np.concatenate([turn * real + np.cross(turn, axis), -(turn * axis).sum(1, keepdims=True)], 1)
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    scene.set_poses(poses)
