// Four pairs of the boxes of two siblings in each of two trees, for the CPU's traversal.
#pragma once
#include "builtin.h"
#include "search/siblings.h"

struct NodeBoxes {
    // Groups of four numbers: x, y, z and one that is not in use.
    typedef float groups __attribute__((vector_size(64)));
    typedef float loose __attribute__((vector_size(64), aligned(16)));
    typedef int bits __attribute__((vector_size(64)));
    typedef bool flags __attribute__((ext_vector_type(16)));
    typedef Siblings Taken;
    groups axes[3], sizes[3], shift, wide;  // for both children of A, then for both children of B
    const char *tree_a, *tree_b;

    template <class PairPose>
    static NodeBoxes make(const PairPose& pose, const void* trees) {
        NodeBoxes boxes;
        const auto& r = pose.rotation32.data;
        const auto& there = pose.translation32;
        const auto& back = pose.back32;
        for (int k = 0; k < 3; ++k) {
            boxes.axes[k] = groups{r[k][0], r[k][1], r[k][2], 0.0f, r[k][0], r[k][1], r[k][2], 0.0f,
                                   r[0][k], r[1][k], r[2][k], 0.0f, r[0][k], r[1][k], r[2][k], 0.0f};
            boxes.sizes[k] = __builtin_elementwise_abs(boxes.axes[k]);
        }
        const float home[3] = {back[0] + back[0], back[1] + back[1], back[2] + back[2]};
        const float forth[3] = {there[0] + there[0], there[1] + there[1], there[2] + there[2]};
        boxes.shift = groups{home[0],  home[1],  home[2],  0.0f, home[0],  home[1],  home[2],  0.0f,
                             forth[0], forth[1], forth[2], 0.0f, forth[0], forth[1], forth[2], 0.0f};
        boxes.wide = groups{} + (pose.margin + pose.margin);
        boxes.tree_a = (const char*)trees + 32 * (wp::int64)pose.node_a;
        boxes.tree_b = (const char*)trees + 32 * (wp::int64)pose.node_b;
        return boxes;
    }
    Taken take(wp::int64 item) const { return take_siblings(tree_a, tree_b, item); }
    // The boxes of A twice each, those of B in turn: four pairs.
    static groups of_a(const groups& v) {
        return __builtin_shufflevector(v, v, 0, 1, 2, 3, 0, 1, 2, 3, 4, 5, 6, 7, 4, 5, 6, 7);
    }
    static groups of_b(const groups& v) {
        return __builtin_shufflevector(v, v, 8, 9, 10, 11, 12, 13, 14, 15, 8, 9, 10, 11, 12, 13, 14, 15);
    }
    // Pairs that overlap, a bit each.
    __attribute__((always_inline)) unsigned int overlapping(const groups& a, const groups& b) const {
        const groups none = {};
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
        return (m & 0x1111) * 0x1248 >> 12;
    }
};
