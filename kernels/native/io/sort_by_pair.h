// Hits in order on the CPU: by object pair in one pass, then each pair's faces by their digits, in the caches.
#pragma once
#include "builtin.h"
#include "base/radix.h"

inline void sort_by_pair(wp::int32 count, wp::int32 pair_mask, wp::int32 flag, wp::array_t<wp::vec3i> face,
                         wp::array_t<wp::int64> key, wp::array_t<wp::vec3i> sorted, wp::array_t<wp::int32> start) {
    typedef unsigned long long word;
    const int pairs = start.shape[0] - 1;
    // Faces and the pair's flag in one word, by pairs; `start` counts to where each ends meanwhile.
    word *one = (word*)key.data, *other = one + key.shape[0] / 2;
    for (int p = 0; p <= pairs; ++p)
        start.data[p] = 0;
    for (int i = 0; i < count; ++i)
        ++start.data[face.data[i][0] & pair_mask];
    for (int p = 0, sum = 0; p <= pairs; ++p) {
        const int own = start.data[p];
        start.data[p] = sum;
        sum += own;
    }
    for (int i = 0; i < count; ++i) {
        const wp::vec3i& row = face.data[i];
        const word second = 2u * (unsigned int)row[2] + (row[0] & flag ? 1u : 0u);
        one[start.data[row[0] & pair_mask]++] = (word)(unsigned int)row[1] << 32 | second;
    }
    for (int p = pairs; p > 0; --p)
        start.data[p] = start.data[p - 1];
    start.data[0] = 0;
    for (int p = 0; p < pairs; ++p) {
        const int first = start.data[p], length = start.data[p + 1] - first;
        const word* from = sort_words(one + first, other + first, length, 0);
        for (int i = 0; i < length; ++i)
            sorted.data[first + i] = wp::vec3i(p | (from[i] & 1 ? flag : 0), (wp::int32)(from[i] >> 32),
                                               (wp::int32)((unsigned int)from[i] >> 1));
    }
}

inline void sort_span(wp::int32 first, wp::int32 last, wp::array_t<wp::int64> key, wp::array_t<wp::int32> order) {
    typedef unsigned long long word;
    constexpr word LOW = 0x7fffffff;
    word* const words = (word*)key.data + first;
    const word high = words[0] & ~LOW;
    for (int i = 0; i < last - first; ++i)
        words[i] = (words[i] & LOW) << 32 | (unsigned int)order.data[first + i];
    const word* const sorted = sort_words(words, words + key.shape[0] / 2, last - first, 32);
    for (int i = 0; i < last - first; ++i) {
        order.data[first + i] = (wp::int32)sorted[i];
        words[i] = high | sorted[i] >> 32;
    }
}
