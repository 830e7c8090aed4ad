"""Sorts on a device: Warp's errors, which it only prints, do not pass as results."""

import ctypes

import numpy as np
import pytest
import warp as wp

from warp_abtree.checks import radix_sort


@pytest.mark.parametrize("failures", [0, 1, radix_sort.ATTEMPTS])
def test_a_sort_that_fails_is_repeated_then_an_error(device, monkeypatch, failures):
    numbers = np.random.default_rng(0).permutation(64)
    keys = wp.array(np.tile(numbers, 2), dtype=wp.int64, device=device)
    values = wp.array(np.tile(numbers, 2), dtype=wp.int32, device=device)
    sort, left = wp.utils.radix_sort_pairs, [failures]

    def fail(*args, **options):
        left[0] -= 1
        if left[0] < 0:
            sort(*args, **options)
        else:
            ctypes.memmove(radix_sort._error_address(), b"no device\0", 10)

    monkeypatch.setattr(wp.utils, "radix_sort_pairs", fail)
    if failures == radix_sort.ATTEMPTS:
        with pytest.raises(RuntimeError, match=f"64 numbers on {device} were not sorted: no device"):
            radix_sort.radix_sort(keys, values, 64, 7)
        return
    radix_sort.radix_sort(keys, values, 64, 7)
    np.testing.assert_array_equal(keys.numpy()[:64], np.arange(64))
    np.testing.assert_array_equal(values.numpy()[:64], np.arange(64))
