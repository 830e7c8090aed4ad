// Leaves of two small trees in a warp's shared memory, where its stack lies otherwise. On the CPU a warp is one thread.
#pragma once
#include "builtin.h"
#include "sizes.h"

inline CUDA_CALLABLE wp::int32 rank_flag(bool flag) {
#if defined(__CUDA_ARCH__)
    const unsigned int votes = __ballot_sync(0xffffffffu, flag);
    return __popc(votes) << 16 | __popc(votes & ((1u << threadIdx.x) - 1u));
#else
    return flag << 16;
#endif
}

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

inline CUDA_CALLABLE wp::int32 push_leaf_pair(wp::uint64 items, wp::int32 end, bool flag, wp::int32 face_a,
                                              wp::int32 face_b) {
#include "sizes.h"
#if defined(__CUDA_ARCH__)
    const unsigned int votes = __ballot_sync(0xffffffffu, flag);
    const unsigned int at = STACK_LENGTH + end + __popc(votes & ((1u << threadIdx.x) - 1u));
    asm volatile(
        "{ .reg .pred used; setp.ne.s32 used, %0, 0; @used st.shared.v2.b32 [%1], {%2, %3}; }" ::"r"((int)flag),
        "r"((unsigned int)items + 8 * at), "r"(face_b), "r"(face_a)
        : "memory");
    return end + __popc(votes);
#else
    if (flag)
        ((long long*)items)[STACK_LENGTH + end] = ((long long)face_a << 32) | (unsigned int)face_b;
    return end + flag;
#endif
}
