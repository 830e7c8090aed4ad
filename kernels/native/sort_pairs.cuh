// Hits in order on CUDA: a warp finds where those of its object pairs start, a block sorts those of one. On the CPU
// both are one thread.
#pragma once
#include "builtin.h"
#include "sizes.h"

inline CUDA_CALLABLE wp::int32 warp_sum(wp::int32 x) {
#if defined(__CUDA_ARCH__)
    for (int step = 16; step > 0; step >>= 1)
        x += __shfl_xor_sync(0xffffffffu, x, step);
#endif
    return x;
}

inline CUDA_CALLABLE wp::int32 sum_before(wp::int32 x) {
#if defined(__CUDA_ARCH__)
    const int lane = threadIdx.x & 31;
    int sum = x;
    for (int step = 1; step < 32; step *= 2) {
        const int other = __shfl_up_sync(0xffffffffu, sum, step);
        sum += lane >= step ? other : 0;
    }
    return sum - x;
#else
    return 0;
#endif
}

inline CUDA_CALLABLE wp::int32 take_place(wp::array_t<wp::int32> next, wp::int32 p) {
#if defined(__CUDA_ARCH__)
    // One atomic for the threads of a warp that share a pair; those without one have a negative number.
    const unsigned int same = __match_any_sync(0xffffffffu, p);
    const int lane = threadIdx.x & 31, leader = __ffs(same) - 1;
    int place = 0;
    if (lane == leader && p >= 0)
        place = atomicAdd(next.data + p, __popc(same));
    return __shfl_sync(0xffffffffu, place, leader) + __popc(same & ((1u << lane) - 1u));
#else
    return p < 0 ? 0 : next.data[p]++;
#endif
}

inline CUDA_CALLABLE void sort_block(wp::array_t<wp::int64> key, wp::int32 first, wp::int32 length) {
#if defined(__CUDA_ARCH__)
#include "sizes.h"
    __shared__ long long few[SORT_ROOM];
    const int thread = threadIdx.x, threads = blockDim.x;
#else
    const int thread = 0, threads = 1;
#endif
    long long* keys = (long long*)key.data + first;
#if defined(__CUDA_ARCH__)
    const bool fits = length <= SORT_ROOM;
    if (fits) {
        for (int i = thread; i < length; i += threads)
            few[i] = keys[i];
        keys = few;
        __syncthreads();
    }
#endif
    // Batcher's bitonic sort, all in one direction, so that the places behind the last, which sort last, need not
    // exist.
    for (long long size = 2; size / 2 < length; size *= 2)
        for (long long step = size / 2; step > 0; step /= 2) {
            const long long mirror = step == size / 2 ? size - 1 : step;
            for (long long i = thread; 2 * i - (i & (step - 1)) < length; i += threads) {
                const long long low = 2 * i - (i & (step - 1)), high = low ^ mirror;
                if (high < length && keys[high] < keys[low]) {
                    const long long greater = keys[low];
                    keys[low] = keys[high];
                    keys[high] = greater;
                }
            }
#if defined(__CUDA_ARCH__)
            __syncthreads();
#endif
        }
#if defined(__CUDA_ARCH__)
    if (fits)
        for (int i = thread; i < length; i += threads)
            key.data[first + i] = few[i];
    __syncthreads();
#endif
}

inline CUDA_CALLABLE wp::int32 block_size() {
#if defined(__CUDA_ARCH__)
    return blockDim.x;
#else
    return 1;
#endif
}
