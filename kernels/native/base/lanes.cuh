// Lanes of a warp: votes, counts, sums and extremes. On the CPU a warp is one thread.
#pragma once
#include "builtin.h"

inline CUDA_CALLABLE wp::int32 warp_size() {
#if defined(__CUDA_ARCH__)
    return 32;
#else
    return 1;
#endif
}

inline CUDA_CALLABLE wp::int32 warp_lane() {
#if defined(__CUDA_ARCH__)
    return threadIdx.x;
#else
    return 0;
#endif
}

inline CUDA_CALLABLE wp::int32 resolve_lane() {
#if defined(__CUDA_ARCH__)
    return threadIdx.x & 31;
#else
    return 0;
#endif
}

inline CUDA_CALLABLE void warp_sync() {
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
}

inline CUDA_CALLABLE wp::int32 hold_uniform(wp::int32 x) {
#if defined(__CUDA_ARCH__)
    return __shfl_sync(0xffffffffu, x, 0);
#else
    return x;
#endif
}

inline CUDA_CALLABLE bool warp_any(bool flag) {
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffffu, flag);
#else
    return flag;
#endif
}

inline CUDA_CALLABLE wp::int32 warp_sum(wp::int32 x) {
#if defined(__CUDA_ARCH__)
    for (int step = 16; step > 0; step >>= 1)
        x += __shfl_xor_sync(0xffffffffu, x, step);
#endif
    return x;
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

inline CUDA_CALLABLE wp::int32 count_set_bits(wp::int32 bits) {
#if defined(__CUDA_ARCH__)
    return __popc(bits);
#else
    return __builtin_popcount(bits);
#endif
}

inline CUDA_CALLABLE wp::float64 warp_min(wp::float64 x) {
#if defined(__CUDA_ARCH__)
    for (int step = 16; step > 0; step >>= 1)
        x = wp::min(x, __shfl_xor_sync(0xffffffffu, x, step));
#endif
    return x;
}

inline CUDA_CALLABLE wp::int64 warp_min_item(wp::int64 x) {
#if defined(__CUDA_ARCH__)
    for (int step = 16; step > 0; step >>= 1)
        x = wp::min(x, (wp::int64)__shfl_xor_sync(0xffffffffu, (long long)x, step));
#endif
    return x;
}

inline CUDA_CALLABLE wp::float32 warp_min32(wp::float32 x) {
#if defined(__CUDA_ARCH__)
    for (int step = 16; step > 0; step >>= 1) {
        const float other = __shfl_xor_sync(0xffffffffu, x, step);
        x = other < x ? other : x;
    }
#endif
    return x;
}

inline CUDA_CALLABLE wp::int32 next_place(wp::int32& end, bool flag) {
    wp::int32 place = end;
#if defined(__CUDA_ARCH__)
    const unsigned int votes = __ballot_sync(0xffffffffu, flag);
    place += __popc(votes & ((1u << threadIdx.x) - 1u));
    end += __popc(votes);
#else
    end += flag;
#endif
    return place;
}

inline CUDA_CALLABLE wp::int32 value_of_lane(wp::int32 x, wp::int32 lane) {
#if defined(__CUDA_ARCH__)
    return __shfl_sync(0xffffffffu, x, lane);
#else
    return x;
#endif
}

inline CUDA_CALLABLE wp::vec3 vector_of_lane(wp::vec3 x, wp::int32 lane) {
#if defined(__CUDA_ARCH__)
    for (int k = 0; k < 3; ++k)
        x[k] = __shfl_sync(0xffffffffu, x[k], lane);
#endif
    return x;
}

inline CUDA_CALLABLE wp::uint32 vote_lanes(bool flag) {
#if defined(__CUDA_ARCH__)
    return __ballot_sync(0xffffffffu, flag);
#else
    return flag;
#endif
}

inline CUDA_CALLABLE wp::int32 count_lanes(bool flag) {
#if defined(__CUDA_ARCH__)
    return __popc(__ballot_sync(0xffffffffu, flag));
#else
    return flag;
#endif
}

inline CUDA_CALLABLE wp::int32 lane_in_turn(bool flag, bool backward) {
#if defined(__CUDA_ARCH__)
    const unsigned int votes = __ballot_sync(0xffffffffu, flag);
    return backward ? 31 - __clz(votes) : __ffs(votes) - 1;
#else
    return flag ? 0 : -1;
#endif
}

inline CUDA_CALLABLE wp::int32 first_lane(bool flag) {
#if defined(__CUDA_ARCH__)
    const unsigned int votes = __ballot_sync(0xffffffffu, flag);
    return votes == 0 ? 32 : __ffs(votes) - 1;
#else
    return !flag;
#endif
}

inline CUDA_CALLABLE void block_sync() {
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
}
