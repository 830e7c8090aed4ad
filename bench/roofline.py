"""Bytes and operations of a query of face pairs, counted from its result's counters, beside what the device can do.

Counted is what the algorithm cannot do without, so every fraction of a peak is a lower bound: real additions,
subtractions, multiplications, comparisons (a fused multiply-add is two), and bytes requested of memory, cached or not.

* node test (search/item.py): four child pairs load four records of 32 bytes, pose four boxes and compare each pair:
  2 (45 + 39) + 4 * 22 = 256, so 64 operations and 32 bytes a test.
* triangle test (kernels/triangle/float32_filter.py): 2 corner triples in 16 bytes, 6 vertices of 16; 72 operations to
  scale and pose corners, 68 for a plane and three signs, where most pairs end. An intersecting pair takes a second
  plane and two more signs of 42 each: 152 more.
* float64 test (kernels/triangle/float64_filter.py): 2 corner triples and 6 vertices of 24 bytes; 63 operations to pose
  three, and at least one plane, 18, and three signs of 16 each, in float64.
* exact test: the same again, and 244 for at least one sign in double words (kernels/exact/double_word.py).
* an object pair: a relative pose of 200 bytes, written and read; a hit: 12 bytes.
"""

import numpy as np

# Bytes, float32 and float64 operations of a test.
TESTS = {
    "node_tests": (32, 64, 0),
    "triangle_tests": (2 * 16 + 6 * 16, 72 + 68, 0),
    "float64_tests": (2 * 16 + 6 * 24, 0, 63 + 18 + 3 * 16),
    "exact_tests": (2 * 16 + 6 * 24, 0, 63 + 18 + 3 * 16 + 244),
}
COUNTERS = tuple(TESTS)
HIT_FLOPS, PAIR_BYTES, HIT_BYTES = 68 + 2 * 42, 2 * 200, 12

# Published peaks: memory [bytes/s], float32 and float64 without tensor cores [operations/s], by a part of the name.
PEAKS = {
    "H200": (4.8e12, 66.9e12, 33.5e12),
    "H100 PCIe": (2.0e12, 51.2e12, 25.6e12),
    "H100": (3.35e12, 66.9e12, 33.5e12),
    "A100": (1.555e12, 19.5e12, 9.7e12),
}


def find_peaks(device):
    """Return a device's published peaks as in `PEAKS`; None for the CPU and for a name not listed."""
    return next((peaks for name, peaks in PEAKS.items() if name in device.name), None)


def count_work(result):
    """Return bytes, float32 and float64 operations that a result's counters stand for."""
    counts = np.array([getattr(result, name).sum(dtype=np.int64) for name in COUNTERS])
    size, single, double = (counts @ np.array(list(TESTS.values()))).tolist()
    hits = int(result.count.sum(dtype=np.int64))
    size += PAIR_BYTES * len(result.pairs) + HIT_BYTES * hits
    return size, single + HIT_FLOPS * max(hits - int(counts[2]), 0), double


def roofline(result, milliseconds, peaks) -> dict:
    """Return columns: node tests a second, work, rates, and what fractions of the peaks they are."""
    seconds = 1e-3 * milliseconds
    work = count_work(result)
    row = {"node_tests_per_s": float(f"{result.node_tests.sum(dtype=np.int64) / seconds:.4g}")}
    row |= dict(zip(("bytes", "float32_ops", "float64_ops"), work, strict=True))
    row["gb_per_s"] = float(f"{1e-9 * work[0] / seconds:.4g}")
    for name, done, peak in zip(("memory", "float32", "float64"), work, peaks or ()):
        row[f"{name}_share"] = float(f"{done / peak / seconds:.3g}")
    return row
