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

inline CUDA_CALLABLE wp::int32 resolve_lane() { return warp_lane() & 31; }

inline CUDA_CALLABLE void warp_sync() {
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
}

inline CUDA_CALLABLE void block_sync() {
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
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

inline CUDA_CALLABLE wp::uint32 vote_lanes(bool flag) {
#if defined(__CUDA_ARCH__)
    return __ballot_sync(0xffffffffu, flag);
#else
    return flag;
#endif
}

inline CUDA_CALLABLE bool warp_any(bool flag) {
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffffu, flag);
#else
    return flag;
#endif
}

inline CUDA_CALLABLE wp::int32 count_lanes(bool flag) { return count_set_bits(vote_lanes(flag)); }

inline CUDA_CALLABLE wp::int32 first_lane(bool flag) {
    const unsigned int votes = vote_lanes(flag);
    return votes == 0 ? warp_size() : lowest_bit(votes);
}

inline CUDA_CALLABLE wp::int32 lane_in_turn(bool flag, bool backward) {
#if defined(__CUDA_ARCH__)
    const unsigned int votes = __ballot_sync(0xffffffffu, flag);
    return backward ? 31 - __clz(votes) : __ffs(votes) - 1;
#else
    return flag ? 0 : -1;
#endif
}

inline CUDA_CALLABLE wp::int32 next_place(wp::int32& end, bool flag) {
    const unsigned int votes = vote_lanes(flag);
    const wp::int32 place = end + count_set_bits(votes & ((1u << resolve_lane()) - 1u));
    end += count_set_bits(votes);
    return place;
}

template <class Number>
CUDA_CALLABLE Number number_of_lane(Number x, int lane) {
#if defined(__CUDA_ARCH__)
    return __shfl_sync(0xffffffffu, x, lane);
#else
    return x;
#endif
}

inline CUDA_CALLABLE wp::int32 value_of_lane(wp::int32 x, wp::int32 lane) { return number_of_lane(x, lane); }

inline CUDA_CALLABLE wp::int32 hold_uniform(wp::int32 x) { return number_of_lane(x, 0); }

inline CUDA_CALLABLE wp::vec3 vector_of_lane(wp::vec3 x, wp::int32 lane) {
    return wp::vec3(number_of_lane(x[0], lane), number_of_lane(x[1], lane), number_of_lane(x[2], lane));
}

// What all lanes have, joined two at a time.
template <class Number, class Join>
CUDA_CALLABLE Number join_lanes(Number x, Join join) {
#if defined(__CUDA_ARCH__)
    for (int step = 16; step > 0; step >>= 1)
        x = join(x, (Number)__shfl_xor_sync(0xffffffffu, x, step));
#endif
    return x;
}

template <class Number>
CUDA_CALLABLE Number sum_lanes(Number x) {
    return join_lanes(x, [](Number a, Number b) { return a + b; });
}

template <class Number>
CUDA_CALLABLE Number least_of_lanes(Number x) {
    return join_lanes(x, [](Number a, Number b) { return wp::min(a, b); });
}

inline CUDA_CALLABLE wp::int32 warp_sum(wp::int32 x) { return sum_lanes(x); }

inline CUDA_CALLABLE wp::float64 warp_min(wp::float64 x) { return least_of_lanes(x); }

inline CUDA_CALLABLE wp::int64 warp_min_item(wp::int64 x) { return least_of_lanes(x); }

inline CUDA_CALLABLE wp::float64 warp_max(wp::float64 x) {
    return join_lanes(x, [](double a, double b) { return wp::max(a, b); });
}

inline CUDA_CALLABLE wp::float32 warp_min32(wp::float32 x) {
    return join_lanes(x, [](float a, float b) { return b < a ? b : a; });
}
