// Messages between the blocks that make the slabs of one tree state.
#pragma once
#include "builtin.h"

inline CUDA_CALLABLE bool is_last_block(wp::array_t<wp::int32> ended, wp::int32 i, wp::int32 amount, wp::int32 whole) {
#if defined(__CUDA_ARCH__)
    __shared__ bool last;
    __syncthreads();
    if (threadIdx.x == 0) {
        __threadfence();
        last = atomicAdd(ended.data + i, amount) + amount == whole;
        __threadfence();
    }
    __syncthreads();
    const bool answer = last;
    __syncthreads();
    return answer;
#else
    ended.data[i] += amount;
    return ended.data[i] == whole;
#endif
}

inline CUDA_CALLABLE wp::vec_t<4, wp::float32> load_written(wp::array_t<wp::vec_t<4, wp::float32>> values,
                                                            wp::int64 i) {
#if defined(__CUDA_ARCH__)
    // Past the first-level cache, which other blocks' stores do not reach.
    const float4 x = __ldcg((const float4*)values.data + i);
    return wp::vec_t<4, wp::float32>(x.x, x.y, x.z, x.w);
#else
    return values.data[i];
#endif
}
