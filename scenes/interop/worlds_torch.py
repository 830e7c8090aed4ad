"""PyTorch searches many worlds at once for the pose that puts a ring on a peg; contacts are asked without copies.

In each world a ring is to come down on its own peg, which stands aslant. PyTorch proposes poses by the cross-entropy
method, `PoseInput` places the rings from the tensors' memory, `Query` tells which collide, and PyTorch reads its answer
where it lies. Needs PyTorch (pip install torch):

    python scenes/interop/worlds_torch.py [--device cuda:0] [--worlds 64] [--samples 64] [--rounds 20]
"""

import argparse
import time

import numpy as np
import trimesh
import warp as wp

import warp_abtree as ab


def quaternion_of(turn):
    """Return quaternions x y z w of rotation vectors, tensors (..., 3) to (..., 4)."""
    import torch

    angle = turn.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    return torch.cat([torch.sin(angle / 2) * turn / angle, torch.cos(angle / 2)], -1)


def make_scene(worlds, samples, device):
    """Return a scene of a peg a world and rings, and the pairs (peg, ring) to ask."""
    peg = ab.Model.load(trimesh.creation.cylinder(0.3, 2.0, sections=24).subdivide())
    ring = ab.Model.load(trimesh.creation.torus(0.5, 0.1, 32, 16))
    scene = ab.Scene(device)
    for world in range(worlds):
        scene.add(peg, world=world, static=True)
    for world in range(worlds):
        for _ in range(samples):
            scene.add(ring, world=world)
    pairs = np.stack([np.repeat(np.arange(worlds), samples), worlds + np.arange(worlds * samples)], 1)
    return scene, pairs


def main(words=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default=None)
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--samples", type=int, default=64, help="proposals a world and round")
    parser.add_argument("--rounds", type=int, default=20)
    arguments = parser.parse_args(words)
    try:
        import torch
    except ImportError:
        raise SystemExit("skipped: this example needs PyTorch (pip install torch)") from None
    worlds, samples = arguments.worlds, arguments.samples
    scene, pairs = make_scene(worlds, samples, arguments.device)
    place = wp.device_to_torch(scene.device)
    random = torch.Generator(place).manual_seed(0)

    def noise(*shape):
        return torch.randn(*shape, generator=random, device=place, dtype=torch.float64)

    placing, query = ab.PoseInput(scene), ab.Query(scene, "any", pairs=pairs)
    poses, hit = wp.to_torch(placing.poses), wp.to_torch(query.hits.any_hit)  # views of the same memory
    slant = 0.15 * noise(worlds, 3)
    poses[:worlds] = torch.cat([torch.zeros(worlds, 3, device=place), quaternion_of(slant)], 1)
    mean = torch.tensor([0.0, 0, 1.5, 0, 0, 0], dtype=torch.float64, device=place).repeat(worlds, 1)
    spread = torch.tensor([0.3, 0.3, 0.5, 0.3, 0.3, 0.3], dtype=torch.float64, device=place).repeat(worlds, 1)
    elite = max(2, samples // 8)
    start = time.perf_counter()
    for number in range(arguments.rounds):
        tried = mean[:, None] + spread[:, None] * noise(worlds, samples, 6)
        poses[worlds:, :3] = tried[..., :3].reshape(-1, 3)
        poses[worlds:, 3:] = quaternion_of(tried[..., 3:]).reshape(-1, 4)
        placing.launch()
        query.launch()
        collides = hit[: len(pairs)].reshape(worlds, samples) != 0
        # As deep as may be, near the axis, and free.
        cost = tried[..., 2].abs() + 0.5 * tried[..., :2].norm(dim=-1) + 1e3 * collides
        best = cost.argsort(1)[:, :elite]
        chosen = tried.gather(1, best[..., None].expand(-1, -1, 6))
        mean, spread = chosen.mean(1), chosen.std(1) + 0.02
        on = (cost.min(1).values < 0.25).sum()
        if number % 5 == 4 or number == arguments.rounds - 1:
            share = collides.double().mean()
            print(f"round {number + 1:3d}: {int(on):4d} of {worlds} rings on their pegs, {share:.0%} of proposals hit")
    placing.check()
    seconds = time.perf_counter() - start
    print(f"{arguments.rounds * len(pairs) / seconds:,.0f} proposals a second, PyTorch's part included")
    return poses.clone(), hit[: len(pairs)] != 0


if __name__ == "__main__":
    main()
