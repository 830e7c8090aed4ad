// Comparisons without branches, loads that the compiler would not widen by itself, and stores at any byte.
#pragma once
#include "builtin.h"

inline CUDA_CALLABLE wp::vec_t<4, wp::float32> load_constant(wp::array_t<wp::vec_t<4, wp::float32>> values,
                                                             wp::int64 i) {
#if defined(__CUDA_ARCH__)
    float4 x = __ldg((const float4*)values.data + i);
    return wp::vec_t<4, wp::float32>(x.x, x.y, x.z, x.w);
#else
    return values.data[i];
#endif
}

inline CUDA_CALLABLE wp::vec_t<4, wp::float32> load_entry(wp::array_t<wp::vec_t<4, wp::float32>> values, wp::int64 i) {
#if defined(__CUDA_ARCH__)
    float4 x = *((const float4*)values.data + i);
    return wp::vec_t<4, wp::float32>(x.x, x.y, x.z, x.w);
#else
    return values.data[i];
#endif
}

inline CUDA_CALLABLE void store_entry(wp::array_t<wp::vec_t<4, wp::float32>> values, wp::int64 i,
                                      wp::vec_t<4, wp::float32> value) {
#if defined(__CUDA_ARCH__)
    *((float4*)values.data + i) = make_float4(value[0], value[1], value[2], value[3]);
#else
    values.data[i] = value;
#endif
}

inline CUDA_CALLABLE wp::vec_t<4, wp::int32> load_corner(wp::array_t<wp::vec_t<4, wp::int32>> corners, wp::int32 i) {
#if defined(__CUDA_ARCH__)
    int4 x = __ldg((const int4*)corners.data + i);
    return wp::vec_t<4, wp::int32>(x.x, x.y, x.z, x.w);
#else
    return corners.data[i];
#endif
}

inline CUDA_CALLABLE wp::vec_t<3, wp::float64> load_vertex(wp::array_t<wp::vec_t<4, wp::float64>> vertices,
                                                           wp::int32 i) {
#if defined(__CUDA_ARCH__)
    // 32 bytes lie in one sector: two loads, where three numbers of 24 bytes would take three.
    const double2* p = (const double2*)vertices.data + 2 * (long long)i;
    const double2 xy = __ldg(p);
    return wp::vec_t<3, wp::float64>(xy.x, xy.y, __ldg(&p[1].x));
#else
    const wp::vec_t<4, wp::float64>& p = vertices.data[i];
    return wp::vec_t<3, wp::float64>(p[0], p[1], p[2]);
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

inline CUDA_CALLABLE bool all_within(wp::vec_t<3, wp::float32> p, wp::vec_t<3, wp::float32> u,
                                     wp::vec_t<3, wp::float32> q, wp::vec_t<3, wp::float32> v) {
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

inline CUDA_CALLABLE wp::float32 largest(wp::float32 x, wp::float32 y, wp::float32 z) {
#if defined(__CUDA_ARCH__)
    return wp::max(x, wp::max(y, z));
#else
    const wp::float32 m = y > z ? y : z;
    return x > m ? x : m;
#endif
}

inline CUDA_CALLABLE wp::int32 one_sided(wp::vec_t<3, wp::float32> x, wp::float32 bound) {
#if defined(__CUDA_ARCH__)
    // x < y is the sign bit of x - y, also where they are nearly the same, infinite or no numbers.
    const int p0 = __float_as_int(__fsub_rn(bound, x[0])), n0 = __float_as_int(__fadd_rn(x[0], bound));
    const int p1 = __float_as_int(__fsub_rn(bound, x[1])), n1 = __float_as_int(__fadd_rn(x[1], bound));
    const int p2 = __float_as_int(__fsub_rn(bound, x[2])), n2 = __float_as_int(__fadd_rn(x[2], bound));
    return (p0 & p1 & p2) | (n0 & n1 & n2);
#else
    const bool over = (x[0] > bound) & (x[1] > bound) & (x[2] > bound);
    const bool under = (x[0] < -bound) & (x[1] < -bound) & (x[2] < -bound);
    return -(over | under);
#endif
}

inline CUDA_CALLABLE wp::int32 add_signs(wp::int32 signs, wp::vec_t<3, wp::float32> x, wp::float32 bound) {
    int all = signs;
    for (int k = 0; k < 3; ++k) {
#if defined(__CUDA_ARCH__)
        // Each takes the sign bit of a number from the right, as in `one_sided`.
        all = __funnelshift_l(__float_as_int(__fsub_rn(bound, x[k])), all, 1);
        all = __funnelshift_l(__float_as_int(__fadd_rn(x[k], bound)), all, 1);
#else
        all = all * 4 + (x[k] > bound) * 2 + (x[k] < -bound);
#endif
    }
    return all;
}

inline CUDA_CALLABLE bool shares_reciprocal(wp::vec_t<3, wp::float64> v, wp::float64 s) {
#if defined(__CUDA_ARCH__)
    // Exponents that leave room for remainders, and a reciprocal that is rounded correctly.
    auto is_usual = [](double x) { return ((__double2hiint(x) >> 20) & 2047) - 523u < 1000u; };
    return is_usual(s) & (__double2loint(s) != -1) & ((v[0] == 0.0) | is_usual(v[0])) &
           ((v[1] == 0.0) | is_usual(v[1])) & ((v[2] == 0.0) | is_usual(v[2]));
#else
    return true;
#endif
}

inline CUDA_CALLABLE wp::vec_t<3, wp::float64> multiply_reciprocal(wp::vec_t<3, wp::float64> v, wp::float64 s) {
#if defined(__CUDA_ARCH__)
    // The steps of a division, the first five once for three: y ends as 1 / s, rounded.
    double y;
    asm("rcp.approx.ftz.f64 %0, %1;" : "=d"(y) : "d"(s));
    double e = __fma_rn(-s, y, 1.0);
    e = __fma_rn(e, e, e);
    y = __fma_rn(y, e, y);
    e = __fma_rn(-s, y, 1.0);
    y = __fma_rn(y, e, y);
    wp::vec_t<3, wp::float64> quotient;
    for (int k = 0; k < 3; ++k) {
        const double q = __dmul_rn(v[k], y);
        quotient[k] = v[k] == 0.0 ? q : __fma_rn(__fma_rn(-s, q, v[k]), y, q);
    }
    return quotient;
#else
    return wp::vec_t<3, wp::float64>(v[0] / s, v[1] / s, v[2] / s);
#endif
}

inline CUDA_CALLABLE wp::vec_t<3, wp::float64> no_vector() {
    // NumPy's NaN: devices differ in the sign and payload of the NaN that they make.
    union {
        long long bits;
        wp::float64 x;
    } nan = {0x7ff8000000000000ll};
    return wp::vec_t<3, wp::float64>(nan.x, nan.x, nan.x);
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
