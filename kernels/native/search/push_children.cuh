// Places of the items that node pair tests emit: one prefix sum over a warp for three lists.
#pragma once
#include "builtin.h"
#include "base/shared.cuh"
#include "base/sizes.h"

template <class WarpLists>
CUDA_CALLABLE void push_children(WarpLists& own, wp::vec_t<4, wp::int32> lists, wp::vec_t<4, wp::int64> children) {
    const wp::uint64 items = own.items;
    const int end = own.end, slab_end = own.slab_pairs, leaf_end = own.leaf_pairs;
#if defined(__CUDA_ARCH__)
    unsigned int emitted[4];
#pragma unroll
    for (int k = 0; k < 4; ++k)
        asm("shl.b32 %0, %1, %2;" : "=r"(emitted[k]) : "r"(ITEM_BYTES), "r"(lists[k]));  // 0 for NO_LIST
    const unsigned int mine = (emitted[0] + emitted[1]) + (emitted[2] + emitted[3]);
    unsigned int sum = mine;
// What came from a lane is added, nothing where there is none.
#pragma unroll
    for (int step = 1; step < 32; step <<= 1)
        asm volatile(
            "{ .reg .pred from; .reg .b32 other;"
            " shfl.sync.up.b32 other|from, %0, %1, 0, 0xffffffff; @from add.u32 %0, %0, other; }"
            : "+r"(sum)
            : "r"(step));
    const unsigned int total = __shfl_sync(0xffffffffu, sum, 31);
    unsigned int place =
        (ITEM_BYTES * (unsigned int)end << STACK_LIST | ITEM_BYTES * (STACK_LENGTH + leaf_end) << LEAF_PAIR_LIST |
         ITEM_BYTES * (SLAB_PAIR_START + slab_end) << SLAB_PAIR_LIST) +
        (sum - mine);
#pragma unroll
    for (int k = 0; k < 4; ++k) {
        unsigned int at;
        asm("shr.u32 %0, %1, %2;" : "=r"(at) : "r"(place), "r"(lists[k]));
        if (emitted[k] != 0)
            *(volatile long long*)entry<char>(items, at & PLACE_MASK) = children[k];
        place += emitted[k];
    }
    const int more_items = (total >> STACK_LIST) / ITEM_BYTES;
    const int more_slab = ((total >> SLAB_PAIR_LIST) & PLACE_MASK) / ITEM_BYTES;
    const int more_leaves = ((total >> LEAF_PAIR_LIST) & PLACE_MASK) / ITEM_BYTES;
#else
    long long* list = (long long*)items;
    int more_items = 0, more_slab = 0, more_leaves = 0;
    for (int k = 0; k < 4; ++k) {
        if (lists[k] == STACK_LIST)
            list[(end + more_items++) & (STACK_LENGTH - 1)] = children[k];
        else if (lists[k] == SLAB_PAIR_LIST)
            list[SLAB_PAIR_START + slab_end + more_slab++] = children[k];
        else if (lists[k] == LEAF_PAIR_LIST)
            list[STACK_LENGTH + leaf_end + more_leaves++] = children[k];
    }
#endif
    own.end = end + more_items;
    own.slab_pairs = slab_end + more_slab;
    own.leaf_pairs = leaf_end + more_leaves;
}
