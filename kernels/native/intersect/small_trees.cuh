// Leaves of two small trees in a warp's shared memory, where its stack lies otherwise. On the CPU a warp is one thread.
#pragma once
#include "builtin.h"
#include "base/sizes.h"

inline CUDA_CALLABLE wp::int32 read_number(wp::uint64 items, wp::int32 i) {
#if defined(__CUDA_ARCH__)
    int x;
    asm volatile("ld.shared.b32 %0, [%1];" : "=r"(x) : "r"((unsigned int)items + 4 * i) : "memory");
    return x;
#else
    return ((const int*)items)[i];
#endif
}

inline CUDA_CALLABLE void write_number(wp::uint64 items, wp::int32 i, bool flag, wp::int32 x) {
#if defined(__CUDA_ARCH__)
    asm volatile("{ .reg .pred used; setp.ne.s32 used, %0, 0; @used st.shared.b32 [%1], %2; }" ::"r"((int)flag),
                 "r"((unsigned int)items + 4 * i), "r"(x)
                 : "memory");
#else
    if (flag)
        ((int*)items)[i] = x;
#endif
}

inline CUDA_CALLABLE wp::vec_t<4, wp::float32> read_quarter(wp::uint64 items, wp::int32 i) {
#if defined(__CUDA_ARCH__)
    float x, y, z, w;
    asm volatile("ld.shared.v4.f32 {%0, %1, %2, %3}, [%4];"
                 : "=f"(x), "=f"(y), "=f"(z), "=f"(w)
                 : "r"((unsigned int)items + 16 * i)
                 : "memory");
    return wp::vec_t<4, wp::float32>(x, y, z, w);
#else
    const float* p = (const float*)items + 4 * i;
    return wp::vec_t<4, wp::float32>(p[0], p[1], p[2], p[3]);
#endif
}

inline CUDA_CALLABLE void write_quarter(wp::uint64 items, wp::int32 i, bool flag, wp::vec_t<4, wp::float32> x) {
#if defined(__CUDA_ARCH__)
    asm volatile(
        "{ .reg .pred used; setp.ne.s32 used, %0, 0; @used st.shared.v4.f32 [%1], {%2, %3, %4, %5}; }" ::"r"((int)flag),
        "r"((unsigned int)items + 16 * i), "f"(x[0]), "f"(x[1]), "f"(x[2]), "f"(x[3])
        : "memory");
#else
    float* p = (float*)items + 4 * i;
    for (int k = 0; flag && k < 4; ++k)
        p[k] = x[k];
#endif
}

inline CUDA_CALLABLE bool spans_overlap(wp::vec_t<3, wp::float32> a, wp::vec_t<3, wp::float32> b,
                                        wp::vec_t<3, wp::float32> c, wp::vec_t<3, wp::float32> d) {
    return (a[0] <= d[0]) & (a[1] <= d[1]) & (a[2] <= d[2]) & (c[0] <= b[0]) & (c[1] <= b[1]) & (c[2] <= b[2]);
}

inline CUDA_CALLABLE wp::int32 read_half(wp::uint64 items, wp::int32 i) {
#if defined(__CUDA_ARCH__)
    unsigned short x;
    asm volatile("ld.shared.u16 %0, [%1];" : "=h"(x) : "r"((unsigned int)items + 2 * i) : "memory");
    return x;
#else
    return ((const unsigned short*)items)[i];
#endif
}

inline CUDA_CALLABLE void push_half(wp::uint64 items, wp::int32 end, bool flag, wp::int32 x) {
#if defined(__CUDA_ARCH__)
    const unsigned int votes = __ballot_sync(0xffffffffu, flag);
    const unsigned int at = end + __popc(votes & ((1u << threadIdx.x) - 1u));
    if (flag)
        asm volatile("st.shared.u16 [%0], %1;" ::"r"((unsigned int)items + 2 * at), "h"((unsigned short)x) : "memory");
#else
    if (flag)
        ((unsigned short*)items)[end] = x;
#endif
}

inline CUDA_CALLABLE wp::int32 reserve_run(wp::array_t<wp::int32> total, wp::int32 count) {
#if defined(__CUDA_ARCH__)
    int start = 0;
    if (threadIdx.x == 0)
        start = atomicAdd(total.data, count);
    return __shfl_sync(0xffffffffu, start, 0);
#else
    const int start = total.data[0];
    total.data[0] = start + count;
    return start;
#endif
}

inline CUDA_CALLABLE wp::uint32 compare_boxes(wp::uint64 items, wp::int32 rows, wp::vec_t<3, wp::float32> lower,
                                              wp::vec_t<3, wp::float32> upper, wp::vec_t<3, wp::float32> posed_lower,
                                              wp::vec_t<3, wp::float32> posed_upper) {
    unsigned int bits = 0;
#if defined(__CUDA_ARCH__)
    const unsigned int first = items;
    // What lies behind the last row is read, too, and its bits are left out.
    for (int row = 0; row < rows; row += 2)
#pragma unroll
        for (int k = 0; k < 2; ++k) {
            float x[12];
#pragma unroll
            for (int q = 0; q < 3; ++q)
                asm volatile("ld.shared.v4.f32 {%0, %1, %2, %3}, [%4];"
                             : "=f"(x[4 * q]), "=f"(x[4 * q + 1]), "=f"(x[4 * q + 2]), "=f"(x[4 * q + 3])
                             : "r"(first + 48 * (row + k) + 16 * q));
#else
    for (int row = 0; row < rows; ++row) {
        const int k = 0;
        const float* x = (const float*)items + 12 * row;
#endif
            bool overlap = true;
            for (int i = 0; i < 3; ++i) {
                overlap &= (x[i] <= posed_upper[i]) & (posed_lower[i] <= x[3 + i]);
                overlap &= (x[6 + i] <= upper[i]) & (lower[i] <= x[9 + i]);
            }
            bits |= overlap ? 1u << (row + k) : 0u;
        }
    return rows < 32 ? bits & ((1u << rows) - 1u) : bits;
}
