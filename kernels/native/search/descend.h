// The dual-tree traversal of the CPU: up to four pairs of boxes at a time, as `compare_node_pair` one by one.
#pragma once
#include "builtin.h"
#include "search/pair_lists.h"
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

template <class StatePool, class PairPose, class Descent>
wp::int32 descend(const StatePool& states, const PairPose& pose, wp::int64 most, Descent& descent,
                  wp::array_t<wp::int64> stack, wp::array_t<wp::int64> faces) {
    typedef NodeBoxes::groups groups;
    typedef NodeBoxes::bits bits;
    const NodeBoxes boxes = NodeBoxes::make(pose, states.node_box.data);
    PairLists lists = {stack.data, faces.data, descent.top, 0};
    const int at_once = descent.at_once, ready = descent.ready;
    wp::int64 compared = 0;
    while (lists.end > 0 && lists.waiting < ready && compared < most) {
        const int count = lists.fitting(at_once);
        lists.end -= count;
        NodeBoxes::Taken taken[ITEMS_AT_ONCE];
        for (int i = 0; i < count; ++i)
            taken[i] = boxes.take(lists.items[lists.end + i]);
        for (int i = 0; i < count; ++i) {
            const groups a = *(const NodeBoxes::loose*)taken[i].a, b = *(const NodeBoxes::loose*)taken[i].b;
            const bits whole_a = (bits)a, whole_b = (bits)b;
            const PairLists::ints skip = __builtin_shufflevector(whole_a, whole_b, 3, 3, 11, 11, 19, 27, 19, 27);
            const PairLists::ints face = __builtin_shufflevector(whole_a, whole_b, 7, 7, 15, 15, 23, 31, 23, 31);
            compared += __builtin_popcount(taken[i].used);
            lists.append(skip, face, boxes.overlapping(a, b) & taken[i].used);
        }
    }
    descent.top = lists.end;
    descent.tests += compared;
    return lists.waiting;
}

template <class Descent>
void move_below(Descent& descent, wp::array_t<wp::int64> stack, wp::array_t<wp::int64> below) {
    // Whether a node, or both children of one, lie in a subtree whose root is on a level.
    auto is_below = [](unsigned int half, int floor) {
        return 31 - __builtin_clz(half & 0x7fffffff) - (int)(half >> 31) >= floor;
    };
    wp::int64* items = stack.data;
    const int top = descent.top, floor_a = descent.floors[0], floor_b = descent.floors[1];
    const int first = top > ITEMS_AT_ONCE ? top - ITEMS_AT_ONCE : 0;
    int end = first, deep = 0;
    for (int i = first; i < top; ++i) {
        const wp::int64 item = items[i];
        if (is_below((unsigned int)(item >> 32), floor_a) && is_below((unsigned int)item, floor_b))
            below.data[deep++] = item;
        else
            items[end++] = item;
    }
    descent.top = end;
    descent.deep = deep;
}
