// The lists of a search for the nearest faces on the CPU: before the first step, and of faces that wait for float64.
#pragma once
#include "builtin.h"
#include "distance/memory.h"

inline void open_search(wp::float32 upper, bool found, bool diving, wp::int64 first, wp::int32 thread,
                        wp::array_t<wp::float32> memory) {
    const NearestMemory m = NearestMemory::find(memory.data, thread);
    NearestMemory::Header& h = *m.header;
    h = NearestMemory::Header{};
    h.upper = upper;
    h.found = found;
    h.diving = diving;
    h.top = 1;
    m.item[0] = first;
    m.bound[0] = 0.0f;
}

inline wp::int64 take_nearest(wp::float32 upper, wp::int32 thread, wp::array_t<wp::float32> memory) {
    const NearestMemory m = NearestMemory::find(memory.data, thread);
    NearestMemory::Header& h = *m.header;
    h.upper = upper < h.upper ? upper : h.upper;
    if (h.open_count == 0)
        return -1;
    int best = 0;
    for (int i = 1; i < h.open_count; ++i)
        best = m.open_bound[i] < m.open_bound[best] ? i : best;
    // Not under a tolerance: node pairs were dropped for faces that wait here.
    if (m.open_bound[best] > h.upper) {
        h.open_count = 0;
        return -1;
    }
    const wp::int64 item = m.open[best];
    m.open[best] = m.open[--h.open_count];
    m.open_bound[best] = m.open_bound[h.open_count];
    return item;
}
