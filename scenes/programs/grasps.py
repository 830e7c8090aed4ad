"""Grasps of a two-finger gripper on a mug: which poses are free, and what the fingers hold when they have closed.

python scenes/programs/grasps.py draws the narrowest one to grasps.png (docs/programs.md).
"""

import numpy as np
import trimesh

import warp_abtree as ab
from warp_abtree.app import picture

OPEN, THICK, DEEP = 0.05, 0.012, 0.02  # of a finger: way to the middle, thickness, reach beyond the surface [m]


def make_meshes():
    """Return mug, palm and finger [m]; the gripper's frame lies between the tips and points along its z."""
    floor = trimesh.creation.cylinder(0.036, 0.006).apply_translation((0, 0, -0.047))
    handle = trimesh.creation.torus(
        0.03, 0.006, transform=trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0))
    )
    body = [trimesh.creation.annulus(0.035, 0.04, 0.1), floor, handle.apply_translation((0.06, 0, 0))]
    palm = trimesh.creation.box((0.14, 0.04, 0.03), metadata={"name": "palm"}).apply_translation((0, 0, -0.075))
    return (
        trimesh.util.concatenate(body),
        palm,
        trimesh.creation.box((THICK, 0.02, 0.06), metadata={"name": "finger"}).apply_translation((0, 0, -0.03)),
    )


def sample_poses(count, mesh):
    """Return poses (count, 4, 4) from any direction, whose tips are DEEP beyond random points of a surface."""
    frames = np.linalg.qr(np.random.default_rng(0).normal(size=(count, 3, 3)))[0]
    frames *= np.sign(np.linalg.det(frames))[:, None, None]
    points, poses = trimesh.sample.sample_surface(mesh, count, seed=0)[0], np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = frames, points + DEEP * frames[:, :, 2]
    return poses


def main(count=20_000, png="grasps.png", device=None):
    meshes = make_meshes()
    (mug, palm, finger), poses = map(ab.Model.load, meshes), sample_poses(count, meshes[0])
    free, closed = ~ab.sweep(mug, palm, poses, device=device), []
    for side in (-1, 1):  # each finger moves from where it is open to the middle, until it touches
        start = poses.copy()
        start[:, :3, 3] += side * OPEN * poses[:, :3, 0]
        found = ab.sweep(mug, finger, start, end_poses=poses, output="first_contact", device=device)
        free &= found["time"] > 0
        closed.append(side * OPEN * (1 - found["time"]))
    width = np.where(free, closed[1] - closed[0] - THICK, np.nan)
    print(f"{free.sum():,} of {len(poses):,} poses are free; the fingers hold {1e3 * np.nanmin(width):.1f} mm and more")
    best, scene = np.nanargmin(width), ab.Scene(device)
    scene.add_many([mug, palm], [np.eye(4), poses[best]], names=["mug", "palm"])
    for way in closed:
        scene.add(finger, poses[best] @ trimesh.transformations.translation_matrix((way[best], 0, 0)))
    picture(scene, png)
    return poses, free, width


if __name__ == "__main__":
    main()
