// What the lanes at work on one relative pose share: numbers in shared memory. On the CPU a lane is alone.
#pragma once
#include "builtin.h"
#include "sizes.h"

inline CUDA_CALLABLE wp::int32 pose_lanes() {
#include "sizes.h"
#if defined(__CUDA_ARCH__)
    return POSE_LANES;
#else
    return 1;
#endif
}

inline CUDA_CALLABLE wp::int32 next_entry(wp::int32 k) {
#include "sizes.h"
#if defined(__CUDA_ARCH__)
    return POSE_ENTRIES;
#else
    return k + 1;
#endif
}

inline CUDA_CALLABLE wp::uint64 pose_entries() {
#include "sizes.h"
#if defined(__CUDA_ARCH__)
    __shared__ double entries[WARP_SIZE / POSE_LANES * POSE_ENTRIES];
    return __cvta_generic_to_shared(entries + threadIdx.x / POSE_LANES * POSE_ENTRIES);
#else
    static double entries[POSE_ENTRIES];
    return (wp::uint64)entries;
#endif
}

inline CUDA_CALLABLE wp::float64 read_entry(wp::uint64 entries, wp::int32 i) {
#if defined(__CUDA_ARCH__)
    double x;
    asm volatile("ld.shared.f64 %0, [%1];" : "=d"(x) : "r"((unsigned int)entries + 8 * i) : "memory");
    return x;
#else
    return ((const double*)entries)[i];
#endif
}

inline CUDA_CALLABLE void write_entry(wp::uint64 entries, wp::int32 i, wp::float64 x) {
#if defined(__CUDA_ARCH__)
    asm volatile("st.shared.f64 [%0], %1;" ::"r"((unsigned int)entries + 8 * i), "d"(x) : "memory");
#else
    ((double*)entries)[i] = x;
#endif
}

inline CUDA_CALLABLE wp::float64 pose_lanes_max(wp::float64 x) {
#include "sizes.h"
#if defined(__CUDA_ARCH__)
#pragma unroll
    for (int step = POSE_LANES / 2; step > 0; step >>= 1)
        {
        const double other = __shfl_xor_sync(0xffffffffu, x, step);
        x = other > x ? other : x;
    }
#endif
    return x;
}

inline CUDA_CALLABLE wp::vec_t<3, wp::float64> load_column(wp::array_t<wp::mat_t<3, 3, wp::float64>> matrices,
                                                           wp::int32 i, wp::int32 column) {
    const wp::mat_t<3, 3, wp::float64>& m = matrices.data[i];
    return wp::vec_t<3, wp::float64>(m.data[0][column], m.data[1][column], m.data[2][column]);
}
