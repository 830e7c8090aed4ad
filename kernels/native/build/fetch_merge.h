// Bring what the next merges read into the caches of this core while it is at work on the one before.
#pragma once
#include "builtin.h"
#include "base/sizes.h"

// Follow lists of slots one step of all at a time, so that memory is waited for once a step. `follow` takes a slot and
// returns the next one of its list, or -1.
template <class Follow>
void follow_lists(int* list, int lists, const Follow& follow) {
    while (lists > 0) {
        int kept = 0;
        for (int i = 0; i < lists; ++i) {
            const int next = follow(list[i]);
            if (next >= 0)
                list[kept++] = next;
        }
        lists = kept;
    }
}

// Of the merge after `j` all that lies about it, of a later one its two nodes.
template <class Replay, class Pairs>
void fetch_merge(const Replay& replay, const Pairs& merge_pair, wp::int32 merge_count, wp::int32 j) {
    const int *pair = merge_pair.data, *head = replay.rings.head.data, *next = replay.rings.next.data;
    const int *corner_node = replay.rings.corner_node.data, *slots = replay.slot.data;
    const double *pos = (const double*)replay.pos.data, *corners = (const double*)replay.triangle_pos.data;
    if (j + 4 < merge_count) {
        for (int k = 0; k < 2; ++k) {
            __builtin_prefetch(head + pair[2 * (j + 4) + k]);
            const int corner = head[pair[2 * (j + 3) + k]];
            __builtin_prefetch(next + (corner < 0 ? 0 : corner));
            __builtin_prefetch(corner_node + (corner < 0 ? 0 : corner));
        }
    }
    if (j + 1 >= merge_count)
        return;
    // Both rings, then the lists of slots of all their faces.
    int list[NEAR_ROOM], lists = 0, slot_lists = 0, left = head[pair[2 * j + 2]], right = head[pair[2 * j + 3]];
    while ((left >= 0 || right >= 0) && lists + 2 <= NEAR_ROOM) {
        if (left >= 0) {
            list[lists++] = left / 3;
            left = next[left];
        }
        if (right >= 0) {
            list[lists++] = right / 3;
            right = next[right];
        }
    }
    for (int i = 0; i < lists; ++i) {
        const int* node = corner_node + 3 * list[i];
        for (int k = 0; k < 3; ++k)
            __builtin_prefetch(pos + 3 * (wp::int64)(node[k] < 0 ? 0 : node[k]));
        const int slot = replay.face_slot.data[list[i]];
        if (slot >= 0)
            list[slot_lists++] = slot;
    }
    follow_lists(list, slot_lists, [&](int i) {
        const int* slot = slots + SLOT_FIELDS * (wp::int64)i;
        const int t = slot[SLOT_TRIANGLE];
        __builtin_prefetch(slots + SLOT_FIELDS * (wp::int64)t);
        __builtin_prefetch(corners + 9 * (wp::int64)t);
        __builtin_prefetch(corners + 9 * (wp::int64)t + 8);
        return slot[SLOT_NEXT];
    });
}
