"""Chunks: contacts of one object pair that are summed together, in places that its first contact tells."""

import warp as wp

from warp_abtree.kernels import native

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

CHUNK = native.constant("CHUNK")


@wp.func
def first_chunk(p: wp.int32, start: wp.array(dtype=wp.int32)):
    """Return the place of a pair's first chunk: each pair before has at most one chunk more than whole ones fit."""
    return start[p] // CHUNK + p


@wp.func
def end_chunk(p: wp.int32, start: wp.array(dtype=wp.int32)):
    """Return the place after a pair's last chunk."""
    return first_chunk(p, start) + (start[p + 1] - start[p] + CHUNK - 1) // CHUNK


@wp.func
def chunk_span(p: wp.int32, c: wp.int32, start: wp.array(dtype=wp.int32)):
    """Return (pair, first contact, end) of a chunk from its pair's first on; behind its last, the end is the first."""
    first = start[p] + (c - first_chunk(p, start)) * CHUNK
    return wp.vec3i(p, first, wp.max(first, wp.min(first + CHUNK, start[p + 1])))


@wp.kernel
def locate_chunk_kernel(start: wp.array(dtype=wp.int32), span_out: wp.array(dtype=wp.vec3i)):
    """Locate one chunk a thread: find its pair."""
    c = wp.tid()
    low = wp.int32(0)
    high = start.shape[0] - 1
    while high - low > 1:  # the pair is one of low .. high - 1
        middle = (low + high) // 2
        if first_chunk(middle, start) <= c:
            low = middle
        else:
            high = middle
    span_out[c] = chunk_span(low, c, start)
