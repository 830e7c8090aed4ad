"""Columns of memory: what the arrays of a scene and of a query hold, and what a CUDA device has given out."""

import warp as wp


def count_bytes(holder):
    """Return the bytes of all arrays among an object's attributes."""
    return sum(value.capacity for value in vars(holder).values() if isinstance(value, wp.array))


def used_memory(device) -> dict:
    """Return columns of memory [MiB] in use on a CUDA device: Warp's pool, and all that is taken; none on the CPU."""
    if device.is_cpu:
        return {}
    wp.synchronize_device(device)
    pool = wp.get_mempool_used_mem_current(device) if wp.is_mempool_enabled(device) else 0
    taken = device.total_memory - device.free_memory
    return {"pool_mib": round(pool / 2**20, 1), "taken_mib": round(taken / 2**20, 1)}


def memory_columns(scene, query=None) -> dict:
    """Return the columns of a scene's memory [MiB], and of a query's over it; the tree of the broad phase left out."""
    trees = scene.batch().trees
    total = sum(map(count_bytes, (trees.models, trees.states, trees.objects)))
    if query is not None:
        total += count_bytes(query) + count_bytes(query.hits) + count_bytes(query.pair_batch)
        if query.broad_phase is not None:
            # Its pairs are the query's.
            total += count_bytes(query.broad_phase) - query.pairs.capacity - query.pair_count.capacity
    return {"arrays_mib": round(total / 2**20, 3)} | used_memory(scene.device)
