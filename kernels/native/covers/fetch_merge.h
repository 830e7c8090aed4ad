// Bring what a merge will read into the caches: its rings, its triangles and their slots.
#pragma once
#include "builtin.h"
#include "sizes.h"

template <class Replay> void fetch_merge(Replay replay, wp::int32 a, wp::int32 b) {
#if !defined(__CUDA_ARCH__)
#include "sizes.h"
    // Lists of slots, all one step at a time: each step waits for memory once, not once a list.
    int list[NEAR_ROOM], lists = 0;
    const int nodes[2] = {a, b};
    for (int node : nodes) {
        for (int k = replay.rings.head.data[node]; k >= 0 && lists < NEAR_ROOM; k = replay.rings.next.data[k]) {
            const int f = k / 3;
            __builtin_prefetch(replay.rings.corner_node.data + 3 * f);
            list[lists++] = replay.face_slot.data[f];
        }
    }
    while (lists > 0) {
        int left = 0;
        for (int i = 0; i < lists; ++i) {
            if (list[i] < 0)
                continue;
            const int* slot = replay.slot.data + SLOT_FIELDS * (wp::int64)list[i];
            const int t = slot[SLOT_TRIANGLE];
            const double* corner = (const double*)replay.triangle_pos.data + 9 * (wp::int64)t;
            __builtin_prefetch(replay.slot.data + SLOT_FIELDS * (wp::int64)t);
            __builtin_prefetch(corner);
            __builtin_prefetch(corner + 8);
            list[left++] = slot[SLOT_NEXT];
        }
        lists = left;
    }
#endif
}
