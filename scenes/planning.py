"""A gripper reaches into a full bin at 100,000 poses: which of them are free, and which of these by a free way.

A way is an edge of a planner: from above the bin straight down to the pose, turning by a quarter. It is proved free as
a whole, not at points of it. All meshes are made here, the bin and what lies in it as one:

    python scenes/planning.py [--device cuda:0] [--poses 100000] [--glb grasp.glb]
"""

import argparse
import time

import numpy as np
import trimesh

import warp_abtree as ab


def boxes(*placed):
    """Return boxes of (extents, middle) as one mesh; they may overlap, nothing is cut."""
    parts = []
    for extents, middle in placed:
        part = trimesh.creation.box(extents)
        part.apply_translation(middle)
        parts.append(part)
    return trimesh.util.concatenate(parts)


def make_gripper(opening=0.08, fine=3):
    """Return a parallel gripper [m]: two fingers that point along -z from a palm, a wrist above; tool point at 0."""
    side = 0.5 * opening + 0.01
    hand = boxes(
        ((0.02, 0.025, 0.06), (side, 0, 0.03)),
        ((0.02, 0.025, 0.06), (-side, 0, 0.03)),
        ((opening + 0.06, 0.05, 0.05), (0, 0, 0.085)),
    )
    wrist = trimesh.creation.cylinder(0.03, 0.16, sections=32)
    wrist.apply_translation((0, 0, 0.19))
    gripper = trimesh.util.concatenate([hand, wrist])
    for _ in range(fine):
        gripper = gripper.subdivide()
    return gripper


def make_bin(parts=40, seed=0):
    """Return a bin [m] with rings, pipes and balls strewn in it, as one surface."""
    wide, deep, high, wall = 0.6, 0.4, 0.2, 0.01
    tray = boxes(
        ((wide, deep, wall), (0, 0, -0.5 * wall)),
        *(((wall, deep, high), (x, 0, 0.5 * high)) for x in (-0.5 * wide, 0.5 * wide)),
        *(((wide, wall, high), (0, y, 0.5 * high)) for y in (-0.5 * deep, 0.5 * deep)),
    )
    kinds = (
        trimesh.creation.torus(0.03, 0.01, 32, 16),
        trimesh.creation.annulus(0.012, 0.02, 0.06, sections=32),
        trimesh.creation.icosphere(subdivisions=3, radius=0.02),
    )
    rng = np.random.default_rng(seed)
    strewn = [tray]
    for k in range(parts):
        part = kinds[k % len(kinds)].copy()
        part.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
        low, reach = -part.bounds[0, 2], np.array([0.5 * wide - 0.05, 0.5 * deep - 0.05, 0.04])
        part.apply_translation(rng.uniform([-1, -1, 0], 1, 3) * reach + [0, 0, low])
        strewn.append(part)
    return trimesh.util.concatenate(strewn)


def sample_grasps(count, seed=1):
    """Return poses of the gripper over the bin, from above, tilted by up to 30 degrees, float64 (count, 7)."""
    rng = np.random.default_rng(seed)
    position = rng.uniform([-0.28, -0.18, 0.0], [0.28, 0.18, 0.15], (count, 3))
    tilt, way, turn = rng.uniform([0, 0, 0], [np.pi / 6, 2 * np.pi, np.pi], (count, 3)).T
    # A turn about z, then a tilt about a horizontal axis: the product of two quaternions, x y z w.
    x, y, w = np.sin(tilt / 2) * np.cos(way), np.sin(tilt / 2) * np.sin(way), np.cos(tilt / 2)
    s, c = np.sin(turn / 2), np.cos(turn / 2)
    return np.concatenate([position, np.stack([x * c + y * s, y * c - x * s, w * s, w * c], 1)], 1)


def raise_poses(poses, height=0.4):
    """Return poses over the bin, each turned by a quarter about z, float64 (n, 7)."""
    x, y, z, w = poses[:, 3:].T
    s = c = np.sqrt(0.5)
    turned = np.stack([x * c - y * s, y * c + x * s, z * c + w * s, w * c - z * s], 1)
    return np.concatenate([poses[:, :2], poses[:, 2:3] + height, turned], 1)


def check_ways(full, gripper, poses, device):
    """Return which poses are reached from above by ways that are proved free, bool (n,)."""
    above = raise_poses(poses)
    rows = ab.sweep(full, gripper, above, end_poses=poses, output="first_contact", tolerance=1e-4, device=device)
    blocked = ~rows["clear"] & ~rows["undecided"]
    print(f"{int(rows['clear'].sum()):,} of {len(poses):,} ways from above are proved free,", end=" ")
    print(f"{int(blocked.sum()):,} are blocked, {int(rows['undecided'].sum()):,} undecided")
    return rows["clear"]


def main(words=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default=None)
    parser.add_argument("--poses", type=int, default=100_000)
    parser.add_argument("--parts", type=int, default=40, help="things in the bin")
    parser.add_argument("--glb", help="write the deepest free pose to this file")
    arguments = parser.parse_args(words)
    bin_mesh, gripper_mesh = make_bin(arguments.parts), make_gripper()
    # The finest LOD is all that is asked, so no collapses are made.
    full = ab.Model.load(bin_mesh, base_faces=len(bin_mesh.faces))
    gripper = ab.Model.load(gripper_mesh, base_faces=len(gripper_mesh.faces))
    poses = sample_grasps(arguments.poses)
    ab.sweep(full, gripper, poses[:100], device=arguments.device)  # loads the kernels
    start = time.perf_counter()
    hit = ab.sweep(full, gripper, poses, device=arguments.device)
    seconds = time.perf_counter() - start
    print(f"bin of {full.face_count:,} faces, gripper of {gripper.face_count:,}")
    print(f"{len(poses):,} poses in {seconds:.2f} s: {len(poses) / seconds:,.0f} a second")
    free = np.flatnonzero(~hit)
    print(f"{len(free):,} are free ({len(free) / len(poses):.1%})")
    start = time.perf_counter()
    free = free[check_ways(full, gripper, poses[free], arguments.device)]
    print(f"in {time.perf_counter() - start:.2f} s, kernels loaded in it if they were not")
    if len(free) and arguments.glb:
        best = free[poses[free, 2].argmin()]
        scene = ab.Scene(arguments.device)
        scene.add(full)
        scene.add(gripper, poses[best])
        ab.to_trimesh(scene, names=["bin", "gripper"]).export(arguments.glb)
        print(f"wrote {arguments.glb}: pose {best}, its tool point {1e3 * poses[best, 2]:.1f} mm above the floor")
    return hit


if __name__ == "__main__":
    main()
