// A warp's lists of a search for first contacts: node pairs, face pairs that wait and those that go on, each with a
// tag, its time or its steps, and the slot of its object pair; behind them the times of those that go on.
#pragma once
#include "builtin.h"
#include "search/warp_stack.cuh"

inline CUDA_CALLABLE wp::uint64 motion_stack() {
#if defined(__CUDA_ARCH__)
    __shared__ long long items[MOTION_WORDS];
    return __cvta_generic_to_shared(items);
#else
    static long long items[MOTION_WORDS];
    return (wp::uint64)items;
#endif
}

inline CUDA_CALLABLE wp::float32 read_tag(wp::uint64 items, wp::int32 i) {
#if defined(__CUDA_ARCH__)
    float tag;
    asm volatile("ld.shared.f32 %0, [%1];"
                 : "=f"(tag)
                 : "r"((unsigned int)items + 8 * MOTION_LENGTH + 4 * i)
                 : "memory");
    return tag;
#else
    return ((const float*)((const long long*)items + MOTION_LENGTH))[i];
#endif
}

inline CUDA_CALLABLE wp::int32 read_slot(wp::uint64 items, wp::int32 i) {
#if defined(__CUDA_ARCH__)
    unsigned int slot;
    asm volatile("ld.shared.u8 %0, [%1];"
                 : "=r"(slot)
                 : "r"((unsigned int)items + 8 * (MOTION_TIMES_START + 2 * WARP_SIZE) + i)
                 : "memory");
    return slot;
#else
    return ((const unsigned char*)((const long long*)items + MOTION_TIMES_START + 2 * WARP_SIZE))[i];
#endif
}

inline CUDA_CALLABLE void write_entry(wp::uint64 items, wp::int32 i, wp::int64 item, wp::float32 tag, wp::int32 slot) {
#if defined(__CUDA_ARCH__)
    const unsigned int start = items;
    asm volatile("st.shared.b64 [%0], %1; st.shared.f32 [%2], %3; st.shared.u8 [%4], %5;" ::"r"(start + 8 * i),
                 "l"((long long)item), "r"(start + 8 * MOTION_LENGTH + 4 * i), "f"(tag),
                 "r"(start + 8 * (MOTION_TIMES_START + 2 * WARP_SIZE) + i), "r"(slot)
                 : "memory");
#else
    long long* const start = (long long*)items;
    start[i] = item;
    ((float*)(start + MOTION_LENGTH))[i] = tag;
    ((unsigned char*)(start + MOTION_TIMES_START + 2 * WARP_SIZE))[i] = slot;
#endif
}

inline CUDA_CALLABLE void write_time(wp::uint64 items, wp::int32 i, wp::float64 time) {
#if defined(__CUDA_ARCH__)
    asm volatile("st.shared.f64 [%0], %1;" ::"r"((unsigned int)items + 8 * (MOTION_TIMES_START + i)), "d"(time)
                 : "memory");
#else
    ((double*)items)[MOTION_TIMES_START + i] = time;
#endif
}

inline CUDA_CALLABLE wp::int32 place_in(wp::int32 end, bool flag) {
#if defined(__CUDA_ARCH__)
    return end + __popc(__ballot_sync(0xffffffffu, flag) & ((1u << threadIdx.x) - 1u));
#else
    return end;
#endif
}

inline CUDA_CALLABLE wp::int32 end_after(wp::int32 end, bool flag) {
#if defined(__CUDA_ARCH__)
    return end + __popc(__ballot_sync(0xffffffffu, flag));
#else
    return end + flag;
#endif
}
