// Comparisons without branches, loads that the compiler would not widen by itself, and stores at any byte.
#pragma once
#include "builtin.h"
#include "base/points64.cuh"

inline CUDA_CALLABLE wp::vec4 load_constant(wp::array_t<wp::vec4> values, wp::int64 i) {
#if defined(__CUDA_ARCH__)
    float4 x = __ldg((const float4*)values.data + i);
    return wp::vec4(x.x, x.y, x.z, x.w);
#else
    return values.data[i];
#endif
}

inline CUDA_CALLABLE wp::vec4 load_entry(wp::array_t<wp::vec4> values, wp::int64 i) {
#if defined(__CUDA_ARCH__)
    float4 x = *((const float4*)values.data + i);
    return wp::vec4(x.x, x.y, x.z, x.w);
#else
    return values.data[i];
#endif
}

inline CUDA_CALLABLE void store_entry(wp::array_t<wp::vec4> values, wp::int64 i, wp::vec4 value) {
#if defined(__CUDA_ARCH__)
    *((float4*)values.data + i) = make_float4(value[0], value[1], value[2], value[3]);
#else
    values.data[i] = value;
#endif
}

inline CUDA_CALLABLE wp::vec4i load_corner(wp::array_t<wp::vec4i> corners, wp::int32 i) {
#if defined(__CUDA_ARCH__)
    int4 x = __ldg((const int4*)corners.data + i);
    return wp::vec4i(x.x, x.y, x.z, x.w);
#else
    return corners.data[i];
#endif
}

inline CUDA_CALLABLE wp::vec3d load_vertex(wp::array_t<wp::vec4d> vertices, wp::int32 i) {
#if defined(__CUDA_ARCH__)
    // 32 bytes lie in one sector: two loads, where three numbers of 24 bytes would take three.
    const double2* p = (const double2*)vertices.data + 2 * (long long)i;
    const double2 xy = __ldg(p);
    return wp::vec3d(xy.x, xy.y, __ldg(&p[1].x));
#else
    const wp::vec4d& p = vertices.data[i];
    return wp::vec3d(p[0], p[1], p[2]);
#endif
}

inline CUDA_CALLABLE wp::int32 children_of(wp::int32 node) {
#if defined(__CUDA_ARCH__)
    // One operation, as which the compiler does not see that the sum is a union of bits.
    int down;
    asm("mad.lo.s32 %0, %1, 2, %2;" : "=r"(down) : "r"(node), "r"(1 << 31));
    return down;
#else
    return (node * 2) | (1 << 31);
#endif
}

inline CUDA_CALLABLE bool all_within(wp::vec3 p, wp::vec3 u, wp::vec3 q, wp::vec3 v) {
    return (wp::abs(p[0]) <= u[0]) & (wp::abs(p[1]) <= u[1]) & (wp::abs(p[2]) <= u[2]) & (wp::abs(q[0]) <= v[0]) &
           (wp::abs(q[1]) <= v[1]) & (wp::abs(q[2]) <= v[2]);
}

inline CUDA_CALLABLE wp::float32 fuse32(wp::float32 a, wp::float32 b, wp::float32 c) {
#if defined(__CUDA_ARCH__)
    return __fmaf_rn(a, b, c);
#else
    return __builtin_fmaf(a, b, c);
#endif
}

inline CUDA_CALLABLE wp::vec3d no_vector() {
    // NumPy's NaN: devices differ in the sign and payload of the NaN that they make.
    union {
        long long bits;
        wp::float64 x;
    } nan = {0x7ff8000000000000ll};
    return wp::vec3d(nan.x, nan.x, nan.x);
}

inline CUDA_CALLABLE void store_flag(wp::array_t<wp::int64> words, wp::int64 at, wp::int32 flag) {
    ((wp::uint8*)words.data)[at] = (wp::uint8)flag;
}

inline CUDA_CALLABLE void store_bits(wp::array_t<wp::uint8> bytes, wp::int32 at, wp::int32 size, wp::int64 bits) {
    for (int k = 0; k < size; ++k)
        bytes.data[at + k] = (wp::uint8)(bits >> (8 * k));
}

inline CUDA_CALLABLE wp::float32 round_to_float32(wp::float64 x) {
    // NumPy's NaN: devices differ in the sign and payload of the NaN that a conversion makes.
    union {
        wp::int32 bits;
        wp::float32 x;
    } nan = {0x7fc00000};
    return x == x ? (wp::float32)x : nan.x;
}
