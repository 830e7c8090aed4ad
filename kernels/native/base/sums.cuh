// Sums of several numbers over the lanes of a warp, one lane after the other. On the CPU a warp is one thread.
#pragma once
#include "builtin.h"
#include "base/sizes.h"

// In a block of one warp.
template <unsigned COUNT>
CUDA_CALLABLE wp::vec_t<COUNT, wp::float64> add_in_order(wp::vec_t<COUNT, wp::float64> sum,
                                                         wp::vec_t<COUNT, wp::float64> x, wp::int32 count) {
#if defined(__CUDA_ARCH__)
    // A column a lane, and one more so that rows begin in banks of their own; then a row a lane.
    __shared__ double values[COUNT][33];
    const int lane = threadIdx.x, row = lane < COUNT ? lane : COUNT - 1;
    double total = sum[0];
#pragma unroll
    for (int k = 0; k < COUNT; ++k) {
        values[k][lane] = x[k];
        total = row == k ? sum[k] : total;
    }
    __syncwarp();
    for (int i = 0; i < count; ++i)
        total += values[row][i];
    __syncwarp();
#pragma unroll
    for (int k = 0; k < COUNT; ++k)
        sum[k] = __shfl_sync(0xffffffffu, total, k);
    return sum;
#else
    for (int k = 0; count > 0 && k < COUNT; ++k)
        sum[k] += x[k];
    return sum;
#endif
}

inline CUDA_CALLABLE wp::vec_t<9, wp::float64> add_nine_in_order(wp::vec_t<9, wp::float64> sum,
                                                                 wp::vec_t<9, wp::float64> x, wp::int32 count) {
    return add_in_order(sum, x, count);
}
