"""Tight-Inclusion's own answers to queries whose points move straight, by ipctk, which contains it.

Source: Wang et al. 2021, A large-scale benchmark and an inclusion-based algorithm for continuous collision detection.
"""

try:
    import ipctk
except ImportError:
    ipctk = None
# As its authors run their benchmark.
TOLERANCE, ITERATIONS_MAX = 1e-6, 1_000_000
AVAILABLE = ipctk is not None


def find_collisions(kind, starts, ends):
    """Return which queries of "vertex-face" or "edge-edge" it says to collide.

    Args:
        starts, ends: Points at first and at last, float64 (p, 4, 3).
    """
    inclusion = ipctk.tight_inclusion
    find = inclusion.point_triangle_ccd if kind == "vertex-face" else inclusion.edge_edge_ccd
    options = {"tolerance": TOLERANCE, "max_iterations": ITERATIONS_MAX}
    return [find(*first, *last, **options)[0] for first, last in zip(starts, ends, strict=True)]
