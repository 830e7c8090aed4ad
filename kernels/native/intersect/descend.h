// The dual-tree traversal of the CPU: up to four pairs of boxes at a time, as `compare_node_pair` one by one.
#pragma once
#include "builtin.h"
#include "intersect/node_boxes.h"
#include "intersect/pair_lists.h"

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
