"""Bytes and operations of a query, counted from its result's counters, beside what the device can do.

Counted is what the algorithm cannot do without, so every fraction of a peak is a lower bound: real additions,
subtractions, multiplications, comparisons (a fused multiply-add is two), and bytes requested of memory, cached or not.

* node test (kernels/traversal): four child pairs load four records of 32 bytes, pose four boxes: 6 operations for sum
  and size, 18 for the image of the sum, 15 for that of the size; 6 more widen each of A's two. A comparison is 6
  subtractions, 6 additions, 6 comparisons, and 4 to choose what follows. In all 2 (45 + 39) + 4 * 22 = 256, so 64
  operations and 32 bytes a test. (Two child pairs take the same work for half as many tests.)
* triangle test (kernels/triangle/float32_filter.py): 2 corner triples in 16 bytes, 6 vertices of 16; 18 operations to
  scale six corners and 54 to pose three. A plane and three signs: 15 for differences, 9 for the normal, 10 for sizes of
  vectors and 2 for the largest, 11 for the bound, 15 for dot products, 6 for signs, 68 in all. Most pairs end there.
  An intersecting pair takes a second plane and two more signs of 42 each: 152 more.
* float64 test (kernels/triangle/float64_filter.py): 2 corner triples and 6 vertices of 24 bytes; 63 operations to pose
  three, and at least one plane, 18, and three signs of 16 each, in float64.
* exact test: the same again, and at least one sign in double words (kernels/arithmetic/double_word.py): 54 for
  differences, 120 for minors, 30 and 40 for the rest.
* an object pair: a relative pose of 200 bytes, written and read; a hit: 12 bytes.
* update (kernels/update): an entry of a slice reads its face and that face's leaf, 8 bytes, and writes the face's
  corners, 16. A node is appended to a work list and read from there, 16 bytes, its face number is read and its status
  written, 8, and its record written, 32. A leaf reads its corners and three vertices of 24 bytes, 88, an inner node the
  records of its children, 64. Walks up the forest and atomics are left out.
"""

import numpy as np

COUNTERS = ("node_tests", "triangle_tests", "float64_tests", "exact_tests")
NODE_BYTES, NODE_FLOPS = 32, 64
TRIANGLE_BYTES, TRIANGLE_FLOPS, HIT_FLOPS = 2 * 16 + 6 * 16, 18 + 54 + 68, 68 + 2 * 42
FLOAT64_BYTES, FLOAT64_FLOPS = 2 * 16 + 6 * 24, 63 + 18 + 3 * 16
EXACT_BYTES, EXACT_FLOPS = FLOAT64_BYTES, FLOAT64_FLOPS + 54 + 120 + 30 + 40
PAIR_BYTES, HIT_BYTES = 2 * 200, 12
ENTRY_BYTES, REFIT_BYTES, LEAF_BYTES, INNER_BYTES = 8 + 16, 16 + 8 + 32, 16 + 3 * 24, 2 * 32

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
    nodes, triangles, doubles, exact = (int(getattr(result, name).sum(dtype=np.int64)) for name in COUNTERS)
    hits = int(result.any.sum() if result.count is None else result.count.sum(dtype=np.int64))
    written = hits if result.faces is not None else 0
    size = NODE_BYTES * nodes + TRIANGLE_BYTES * triangles + FLOAT64_BYTES * doubles + EXACT_BYTES * exact
    size += PAIR_BYTES * len(result.pairs) + HIT_BYTES * written
    single = NODE_FLOPS * nodes + TRIANGLE_FLOPS * triangles + HIT_FLOPS * max(hits - doubles, 0)
    return size, single, FLOAT64_FLOPS * doubles + EXACT_FLOPS * exact


def roofline(result, milliseconds, peaks) -> dict:
    """Return columns: node tests a second, work, rates, and what fractions of the peaks they are.

    floor_ms is the time that the scarcest of the three would take if it alone were at its peak all the time.
    """
    seconds = 1e-3 * milliseconds
    size, single, double = count_work(result)
    row = {
        "node_tests_per_s": float(f"{result.node_tests.sum(dtype=np.int64) / seconds:.4g}"),
        "bytes": size,
        "float32_ops": single,
        "float64_ops": double,
        "ops_per_byte": round((single + double) / size, 2),
        "gb_per_s": float(f"{1e-9 * size / seconds:.4g}"),
        "gflop_per_s": float(f"{1e-9 * (single + double) / seconds:.4g}"),
    }
    if peaks is not None:
        floors = [work / peak for work, peak in zip((size, single, double), peaks, strict=True)]
        for name, floor in zip(("memory", "float32", "float64"), floors, strict=True):
            row[f"{name}_share"] = float(f"{floor / seconds:.3g}")
        row["floor_ms"] = float(f"{1e3 * max(floors):.4g}")
    return row


def update_roofline(changed, refitted, entries, milliseconds, peaks) -> dict:
    """Return columns of an update: nodes refitted a second, bytes, their rate and their fraction of the peak.

    Args:
        changed: k, the leaves among the nodes refitted.
        entries: Faces in the slices between the LODs, repeats included.
    """
    seconds = 1e-3 * milliseconds
    size = ENTRY_BYTES * entries + REFIT_BYTES * refitted + LEAF_BYTES * changed + INNER_BYTES * (refitted - changed)
    row = {"nodes_per_s": float(f"{refitted / seconds:.4g}"), "bytes": size}
    row["gb_per_s"] = float(f"{1e-9 * size / seconds:.4g}")
    if peaks is not None:
        row["memory_share"] = float(f"{size / peaks[0] / seconds:.3g}")
        row["floor_ms"] = float(f"{1e3 * size / peaks[0]:.4g}")
    return row
