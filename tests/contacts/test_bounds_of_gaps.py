"""Faces nearer than a gap by less than float32 tells, far from the middle of a large object: none is lost."""

import numpy as np
import pytest
import warp as wp
from helpers.nested import speck_cases
from helpers.questions import pairs_of, scene_of

from warp_abtree import testing


@pytest.mark.parametrize("warps", [False, True])
@pytest.mark.parametrize("gap", [1e-3, 3e-5])
def test_faces_a_little_nearer_than_a_gap_are_found(device, warps, gap):
    if not warps and wp.get_device(device).is_cuda:
        pytest.skip("threads are the CPU's")
    cases, distances = speck_cases(np.random.default_rng(2), 60, gap, gap)
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    with testing.regime(warps=warps):
        for part, finds in ((1 + 1e-9, True), (1 - 1e-9, False)):
            result = scene.intersect(pairs, output="contacts", gap=distances * part)
            assert not result.any.any()
            # Of both objects the first face, and no other.
            wanted = pairs[:, 0] // 2 if finds else []
            np.testing.assert_array_equal(result.contacts["pair"], wanted)
            assert (result.contacts["faces"] == 0).all()
