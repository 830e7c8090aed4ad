// The threads of a block at work for one object pair. On the CPU a block is one thread.
#pragma once
#include "builtin.h"

inline CUDA_CALLABLE wp::int32 group_size() {
#if defined(__CUDA_ARCH__)
    return blockDim.x;
#else
    return 1;
#endif
}

inline CUDA_CALLABLE wp::int32 group_lane() {
#if defined(__CUDA_ARCH__)
    return threadIdx.x;
#else
    return 0;
#endif
}

inline CUDA_CALLABLE void group_sync() {
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
}

inline CUDA_CALLABLE bool group_any(bool flag) {
#if defined(__CUDA_ARCH__)
    return __syncthreads_or(flag);
#else
    return flag;
#endif
}

// The greatest number of a warp, and the item of a lane that has it, the least of several.
template <class Number>
CUDA_CALLABLE void find_greatest_of_warp(Number& x, int& item) {
#if defined(__CUDA_ARCH__)
    for (int step = 16; step > 0; step >>= 1) {
        const Number y = __shfl_xor_sync(0xffffffffu, x, step);
        const int other = __shfl_xor_sync(0xffffffffu, item, step);
        item = y > x || (y == x && other < item) ? other : item;
        x = wp::max(x, y);
    }
#endif
}

// The greatest number of all threads, and its item.
template <class Number>
CUDA_CALLABLE void find_greatest(Number& x, int& item) {
#if defined(__CUDA_ARCH__)
    __shared__ Number values[32];
    __shared__ int items[32];
    const int warps = blockDim.x >> 5;
    find_greatest_of_warp(x, item);
    __syncthreads();
    if ((threadIdx.x & 31) == 0) {
        values[threadIdx.x >> 5] = x;
        items[threadIdx.x >> 5] = item;
    }
    __syncthreads();
    for (int k = 0; k < warps; ++k) {
        item = values[k] > x || (values[k] == x && items[k] < item) ? items[k] : item;
        x = wp::max(x, values[k]);
    }
#endif
}

inline CUDA_CALLABLE wp::float64 greatest_of_group(wp::float64 x) {
    int item = 0;
    find_greatest(x, item);
    return x;
}

inline CUDA_CALLABLE wp::int32 next_place_of_group(wp::int32& end, bool flag) {
    wp::int32 place = end;
#if defined(__CUDA_ARCH__)
    __shared__ int counts[32];
    const unsigned int votes = __ballot_sync(0xffffffffu, flag);
    int before = __popc(votes & ((1u << (threadIdx.x & 31)) - 1u)), total = 0;
    __syncthreads();
    if ((threadIdx.x & 31) == 0)
        counts[threadIdx.x >> 5] = __popc(votes);
    __syncthreads();
    for (int k = 0; k < blockDim.x >> 5; ++k) {
        before += k < threadIdx.x >> 5 ? counts[k] : 0;
        total += counts[k];
    }
    place += before;
    end += total;
#else
    end += flag;
#endif
    return place;
}
