// A warp's lists in shared memory, and what its lanes do together. On the CPU a warp is one thread.
#pragma once
#include "builtin.h"
#include "base/lanes.cuh"
#include "base/shared.cuh"
#include "base/sizes.h"

inline CUDA_CALLABLE wp::uint64 warp_stack() {
#if defined(__CUDA_ARCH__)
    __shared__ alignas(16) long long items[SLAB_PAIR_START + SLAB_PAIR_LENGTH];
    // Through another lane, so that the address is held and not computed again at every use.
    return __shfl_sync(0xffffffffu, (unsigned int)__cvta_generic_to_shared(items), 0);
#else
    alignas(16) static long long items[SLAB_PAIR_START + SLAB_PAIR_LENGTH];
    return (wp::uint64)items;
#endif
}

inline CUDA_CALLABLE wp::int64 read_item(wp::uint64 items, wp::int32 i) { return *entry<volatile long long>(items, i); }

inline CUDA_CALLABLE void write_item(wp::uint64 items, wp::int32 i, wp::int64 item) {
    *entry<volatile long long>(items, i) = item;
}

inline CUDA_CALLABLE void push_items(wp::uint64 items, wp::int32& end, bool flag, wp::int64 item) {
    const int at = next_place(end, flag);
    if (flag)
        *entry<volatile long long>(items, at & (STACK_LENGTH - 1)) = item;
}

inline CUDA_CALLABLE void push_straddling(wp::uint64 items, wp::int32& end, bool flag, wp::int64 item,
                                          wp::int32 signs) {
    const int at = next_place(end, flag);
    if (flag) {
        *entry<volatile long long>(items, STRADDLING_START + at) = item;
        *entry<volatile int>(items, 2 * SIGNS_START + at) = signs;
    }
}

inline CUDA_CALLABLE wp::int32 read_signs(wp::uint64 items, wp::int32 i) {
    return *entry<volatile int>(items, 2 * SIGNS_START + i);
}

struct alignas(16) SignedPair {
    int first, second, third, signs;
};

inline CUDA_CALLABLE wp::uint64 signed_pairs() {
#if defined(__CUDA_ARCH__)
    __shared__ SignedPair items[RESOLVE_WARPS * STRADDLING_LENGTH];
    return __cvta_generic_to_shared(items + (threadIdx.x >> 5) * STRADDLING_LENGTH);
#else
    static SignedPair items[STRADDLING_LENGTH];
    return (wp::uint64)items;
#endif
}

inline CUDA_CALLABLE void push_signed_pair(wp::uint64 list, wp::int32& end, bool flag, wp::vec_t<3, wp::int32> item,
                                           wp::int32 signs) {
    const int at = next_place(end, flag);
    if (flag)
        *entry<SignedPair>(list, at) = SignedPair{item[0], item[1], item[2], signs};
}

inline CUDA_CALLABLE wp::int32 read_signed_pair(wp::uint64 list, wp::int32 i, wp::vec_t<3, wp::int32>& item) {
    const SignedPair x = *entry<SignedPair>(list, i);
    item = wp::vec_t<3, wp::int32>(x.first, x.second, x.third);
    return x.signs;
}
