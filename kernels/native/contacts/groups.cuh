// The threads of a block at work for one item, be it a warp or several. On the CPU a block is one thread.
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

inline CUDA_CALLABLE bool must_measure(wp::int32 chosen) {
#if defined(__CUDA_ARCH__)
    return true;  // a constant, so that the loop holds no other test: registers are short
#else
    return chosen <= 2;
#endif
}

inline CUDA_CALLABLE void group_sync() {
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
}

inline CUDA_CALLABLE wp::vec_t<2, wp::float64> greatest_of_group(wp::float64 x, wp::int32 item) {
#if defined(__CUDA_ARCH__)
    __shared__ double values[32];
    __shared__ int items[32];
    for (int step = 16; step > 0; step >>= 1) {
        const double y = __shfl_xor_sync(0xffffffffu, x, step);
        const int other = __shfl_xor_sync(0xffffffffu, item, step);
        item = y > x || (y == x && other < item) ? other : item;
        x = wp::max(x, y);
    }
    if (blockDim.x > 32) {
        __syncthreads();
        if ((threadIdx.x & 31) == 0) {
            values[threadIdx.x >> 5] = x;
            items[threadIdx.x >> 5] = item;
        }
        __syncthreads();
        for (int k = 0; k < blockDim.x >> 5; ++k) {
            item = values[k] > x || (values[k] == x && items[k] < item) ? items[k] : item;
            x = wp::max(x, values[k]);
        }
    }
#endif
    return wp::vec_t<2, wp::float64>(x, wp::float64(item));
}

inline CUDA_CALLABLE wp::int32 next_place_of_group(wp::int32& end, bool flag) {
    wp::int32 place = end;
#if defined(__CUDA_ARCH__)
    __shared__ int counts[32];
    const unsigned int votes = __ballot_sync(0xffffffffu, flag);
    int before = __popc(votes & ((1u << (threadIdx.x & 31)) - 1u)), total = __popc(votes);
    if (blockDim.x > 32) {
        __syncthreads();
        if ((threadIdx.x & 31) == 0)
            counts[threadIdx.x >> 5] = total;
        __syncthreads();
        total = 0;
        for (int k = 0; k < blockDim.x >> 5; ++k) {
            before += k < threadIdx.x >> 5 ? counts[k] : 0;
            total += counts[k];
        }
    }
    place += before;
    end += total;
#else
    end += flag;
#endif
    return place;
}
