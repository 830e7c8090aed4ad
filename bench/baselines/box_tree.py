"""Broad phase by itself, beside a `wp.Bvh` grouped by world that is rebuilt and asked for what overlaps each box."""

import numpy as np
import trimesh
import warp as wp

import warp_abtree as ab

from ..shapes import random_directions
from ..timing import ratio_of, summarise, time_in_turn

FULL = ((16, 1), (1500, 1), (4096, 1), (8192, 2048), (8192, 128), (20_000, 1), (100_000, 1))  # objects, worlds
QUICK = ((16, 1), (64, 16))
REPEATS = {"cuda": 21, "cpu": 7}
SPACING = 1.6  # side of the cube that each box of unit size has, on average


@wp.kernel
def ask_tree_kernel(
    bvh: wp.uint64,
    lower: wp.array(dtype=wp.vec3),
    upper: wp.array(dtype=wp.vec3),
    group: wp.array(dtype=wp.int32),
    count_inout: wp.array(dtype=wp.int32),
    pairs_out: wp.array(dtype=wp.vec2i),
):
    i = wp.tid()
    j = wp.int32(0)
    query = wp.bvh_query_aabb(bvh, lower[i], upper[i], wp.bvh_get_group_root(bvh, group[i]))
    while wp.bvh_query_next(query, j):
        if j > i:
            slot = wp.atomic_add(count_inout, 0, 1)
            if slot < pairs_out.shape[0]:
                pairs_out[slot] = wp.vec2i(i, j)


class TreeBaseline:
    """What a user would write: the same boxes in a `wp.Bvh`, a thread an object; boxes are posed beforehand."""

    def __init__(self, broad_phase):
        self.found, self.group = broad_phase, broad_phase.filter.group
        self.count, self.pairs = wp.zeros_like(broad_phase.pair_count), wp.empty_like(broad_phase.pairs)
        self.bvh = wp.Bvh(broad_phase.lower, broad_phase.upper, groups=self.group)

    def launch(self):
        self.bvh.rebuild()
        self.count.zero_()
        inputs = [self.bvh.id, self.found.lower, self.found.upper, self.group, self.count, self.pairs]
        wp.launch(ask_tree_kernel, len(self.group), inputs, device=self.found.device)


def run(device, quick=False):
    """Yield a row a number of objects and worlds: ours, which poses the boxes too, and peer, the tree, in turn."""
    box = ab.Model.load(trimesh.creation.box((1, 1, 1)))
    for count, worlds in QUICK if quick else FULL:
        rng, each = np.random.default_rng(0), count // worlds
        places = rng.uniform(0, SPACING * each ** (1 / 3), (count, 3))
        scene = ab.Scene(device)
        poses = np.concatenate([places, random_directions(rng, count, 4)], 1)
        scene.add_many(box, poses, np.repeat(range(worlds), each))
        pairs = scene.broad_phase()
        ours = ab.Query(scene, "any", capacity=ab.Buffers(pairs=len(pairs))).broad_phase
        ours.launch()
        tree = TreeBaseline(ours)
        tree.launch()
        theirs = tree.pairs.numpy()[: int(tree.count.numpy()[0])].reshape(-1, 2)
        if not np.array_equal(theirs[np.lexsort(theirs.T[::-1])], pairs):
            raise RuntimeError("the tree finds other pairs")
        launches = {"ours": ours.launch, "peer": tree.launch}
        times = time_in_turn(launches, device, REPEATS["cuda" if device.is_cuda else "cpu"])
        row = {"objects": count, "worlds": worlds, "pairs": len(pairs)}
        yield row | summarise(times) | {"ratio": ratio_of(times["peer"], times["ours"])}
