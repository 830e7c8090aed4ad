// A warp's lists in shared memory, and what its lanes do together. On the CPU a warp is one thread.
#pragma once
#include "builtin.h"
#include "base/sizes.h"

inline CUDA_CALLABLE wp::uint64 warp_stack() {
#if defined(__CUDA_ARCH__)
    __shared__ long long items[SLAB_PAIR_START + SLAB_PAIR_LENGTH];
    // Through another lane, so that the address is held and not computed again at every use.
    return __shfl_sync(0xffffffffu, (unsigned int)__cvta_generic_to_shared(items), 0);
#else
    static long long items[SLAB_PAIR_START + SLAB_PAIR_LENGTH];
    return (wp::uint64)items;
#endif
}

inline CUDA_CALLABLE wp::int64 read_item(wp::uint64 items, wp::int32 i) {
#if defined(__CUDA_ARCH__)
    long long item;
    asm volatile("ld.shared.b64 %0, [%1];" : "=l"(item) : "r"((unsigned int)items + 8 * i) : "memory");
    return item;
#else
    return ((const long long*)items)[i];
#endif
}

inline CUDA_CALLABLE void write_item(wp::uint64 items, wp::int32 i, wp::int64 item) {
#if defined(__CUDA_ARCH__)
    asm volatile("st.shared.b64 [%0], %1;" ::"r"((unsigned int)items + 8 * i), "l"(item) : "memory");
#else
    ((long long*)items)[i] = item;
#endif
}

inline CUDA_CALLABLE wp::int32 push_items(wp::uint64 items, wp::int32 end, bool flag, wp::int64 item) {
#if defined(__CUDA_ARCH__)
    const unsigned int votes = __ballot_sync(0xffffffffu, flag);
    const unsigned int at = (end + __popc(votes & ((1u << threadIdx.x) - 1u))) & (STACK_LENGTH - 1);
    asm volatile("{ .reg .pred used; setp.ne.s32 used, %0, 0; @used st.shared.b64 [%1], %2; }" ::"r"((int)flag),
                 "r"((unsigned int)items + 8 * at), "l"(item)
                 : "memory");
    return end + __popc(votes);
#else
    if (flag)
        ((long long*)items)[end & (STACK_LENGTH - 1)] = item;
    return end + flag;
#endif
}

inline CUDA_CALLABLE wp::int32 push_straddling(wp::uint64 items, wp::int32 end, bool flag, wp::int64 item,
                                               wp::int32 signs) {
#if defined(__CUDA_ARCH__)
    const unsigned int votes = __ballot_sync(0xffffffffu, flag);
    const unsigned int at = end + __popc(votes & ((1u << threadIdx.x) - 1u)), start = items;
    asm volatile(
        "{ .reg .pred used; setp.ne.s32 used, %0, 0;"
        " @used st.shared.b64 [%1], %2; @used st.shared.b32 [%3], %4; }" ::"r"((int)flag),
        "r"(start + 8 * (STRADDLING_START + at)), "l"(item), "r"(start + 8 * SIGNS_START + 4 * at), "r"(signs)
        : "memory");
    return end + __popc(votes);
#else
    if (flag) {
        ((long long*)items)[STRADDLING_START + end] = item;
        ((int*)items)[2 * SIGNS_START + end] = signs;
    }
    return end + flag;
#endif
}

inline CUDA_CALLABLE wp::int32 read_signs(wp::uint64 items, wp::int32 i) {
#if defined(__CUDA_ARCH__)
    int signs;
    asm volatile("ld.shared.b32 %0, [%1];"
                 : "=r"(signs)
                 : "r"((unsigned int)items + 8 * SIGNS_START + 4 * i)
                 : "memory");
    return signs;
#else
    return ((const int*)items)[2 * SIGNS_START + i];
#endif
}

inline CUDA_CALLABLE wp::uint64 signed_pairs() {
#if defined(__CUDA_ARCH__)
    __shared__ int4 items[RESOLVE_WARPS * STRADDLING_LENGTH];
    return __cvta_generic_to_shared(items + (threadIdx.x >> 5) * STRADDLING_LENGTH);
#else
    static int items[STRADDLING_LENGTH * 4];
    return (wp::uint64)items;
#endif
}

inline CUDA_CALLABLE wp::int32 push_signed_pair(wp::uint64 list, wp::int32 end, bool flag, wp::vec_t<3, wp::int32> item,
                                                wp::int32 signs) {
#if defined(__CUDA_ARCH__)
    const unsigned int votes = __ballot_sync(0xffffffffu, flag);
    const unsigned int below = (1u << (threadIdx.x & 31)) - 1u;
    const unsigned int at = (unsigned int)list + 16 * (end + __popc(votes & below));
    if (flag)
        asm volatile("st.shared.v4.b32 [%0], {%1, %2, %3, %4};" ::"r"(at), "r"(item[0]), "r"(item[1]), "r"(item[2]),
                     "r"(signs)
                     : "memory");
    return end + __popc(votes);
#else
    int* to = (int*)list + 4 * end;
    for (int k = 0; flag && k < 4; ++k)
        to[k] = k < 3 ? item[k] : signs;
    return end + flag;
#endif
}

inline CUDA_CALLABLE wp::vec_t<4, wp::int32> read_signed_pair(wp::uint64 list, wp::int32 i) {
    wp::vec_t<4, wp::int32> x;
#if defined(__CUDA_ARCH__)
    asm volatile("ld.shared.v4.b32 {%0, %1, %2, %3}, [%4];"
                 : "=r"(x[0]), "=r"(x[1]), "=r"(x[2]), "=r"(x[3])
                 : "r"((unsigned int)list + 16 * i)
                 : "memory");
#else
    for (int k = 0; k < 4; ++k)
        x[k] = ((const int*)list)[4 * i + k];
#endif
    return x;
}
