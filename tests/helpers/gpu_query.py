"""Queries that take the paths of a GPU on every device."""

import warp_abtree as ab
from warp_abtree import testing


def GpuQuery(*arguments, **options):
    """Return a query that takes the CUDA regime on every device."""
    with testing.regime(warps=True):
        return ab.Query(*arguments, **options)
