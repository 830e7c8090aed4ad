// The dual-tree traversal of the CPU inside subtrees, by slabs: as `descend`, four pairs of nodes at a time.
#pragma once
#include "builtin.h"
#include "search/pair_lists.h"
#include "search/slabs.h"
#include "search/siblings.h"

template <class Trees, class PairPose, class Descent>
wp::int32 descend_subtrees(const Trees& trees, const PairPose& pose, Descent& descent, wp::array_t<wp::int64> below,
                           wp::array_t<wp::float32> memory, wp::array_t<wp::int64> faces) {
    typedef Slabs::lanes lanes;
    typedef Slabs::Record Record;
    typedef bool flags __attribute__((ext_vector_type(32)));
    const Slabs::Memory kept = Slabs::find_memory(memory.data, memory.shape[1], descent.thread);
    const Slabs::Box* nodes = (const Slabs::Box*)trees.states.node_box.data;
    const int* corners = (const int*)trees.states.face_corner.data;
    const lanes *of_a = (const lanes*)kept.of_a, *of_b = (const lanes*)kept.of_b;
    const wp::int64 records_b = (wp::int64)SUBTREE_RECORDS * kept.slots;
    const Slabs::Side sides[2] = {{nodes + pose.node_a,
                                   corners + 4 * (wp::int64)pose.corner_a,
                                   {of_a[0], of_a[1], of_a[2]},
                                   of_a[3],
                                   lanes{},
                                   kept.floors[0],
                                   kept.roots,
                                   kept.records},
                                  {nodes + pose.node_b,
                                   corners + 4 * (wp::int64)pose.corner_b,
                                   {of_b[0], of_b[1], of_b[2]},
                                   of_b[3],
                                   of_b[4],
                                   kept.floors[1],
                                   kept.roots + kept.slots,
                                   kept.records + records_b}};
    const void* near = trees.models.vertex_near.data;
    PairLists lists = {below.data, faces.data, descent.deep, 0};
    const int ready = descent.ready;
    wp::int64 compared = 0;
    struct Taken {
        const Record *a, *b;
        unsigned int used;
    };
    while (lists.end > 0 && lists.waiting < ready) {
        const int wanted = lists.fitting(SUBTREES_AT_ONCE);
        Taken taken[SUBTREES_AT_ONCE];
        int count = 0;
        for (; count < wanted; ++count) {
            const wp::int64 item = lists.items[lists.end - 1 - count];
            const Record* a = sides[0].find(near, (unsigned int)(item >> 32), kept.slots, count > 0);
            if (a == nullptr)
                break;
            const Record* b = sides[1].find(near, (unsigned int)item, kept.slots, count > 0);
            if (b == nullptr)
                break;
            for (int k = 0; k < 2; ++k) {
                __builtin_prefetch(a + k);
                __builtin_prefetch(b + k);
            }
            taken[count] = Taken{a, b, pairs_in_use(item)};
        }
        lists.end -= count;
        for (int i = 0; i < count; ++i) {
            const Record *a = taken[i].a, *b = taken[i].b;
            auto apart = [&](int k) {
                const Record gap = __builtin_elementwise_add_sat(a[k >> 1], b[k & 1]) > 0;
                return __builtin_bit_cast(unsigned int, __builtin_convertvector(gap, flags)) & 0x3fff3fff;
            };
            const unsigned int mask =
                ((apart(0) == 0) | (apart(1) == 0) << 1 | (apart(2) == 0) << 2 | (apart(3) == 0) << 3) & taken[i].used;
            const int *a0 = (const int*)a, *a1 = (const int*)(a + 1), *b0 = (const int*)b, *b1 = (const int*)(b + 1);
            const PairLists::ints skip = {a0[7], a0[7], a1[7], a1[7], b0[7], b1[7], b0[7], b1[7]};
            const PairLists::ints face = {a0[15], a0[15], a1[15], a1[15], b0[15], b1[15], b0[15], b1[15]};
            compared += __builtin_popcount(taken[i].used);
            lists.append(skip, face, mask);
        }
    }
    descent.deep = lists.end;
    descent.tests += compared;
    return lists.waiting;
}
