// The dual-tree traversal of the CPU: up to four pairs of boxes at a time, as `compare_node_pair` one by one.
#pragma once
#include "builtin.h"
#include "base/sizes.h"
#include "search/siblings.h"

template <class StatePool, class PairPose>
wp::vec_t<3, wp::int64> descend(const StatePool& states, const PairPose& pose, wp::int32 at_once, wp::int32 ready,
                                wp::int64 most, wp::int32 top, wp::array_t<wp::int64> stack,
                                wp::array_t<wp::int64> faces) {
    wp::vec_t<3, wp::int64> result;
    // Groups of four numbers: x, y, z and one that is not in use.
    typedef float groups __attribute__((vector_size(64)));
    typedef float loose __attribute__((vector_size(64), aligned(16)));
    typedef int bits __attribute__((vector_size(64)));
    typedef float eight __attribute__((vector_size(32)));
    typedef int ints __attribute__((vector_size(32)));
    typedef wp::int64 longs __attribute__((vector_size(32)));
    typedef wp::int64 loose_longs __attribute__((vector_size(32), aligned(8)));
    typedef bool flags __attribute__((ext_vector_type(16)));
    typedef bool eight_flags __attribute__((ext_vector_type(8)));
    const groups none = {};
    const auto& r = pose.rotation32.data;
    const auto& there = pose.translation32;
    const auto& back = pose.back32;
    // For both children of A, then for both children of B.
    groups axes[3];
    for (int k = 0; k < 3; ++k)
        axes[k] = groups{r[k][0], r[k][1], r[k][2], 0.0f, r[k][0], r[k][1], r[k][2], 0.0f,
                         r[0][k], r[1][k], r[2][k], 0.0f, r[0][k], r[1][k], r[2][k], 0.0f};
    const groups sizes[3] = {__builtin_elementwise_abs(axes[0]), __builtin_elementwise_abs(axes[1]),
                             __builtin_elementwise_abs(axes[2])};
    const float home[3] = {back[0] + back[0], back[1] + back[1], back[2] + back[2]};
    const float forth[3] = {there[0] + there[0], there[1] + there[1], there[2] + there[2]};
    const groups shift = {home[0],  home[1],  home[2],  0.0f, home[0],  home[1],  home[2],  0.0f,
                          forth[0], forth[1], forth[2], 0.0f, forth[0], forth[1], forth[2], 0.0f};
    const float w = pose.margin + pose.margin;
    const groups wide = {w, w, w, w, w, w, w, w, w, w, w, w, w, w, w, w};
    // The boxes of A twice each, those of B in turn: four pairs.
    auto of_a = [](const groups& v) {
        return __builtin_shufflevector(v, v, 0, 1, 2, 3, 0, 1, 2, 3, 4, 5, 6, 7, 4, 5, 6, 7);
    };
    auto of_b = [](const groups& v) {
        return __builtin_shufflevector(v, v, 8, 9, 10, 11, 12, 13, 14, 15, 8, 9, 10, 11, 12, 13, 14, 15);
    };
    struct Taken {
        const char *a, *b;
        unsigned int used;
    };
    const char* tree_a = (const char*)states.node_box.data + 32 * (wp::int64)pose.node_a;
    const char* tree_b = (const char*)states.node_box.data + 32 * (wp::int64)pose.node_b;
    wp::int64* items = stack.data;
    wp::int64* found = faces.data;
    wp::int64 compared = 0;
    int end = top, waiting = 0;
    auto take = [&](wp::int64 item) {
        const unsigned int x = (unsigned int)(item >> 32), y = (unsigned int)item;
        const Taken taken = {tree_a + 32 * (wp::int64)(x & 0x7ffffffe), tree_b + 32 * (wp::int64)(y & 0x7ffffffe),
                             pairs_in_use(item)};
        __builtin_prefetch(taken.a);
        __builtin_prefetch(taken.b);
        return taken;
    };
    auto test = [&](const Taken& taken) {
        const groups a = *(const loose*)taken.a, b = *(const loose*)taken.b;
        groups low = __builtin_shufflevector(a, b, 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27);
        groups high = __builtin_shufflevector(a, b, 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31);
        low = __builtin_shufflevector(low, none, 0, 1, 2, 16, 4, 5, 6, 16, 8, 9, 10, 16, 12, 13, 14, 16);
        high = __builtin_shufflevector(high, none, 0, 1, 2, 16, 4, 5, 6, 16, 8, 9, 10, 16, 12, 13, 14, 16);
        const groups sum = high + low, size = high - low;
        const groups x = __builtin_shufflevector(sum, sum, 0, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8, 12, 12, 12, 12);
        const groups y = __builtin_shufflevector(sum, sum, 1, 1, 1, 1, 5, 5, 5, 5, 9, 9, 9, 9, 13, 13, 13, 13);
        const groups z = __builtin_shufflevector(sum, sum, 2, 2, 2, 2, 6, 6, 6, 6, 10, 10, 10, 10, 14, 14, 14, 14);
        const groups p = __builtin_shufflevector(size, size, 0, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8, 12, 12, 12, 12);
        const groups q = __builtin_shufflevector(size, size, 1, 1, 1, 1, 5, 5, 5, 5, 9, 9, 9, 9, 13, 13, 13, 13);
        const groups s = __builtin_shufflevector(size, size, 2, 2, 2, 2, 6, 6, 6, 6, 10, 10, 10, 10, 14, 14, 14, 14);
        groups sum_there = __builtin_elementwise_fma(axes[2], z, shift);
        sum_there = __builtin_elementwise_fma(axes[1], y, sum_there);
        sum_there = __builtin_elementwise_fma(axes[0], x, sum_there);
        groups size_there = __builtin_elementwise_fma(sizes[2], s, wide);
        size_there = __builtin_elementwise_fma(sizes[1], q, size_there);
        size_there = __builtin_elementwise_fma(sizes[0], p, size_there);
        const bits hit = (__builtin_elementwise_abs(of_a(sum) - of_b(sum_there)) <= of_a(size) + of_b(size_there)) &
                         (__builtin_elementwise_abs(of_a(sum_there) - of_b(sum)) <= of_a(size_there) + of_b(size));
        unsigned int m = __builtin_bit_cast(unsigned short, __builtin_convertvector(hit, flags)) | 0x8888;
        m &= m >> 1;
        m &= m >> 2;
        // Bits 0, 4, 8 and 12 side by side.
        const unsigned int mask = ((m & 0x1111) * 0x1248 >> 12) & taken.used;
        // What follows, as in `next_item`: of A for the four pairs, then of B.
        const bits whole_a = (bits)a, whole_b = (bits)b;
        const ints skip = __builtin_shufflevector(whole_a, whole_b, 3, 3, 11, 11, 19, 27, 19, 27);
        const ints face = __builtin_shufflevector(whole_a, whole_b, 7, 7, 15, 15, 23, 31, 23, 31);
        const ints other = __builtin_shufflevector(face, face, 4, 5, 6, 7, 0, 1, 2, 3);
        const eight span = (eight)face, other_span = (eight)other;
        const ints inner = (face | other) < 0, down = (face < 0) & (span + span <= other_span);
        const ints next = inner ? (down ? (skip + skip) | (1 << 31) : skip) : face;
        const longs pairs = (longs)__builtin_shufflevector(next, next, 4, 0, 5, 1, 6, 2, 7, 3);
        const unsigned int go = mask & __builtin_bit_cast(unsigned char, __builtin_convertvector(inner, eight_flags));
        const unsigned int leaves = mask & ~go;
        compared += __builtin_popcount(taken.used);
#if defined(__AVX512VL__)
        *(loose_longs*)(items + end) = __builtin_ia32_compressdi256_mask(pairs, longs{}, go);
        *(loose_longs*)(found + waiting) = __builtin_ia32_compressdi256_mask(pairs, longs{}, leaves);
        end += __builtin_popcount(go);
        waiting += __builtin_popcount(leaves);
#else
// Without branches, which could not be predicted; what is not in use is written over.
#pragma clang loop unroll(full)
        for (int k = 0; k < 4; ++k) {
            items[end] = found[waiting] = pairs[k];
            end += (go >> k) & 1;
            waiting += (leaves >> k) & 1;
        }
#endif
    };
    while (end > 0 && waiting < ready && compared < most) {
        const int room = (CPU_STACK_LENGTH - DEPTH_FIRST_LENGTH - end) / 3, fits = room > 1 ? room : 1;
        const int wanted = at_once < fits ? at_once : fits, count = wanted < end ? wanted : end;
        end -= count;
        Taken taken[ITEMS_AT_ONCE];
        for (int i = 0; i < count; ++i)
            taken[i] = take(items[end + i]);
        for (int i = 0; i < count; ++i)
            test(taken[i]);
    }
    result[0] = end;
    result[1] = waiting;
    result[2] = compared;
    return result;
}

inline wp::vec_t<2, wp::int32> move_below(wp::vec_t<2, wp::int32> floors, wp::int32 top, wp::array_t<wp::int64> stack,
                                          wp::array_t<wp::int64> below) {
    // Whether a node, or both children of one, lie in a subtree whose root is on a level.
    auto is_below = [](unsigned int half, int floor) {
        return 31 - __builtin_clz(half & 0x7fffffff) - (int)(half >> 31) >= floor;
    };
    wp::int64* items = stack.data;
    const int first = top > ITEMS_AT_ONCE ? top - ITEMS_AT_ONCE : 0;
    int end = first, deep = 0;
    for (int i = first; i < top; ++i) {
        const wp::int64 item = items[i];
        if (is_below((unsigned int)(item >> 32), floors[0]) && is_below((unsigned int)item, floors[1]))
            below.data[deep++] = item;
        else
            items[end++] = item;
    }
    return wp::vec_t<2, wp::int32>(end, deep);
}
