"""The graph coloring of pairs in contact, by its kernels alone."""

import numpy as np
import pytest
import warp as wp

from warp_abtree.checks.upload import zeros_of
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.bodies import bodies as body_kernels
from warp_abtree.kernels.bodies import graph_coloring

COLORS = int(graph_coloring.COLOR_COUNT)


def color_pairs(device, pairs, dynamic, rounds):
    """Return the color of each pair, COLORS where it has none."""
    bodies = zeros_of(body_kernels.Bodies, len(dynamic), 0, device)
    bodies.motion_type.assign(np.where(dynamic, int(body_kernels.DYNAMIC), 0))
    bodies.rank.assign(np.arange(len(dynamic)))
    color = wp.full(len(pairs), COLORS, dtype=wp.int32, device=device)
    batch = PairBatch()
    batch.pairs = wp.array(pairs, dtype=wp.vec2i, device=device)
    for turn in range(COLORS * rounds):
        for kernel in (graph_coloring.bid_kernel, graph_coloring.assign_color_kernel):
            wp.launch(kernel, len(pairs), [turn, rounds, batch, color, bodies], device=device)
    return color.numpy()


@pytest.mark.parametrize("seed", [0, 1])
def test_no_moving_body_is_twice_in_a_color(device, seed):
    rng = np.random.default_rng(seed)
    pairs = np.unique(np.sort(rng.integers(0, 300, (750, 2)), axis=1), axis=0)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    dynamic = rng.uniform(size=300) < 0.9
    pairs = pairs[dynamic[pairs].any(1)]
    degree = np.bincount(pairs.ravel(), minlength=300)[dynamic].max()
    used = []
    for rounds in (1, 2, 4):
        color = color_pairs(device, pairs, dynamic, rounds)
        assert np.array_equal(color, color_pairs(device, pairs, dynamic, rounds)), "the same again"
        for c in range(COLORS):
            movers = pairs[color == c].ravel()
            movers = movers[dynamic[movers]]
            assert len(set(movers.tolist())) == len(movers)
        used.append(len(set(color.tolist())))
    # Of one round there are many; of more hardly more than there must be.
    assert degree <= used[2] <= used[1] < used[0] and used[2] <= degree + 2
