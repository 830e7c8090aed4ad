// The dual-tree traversal of the CPU: up to four pairs of boxes at a time, as `compare_node_pair` one by one.
#pragma once
#include "builtin.h"
#include "intersect/node_boxes.h"
#include "intersect/pair_lists.h"

template <class StatePool, class PairPose>
wp::vec_t<3, wp::int64> descend(const StatePool& states, const PairPose& pose, wp::int32 at_once, wp::int32 ready,
                                wp::int64 most, wp::int32 top, wp::array_t<wp::int64> stack,
                                wp::array_t<wp::int64> faces) {
    typedef NodeBoxes::groups groups;
    typedef NodeBoxes::bits bits;
    const NodeBoxes boxes = NodeBoxes::make(pose, states.node_box.data);
    PairLists lists = {stack.data, faces.data, top, 0};
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
    wp::vec_t<3, wp::int64> result;
    result[0] = lists.end;
    result[1] = lists.waiting;
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
