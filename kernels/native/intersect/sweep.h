// Sweep and prune on the CPU: boxes of a group in the order of their lower ends along an axis, 16 compared at a time.
#pragma once
#include "builtin.h"
#include "base/float32.h"
#include "base/radix.h"

struct SweptRows {
    typedef unsigned long long word;
    typedef float loose __attribute__((vector_size(64), aligned(4)));
    float* data;
    wp::int64 room;  // of a column: lower and upper ends along three axes, one after the other

    SweptRows(const wp::array_t<wp::float32>& rows) : data(rows.data), room(rows.shape[0] / 6) {}
    float* column(int axis, int end) const { return data + (2 * axis + end) * room; }
    // Words in order, of which the other half of the buffer is scratch; returns where they are.
    static word* sort(word* from, word* to, int count) {
        if (count <= 32) {
            for (int i = 1; i < count; ++i) {
                const word own = from[i];
                int k = i;
                for (; k > 0 && from[k - 1] > own; --k)
                    from[k] = from[k - 1];
                from[k] = own;
            }
            return from;
        }
        return sort_words(from, to, count, 32);
    }
};

// Sorts the objects of a group, [first, end) of `order`, by their lower ends along an axis, and lists their boxes.
inline void sort_sweep(wp::int32 first, wp::int32 end, wp::int32 axis, wp::array_t<wp::int32> order,
                       wp::array_t<wp::vec3> lower, wp::array_t<wp::vec3> upper, wp::array_t<wp::int64> words,
                       wp::array_t<wp::int32> place, wp::array_t<wp::float32> rows) {
    const SweptRows swept(rows);
    const int count = end - first;
    SweptRows::word* own = (SweptRows::word*)words.data;
    for (int k = 0; k < count; ++k) {
        const int i = order.data[first + k];
        const unsigned int bits = __builtin_bit_cast(unsigned int, lower.data[i][axis]);
        const unsigned int sorted = bits >> 31 ? ~bits : bits | 0x80000000u;
        own[k] = (SweptRows::word)sorted << 32 | (unsigned int)i;
    }
    own = SweptRows::sort(own, own + words.shape[0] / 2, count);
    for (int k = 0; k < count; ++k) {
        const int i = (int)(unsigned int)own[k];
        place.data[first + k] = i;
        for (int x = 0; x < 3; ++x) {
            swept.column(x, 0)[first + k] = lower.data[i][x];
            swept.column(x, 1)[first + k] = upper.data[i][x];
        }
    }
}

// Lists places from `at` to `end` whose boxes overlap that of a place, until the list is full or none can follow, and
// moves `at` to where to go on; returns how many.
inline wp::int32 scan_sweep(wp::int32 own, wp::int32& at, wp::int32 end, wp::int32 axis, wp::array_t<wp::float32> rows,
                            wp::array_t<wp::int32> found) {
    typedef Float32 F;
    const SweptRows swept(rows);
    const int room = found.shape[0] - 16;
    const float last = swept.column(axis, 1)[own];
    const float* const start = swept.column(axis, 0);
    int count = 0;
    while (at < end && count <= room && start[at] <= last) {
        F::bits overlap = F::bits{} - 1;
        for (int x = 0; x < 3; ++x) {
            const F::lanes low = *(const SweptRows::loose*)(swept.column(x, 0) + at);
            const F::lanes high = *(const SweptRows::loose*)(swept.column(x, 1) + at);
            overlap &= (low <= F::every(swept.column(x, 1)[own])) & (high >= F::every(swept.column(x, 0)[own]));
        }
        unsigned int mask = F::to_mask(overlap);
        if (end - at < 16)
            mask &= (1u << (end - at)) - 1;
        for (; mask != 0; mask &= mask - 1)
            found.data[count++] = at + __builtin_ctz(mask);
        at += 16;
    }
    if (at < end && !(start[at] <= last))
        at = end;
    return count;
}
