// The dual-tree traversal of the CPU inside subtrees, by slabs: as `descend`, four pairs of nodes at a time.
#pragma once
#include "builtin.h"
#include "intersect/slabs.h"
#include "search/siblings.h"

template <class ModelPool, class StatePool, class PairPose>
wp::vec_t<3, wp::int64> descend_subtrees(const ModelPool& models, const StatePool& states, const PairPose& pose,
                                         wp::int32 thread, wp::int32 ready, wp::int32 top, wp::array_t<wp::int64> stack,
                                         wp::array_t<wp::float32> memory, wp::array_t<wp::int64> faces) {
    wp::vec_t<3, wp::int64> result;
    typedef Slabs::lanes lanes;
    typedef Slabs::Record Record;
    typedef int ints __attribute__((vector_size(32)));
    typedef float eight __attribute__((vector_size(32)));
    typedef bool flags __attribute__((ext_vector_type(32)));
    typedef bool eight_flags __attribute__((ext_vector_type(8)));
    typedef wp::int64 longs __attribute__((vector_size(32)));
    typedef wp::int64 loose_longs __attribute__((vector_size(32), aligned(8)));
    const Slabs::Memory kept = Slabs::find_memory(memory.data, memory.shape[1], thread);
    const Slabs::Box* nodes = (const Slabs::Box*)states.node_box.data;
    const int* corners = (const int*)states.face_corner.data;
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
    const void* near = models.vertex_near.data;
    wp::int64* items = stack.data;
    wp::int64* found = faces.data;
    wp::int64 compared = 0;
    int end = top, waiting = 0;
    struct Taken {
        const Record *a, *b;
        unsigned int used;
    };
    // The records of two siblings; null if their subtree takes the place of another one while items wait.
    auto find = [&](const Slabs::Side& side, unsigned int half, bool wait) -> const Record* {
        const unsigned int node = half & 0x7fffffff;
        const int below = Slabs::level_of(node) - side.floor;
        const unsigned int root = node >> below;
        const unsigned int slot = root & (kept.slots - 1);
        Record* records = side.records + (wp::int64)SUBTREE_RECORDS * slot;
        if (__builtin_expect(side.roots[slot] != (int)root, 0)) {
            if (side.roots[slot] != 0 && wait)
                return nullptr;
            side.roots[slot] = (int)root;
            Slabs::fill(side, near, root, records);
        }
        return records + (((1 << below) | (node & ((1 << below) - 1))) & ~1);
    };
    while (end > 0 && waiting < ready) {
        const int room = (CPU_STACK_LENGTH - DEPTH_FIRST_LENGTH - end) / 3, fits = room > 1 ? room : 1;
        const int wide = SUBTREES_AT_ONCE < fits ? SUBTREES_AT_ONCE : fits, wanted = wide < end ? wide : end;
        Taken taken[SUBTREES_AT_ONCE];
        int count = 0;
        for (; count < wanted; ++count) {
            const wp::int64 item = items[end - 1 - count];
            const Record* a = find(sides[0], (unsigned int)(item >> 32), count > 0);
            if (a == nullptr)
                break;
            const Record* b = find(sides[1], (unsigned int)item, count > 0);
            if (b == nullptr)
                break;
            for (int k = 0; k < 2; ++k) {
                __builtin_prefetch(a + k);
                __builtin_prefetch(b + k);
            }
            taken[count] = Taken{a, b, pairs_in_use(item)};
        }
        end -= count;
        for (int i = 0; i < count; ++i) {
            const Record *a = taken[i].a, *b = taken[i].b;
            auto apart = [&](int k) {
                const Record gap = __builtin_elementwise_add_sat(a[k >> 1], b[k & 1]) > 0;
                return __builtin_bit_cast(unsigned int, __builtin_convertvector(gap, flags)) & 0x3fff3fff;
            };
            const unsigned int mask =
                ((apart(0) == 0) | (apart(1) == 0) << 1 | (apart(2) == 0) << 2 | (apart(3) == 0) << 3) & taken[i].used;
            const int *a0 = (const int*)a, *a1 = (const int*)(a + 1), *b0 = (const int*)b, *b1 = (const int*)(b + 1);
            const ints skip = {a0[7], a0[7], a1[7], a1[7], b0[7], b1[7], b0[7], b1[7]};
            const ints face = {a0[15], a0[15], a1[15], a1[15], b0[15], b1[15], b0[15], b1[15]};
            const ints other = __builtin_shufflevector(face, face, 4, 5, 6, 7, 0, 1, 2, 3);
            const eight span = (eight)face, other_span = (eight)other;
            const ints inner = (face | other) < 0, down = (face < 0) & (span + span <= other_span);
            const ints next = inner ? (down ? (skip + skip) | (1 << 31) : skip) : face;
            const longs pairs = (longs)__builtin_shufflevector(next, next, 4, 0, 5, 1, 6, 2, 7, 3);
            const unsigned int go =
                mask & __builtin_bit_cast(unsigned char, __builtin_convertvector(inner, eight_flags));
            const unsigned int leaves = mask & ~go;
            compared += __builtin_popcount(taken[i].used);
#if defined(__AVX512VL__)
            *(loose_longs*)(items + end) = __builtin_ia32_compressdi256_mask(pairs, longs{}, go);
            *(loose_longs*)(found + waiting) = __builtin_ia32_compressdi256_mask(pairs, longs{}, leaves);
            end += __builtin_popcount(go);
            waiting += __builtin_popcount(leaves);
#else
            for (int k = 0; k < 4; ++k) {
                items[end] = found[waiting] = pairs[k];
                end += (go >> k) & 1;
                waiting += (leaves >> k) & 1;
            }
#endif
        }
    }
    result[0] = end;
    result[1] = waiting;
    result[2] = compared;
    return result;
}
