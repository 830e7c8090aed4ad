// A warp's lists of a search for first contacts: node pairs, face pairs that wait and those that go on, each with a
// tag, its time or its steps, and the slot of its object pair; behind them the times of those that go on.
#pragma once
#include "builtin.h"
#include "search/warp_stack.cuh"

inline CUDA_CALLABLE wp::uint64 motion_stack() {
#if defined(__CUDA_ARCH__)
    __shared__ long long items[MOTION_WORDS];
    return __cvta_generic_to_shared(items);
#else
    static long long items[MOTION_WORDS];
    return (wp::uint64)items;
#endif
}

inline CUDA_CALLABLE wp::float32 read_tag(wp::uint64 items, wp::int32 i) {
    return *entry<volatile float>(items, 2 * MOTION_LENGTH + i);
}

inline CUDA_CALLABLE wp::int32 read_slot(wp::uint64 items, wp::int32 i) {
    return *entry<volatile unsigned char>(items, 8 * (MOTION_TIMES_START + 2 * WARP_SIZE) + i);
}

inline CUDA_CALLABLE void write_entry(wp::uint64 items, wp::int32 i, wp::int64 item, wp::float32 tag, wp::int32 slot) {
    *entry<volatile long long>(items, i) = item;
    *entry<volatile float>(items, 2 * MOTION_LENGTH + i) = tag;
    *entry<volatile unsigned char>(items, 8 * (MOTION_TIMES_START + 2 * WARP_SIZE) + i) = slot;
}

inline CUDA_CALLABLE void write_time(wp::uint64 items, wp::int32 i, wp::float64 time) {
    *entry<volatile double>(items, MOTION_TIMES_START + i) = time;
}
