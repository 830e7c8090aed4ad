// Votes, counts and sums over the lanes of a warp. On the CPU a warp is one thread.
#pragma once
#include "builtin.h"

inline CUDA_CALLABLE bool warp_any(bool flag) {
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffffu, flag);
#else
    return flag;
#endif
}

inline CUDA_CALLABLE wp::vec_t<6, wp::float64> add_in_order(wp::vec_t<6, wp::float64> sum, wp::vec_t<6, wp::float64> x,
                                                            wp::int32 count) {
#if defined(__CUDA_ARCH__)
    // A column a lane, and one more so that rows begin in banks of their own; then a row a lane.
    __shared__ double values[6][33];
    const int lane = threadIdx.x, row = lane < 6 ? lane : 5;
    double total = sum[0];
#pragma unroll
    for (int k = 0; k < 6; ++k) {
        values[k][lane] = x[k];
        total = row == k ? sum[k] : total;
    }
    __syncwarp();
    for (int i = 0; i < count; ++i)
        total += values[row][i];
    __syncwarp();
#pragma unroll
    for (int k = 0; k < 6; ++k)
        sum[k] = __shfl_sync(0xffffffffu, total, k);
    return sum;
#else
    for (int k = 0; count > 0 && k < 6; ++k)
        sum[k] += x[k];
    return sum;
#endif
}

inline CUDA_CALLABLE wp::float64 warp_max(wp::float64 x) {
#if defined(__CUDA_ARCH__)
    for (int step = 16; step > 0; step >>= 1)
        x = wp::max(x, __shfl_xor_sync(0xffffffffu, x, step));
#endif
    return x;
}

inline CUDA_CALLABLE wp::int32 lowest_bit(wp::int32 bits) {
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    return __builtin_ctz(bits);
#endif
}

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

inline CUDA_CALLABLE void add_warp_sum(wp::array_t<wp::int64> totals, wp::int32 i, wp::int32 x) {
#if defined(__CUDA_ARCH__)
    long long sum = x;
    for (int step = 16; step > 0; step >>= 1)
        sum += __shfl_down_sync(0xffffffffu, sum, step);
    if (threadIdx.x == 0 && sum != 0)
        atomicAdd((unsigned long long*)totals.data + i, (unsigned long long)sum);
#else
    totals.data[i] += x;
#endif
}

inline CUDA_CALLABLE void count_flags(wp::array_t<wp::int64> totals, wp::int32 i, bool flag) {
#if defined(__CUDA_ARCH__)
    if (!__any_sync(0xffffffffu, flag))
        return;
    unsigned int same = __match_any_sync(0xffffffffu, flag ? i : -1);
    if (flag && (threadIdx.x & 31) + 1 == __ffs(same))
        atomicAdd((unsigned long long*)totals.data + i, (unsigned long long)__popc(same));
#else
    if (flag)
        totals.data[i] += 1;
#endif
}

inline CUDA_CALLABLE void add_lanes(wp::array_t<wp::int64> totals, wp::int32 i, wp::int64 x) {
#if defined(__CUDA_ARCH__)
    long long sum = x;
    for (int step = 16; step > 0; step >>= 1)
        sum += __shfl_down_sync(0xffffffffu, sum, step);
    if ((threadIdx.x & 31) == 0 && sum != 0)
        atomicAdd((unsigned long long*)totals.data + i, (unsigned long long)sum);
#else
    totals.data[i] += x;
#endif
}
