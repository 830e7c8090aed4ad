"""Graph coloring of pairs in contact, and their ranks among those of their bodies."""

import numpy as np
import pytest
import warp as wp

from warp_abtree.checks.upload import zeros_of
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.bodies import bodies as body_kernels
from warp_abtree.kernels.bodies import graph_coloring

COLORS = int(graph_coloring.COLOR_COUNT)


def color_pairs(device, pairs, dynamic, inactive=0):
    """Return the color of each pair, COLORS where it has none, and the bodies; the first ones are inactive."""
    bodies = zeros_of(body_kernels.Bodies, len(dynamic), 0, device)
    bodies.motion_type.assign(np.where(dynamic, int(body_kernels.DYNAMIC), 0))
    bodies.rank.assign(np.arange(len(dynamic)))
    start = np.where(np.arange(len(pairs)) < inactive, int(graph_coloring.INACTIVE), COLORS)
    color = wp.array(start, dtype=wp.int32, device=device)
    batch = PairBatch()
    batch.pairs = wp.array(pairs, dtype=wp.vec2i, device=device)
    for turn in range(COLORS):
        for kernel in (graph_coloring.bid_kernel, graph_coloring.assign_color_kernel):
            wp.launch(kernel, len(pairs), [turn, batch, color, bodies], device=device)
    return color.numpy(), bodies


@pytest.mark.parametrize("seed", [0, 1])
def test_no_moving_body_is_twice_in_a_color(device, seed):
    rng = np.random.default_rng(seed)
    pairs = np.unique(np.sort(rng.integers(0, 300, (750, 2)), axis=1), axis=0)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    dynamic = rng.uniform(size=300) < 0.9
    pairs = pairs[dynamic[pairs].any(1)]
    degree = np.bincount(pairs.ravel(), minlength=300)[dynamic].max()
    color, _bodies = color_pairs(device, pairs, dynamic)
    assert np.array_equal(color, color_pairs(device, pairs, dynamic)[0]), "the same again"
    for c in range(COLORS):
        movers = pairs[color == c].ravel()
        movers = movers[dynamic[movers]]
        assert len(set(movers.tolist())) == len(movers)
    # Hardly more than there must be, and hardly a pair without.
    assert degree <= len(set(color.tolist())) <= degree + 2 and (color == COLORS).mean() < 0.01


@pytest.mark.parametrize("inactive", [0, 7])
def test_a_pair_knows_how_many_are_relaxed_before_it(device, inactive):
    rng = np.random.default_rng(2)
    pairs = np.unique(np.sort(rng.integers(0, 120, (400, 2)), axis=1), axis=0)
    # A hub has more pairs than there are colors.
    pairs = np.concatenate([pairs[(pairs[:, 0] != pairs[:, 1]) & (pairs[:, 0] > 0)], [(0, k) for k in range(1, 60)]])
    dynamic = np.arange(120) % 10 != 5
    color, bodies = color_pairs(device, pairs, dynamic, inactive)
    order = np.argsort(color, kind="stable")
    lists = (np.concatenate([x, x]).astype(np.int32) for x in (color[order], order))
    batch, rank = PairBatch(), wp.zeros(len(pairs), dtype=wp.vec2i, device=device)
    batch.pairs, count = wp.array(pairs, dtype=wp.vec2i, device=device), wp.zeros(1, dtype=wp.int32, device=device)
    inputs = [wp.array(x, device=device) for x in lists] + [batch, bodies, rank, count]
    wp.launch(graph_coloring.rank_pairs_kernel, len(pairs), inputs, device=device)
    assert (color == COLORS).sum() > 40 and count.numpy()[0] == len(pairs) - inactive
    before = np.zeros(120, int)
    for p in order[: len(pairs) - inactive]:
        for k in np.flatnonzero(dynamic[pairs[p]]):
            assert rank.numpy()[p, k] == before[pairs[p, k]]
            before[pairs[p, k]] += 1
