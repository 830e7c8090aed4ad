// Bring what the next merges of a collapse read into the caches of this core.
#pragma once
#include "builtin.h"

// Of the edge on top of the heap all that lies about it; of the four below it their nodes.
template <class Surface, class Rings, class Heap>
void fetch_edges(const Surface& surface, const Rings& rings, const Heap& heap, wp::int32 size) {
    auto fetch_node = [&](int node) {
        __builtin_prefetch(surface.pos.data + node);
        __builtin_prefetch(surface.quadric.data + node);
        __builtin_prefetch((const char*)(surface.quadric.data + node) + sizeof(surface.quadric.data[0]) - 1);
    };
    for (int i = 0; i < 5 && i < size; ++i) {
        const wp::int64 pair = heap.pair.data[i];
        const int nodes[2] = {(int)(pair >> 32), (int)((pair >> 2) & 0x3FFFFFFF)};
        for (int node : nodes) {
            if (i > 0) {
                fetch_node(node);
                __builtin_prefetch(surface.parent.data + node);
                __builtin_prefetch(rings.head.data + node);
                __builtin_prefetch(rings.degree.data + node);
                continue;
            }
            for (int k = rings.head.data[node]; k >= 0; k = rings.next.data[k]) {
                const int* corner = rings.corner_node.data + k / 3 * 3;
                for (int turn = 0; turn < 3 && corner[0] >= 0; ++turn) {
                    fetch_node(corner[turn]);
                    __builtin_prefetch(surface.stamp.data + corner[turn]);
                }
            }
        }
    }
}

// Of the children of the four entries from `child` on, before it is known whose are needed.
template <class Heap>
void fetch_entries(const Heap& heap, wp::int32 child) {
    const wp::int64 first = 4 * (wp::int64)child + 1;
    for (int i = 0; i < 16; i += 8) {
        __builtin_prefetch(heap.key.data + first + i);
        __builtin_prefetch(heap.pair.data + first + i);
    }
    __builtin_prefetch(heap.key.data + first + 15);
    __builtin_prefetch(heap.pair.data + first + 15);
}
