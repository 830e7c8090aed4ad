"""Priority queue of edges: a 4-ary heap with the smallest entry first.

An entry is a float64 key and a packed edge with the stage that it has reached (`pack_pair`).
The order (key, edge) is total, so the merge sequence depends neither on the heap's layout nor on where a launch ends.
"""

import warp as wp

from warp_abtree.kernels import native

wp.set_module_options({"enable_backward": False})


@wp.struct
class Heap:
    """Entries in heap order."""

    key: wp.array(dtype=wp.float64)  # [capacity]
    pair: wp.array(dtype=wp.int64)  # [capacity], packed edge and stage


@wp.func
def pack_pair(a: int, b: int, stage: int):
    """Return an edge as one word, its lower vertex first, so that ties of keys have one order.

    63          32 31          2 1     0
    [ lower vertex | higher vertex | stage ]
    """
    low = wp.int64(wp.min(a, b))
    high = wp.int64(wp.max(a, b))
    return (low << wp.int64(32)) | (high << wp.int64(2)) | wp.int64(stage)


@wp.func
def pair_first(pair: wp.int64):
    return int(pair >> wp.int64(32))


@wp.func
def pair_second(pair: wp.int64):
    return int((pair >> wp.int64(2)) & wp.int64(0x3FFFFFFF))


@wp.func
def pair_stage(pair: wp.int64):
    return int(pair & wp.int64(3))


@wp.func
def heap_before(key_a: wp.float64, pair_a: wp.int64, key_b: wp.float64, pair_b: wp.int64):
    return key_a < key_b or (key_a == key_b and pair_a < pair_b)


@native.func_native(cpu=True)
def fetch_entries(heap: Heap, child: wp.int32):
    """Prefetch the children of four entries into the caches of this core."""


@wp.func
def sift_down(heap: Heap, size: int, start: int, key: wp.float64, pair: wp.int64):
    """Put (key, pair) into the hole at `start`, whose subtrees are heaps."""
    hole = start
    child = 4 * hole + 1
    while child < size:
        fetch_entries(heap, child)
        best = child
        best_key = heap.key[child]
        best_pair = heap.pair[child]
        end = wp.min(child + 4, size)
        i = child + 1
        while i < end:
            if heap_before(heap.key[i], heap.pair[i], best_key, best_pair):
                best = i
                best_key = heap.key[i]
                best_pair = heap.pair[i]
            i += 1
        if heap_before(key, pair, best_key, best_pair):
            child = size
        else:
            heap.key[hole] = best_key
            heap.pair[hole] = best_pair
            hole = best
            child = 4 * hole + 1
    heap.key[hole] = key
    heap.pair[hole] = pair


@wp.func
def heap_push(heap: Heap, size: int, key: wp.float64, pair: wp.int64):
    """Insert an entry at the end and lift it; return the new size."""
    hole = size
    moving = bool(True)
    while moving and hole > 0:
        up = (hole - 1) // 4
        if heap_before(key, pair, heap.key[up], heap.pair[up]):
            heap.key[hole] = heap.key[up]
            heap.pair[hole] = heap.pair[up]
            hole = up
        else:
            moving = bool(False)
    heap.key[hole] = key
    heap.pair[hole] = pair
    return size + 1


@wp.func
def heap_drop_top(heap: Heap, size: int):
    """Remove the smallest entry; return the new size."""
    last = size - 1
    if last > 0:
        sift_down(heap, last, 0, heap.key[last], heap.pair[last])
    return last
