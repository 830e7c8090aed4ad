"""Queries that take the paths of a GPU on every device."""

import warp_abtree as ab


class GpuQuery(ab.Query):
    """A query that takes the CUDA regime on every device."""

    def uses_warps(self):
        return True
