// Counters and totals in memory, which the lanes of a warp add to by one atomic. On the CPU a warp is one thread.
#pragma once
#include "builtin.h"
#include "base/lanes.cuh"

inline CUDA_CALLABLE wp::int32 reserve_slot(wp::array_t<wp::int32> total, bool flag) {
#if defined(__CUDA_ARCH__)
    unsigned int votes = __ballot_sync(0xffffffffu, flag);
    if (votes == 0)
        return 0;
    int lane = threadIdx.x & 31;
    int leader = __ffs(votes) - 1;
    int start = 0;
    if (lane == leader)
        start = atomicAdd(total.data, __popc(votes));
    start = __shfl_sync(0xffffffffu, start, leader);
    return start + __popc(votes & ((1u << lane) - 1u));
#else
    int start = total.data[0];
    if (flag)
        total.data[0] = start + 1;
    return start;
#endif
}

inline CUDA_CALLABLE wp::int32 take_slots(wp::array_t<wp::int32> total, wp::int32 count) {
#if defined(__CUDA_ARCH__)
    return atomicAdd(total.data, count);
#else
    return __atomic_fetch_add(total.data, count, __ATOMIC_RELAXED);
#endif
}

inline CUDA_CALLABLE wp::int32 take_once(wp::array_t<wp::int32> counts, wp::int32 i, wp::int32 count) {
#if defined(__CUDA_ARCH__)
    return resolve_lane() == 0 ? atomicAdd(counts.data + i, count) : 0;
#else
    return __atomic_fetch_add(counts.data + i, count, __ATOMIC_RELAXED);
#endif
}

inline CUDA_CALLABLE void wait_for_counts(wp::array_t<wp::int32> counts, wp::vec2i ids, wp::vec2i values) {
#if defined(__CUDA_ARCH__)
    const int lane = resolve_lane(), least = lane == 0 ? values[0] : lane == 1 ? values[1] : 0;
    int* count = counts.data + (lane == 0 ? ids[0] : ids[1]);
    if (least > 0)
        while (__nv_atomic_load_n(count, __NV_ATOMIC_ACQUIRE, __NV_THREAD_SCOPE_DEVICE) < least)
            __nanosleep(20);
    __syncwarp();
#endif
}

inline CUDA_CALLABLE void publish_counts(wp::array_t<wp::int32> counts, wp::vec2i ids, wp::vec2i values) {
#if defined(__CUDA_ARCH__)
    const int lane = resolve_lane(), value = lane == 0 ? values[0] : lane == 1 ? values[1] : 0;
    __syncwarp();
    if (value > 0)
        __nv_atomic_store_n(counts.data + (lane == 0 ? ids[0] : ids[1]), value, __NV_ATOMIC_RELEASE,
                            __NV_THREAD_SCOPE_DEVICE);
#endif
}

inline CUDA_CALLABLE void add_lanes(wp::array_t<wp::int64> totals, wp::int32 i, wp::int64 x) {
    const long long sum = sum_lanes((long long)x);
#if defined(__CUDA_ARCH__)
    if (resolve_lane() == 0 && sum != 0)
        atomicAdd((unsigned long long*)totals.data + i, (unsigned long long)sum);
#else
    totals.data[i] += sum;
#endif
}

inline CUDA_CALLABLE void count_flags(wp::array_t<wp::int64> totals, wp::int32 i, bool flag) {
#if defined(__CUDA_ARCH__)
    if (!__any_sync(0xffffffffu, flag))
        return;
    unsigned int same = __match_any_sync(0xffffffffu, flag ? i : -1);
    if (flag && resolve_lane() == lowest_bit(same))
        atomicAdd((unsigned long long*)totals.data + i, (unsigned long long)__popc(same));
#else
    if (flag)
        totals.data[i] += 1;
#endif
}

inline CUDA_CALLABLE bool ends_launch(wp::array_t<wp::int32> ended, wp::int32 threads) {
#if defined(__CUDA_ARCH__)
    // The first lane adds for its warp.
    if (resolve_lane() != 0)
        return false;
    __threadfence();
    if (atomicAdd(ended.data, 1) + 1 != threads / 32)
        return false;
    __threadfence();
#else
    if (++ended.data[0] != threads)
        return false;
#endif
    ended.data[0] = 0;
    return true;
}
