// 8 lanes of float64: numbers, masks, points and signs, one of each of 8 face pairs.
#pragma once
#include "builtin.h"
#include "base/points64.cuh"

struct Lanes64 {
    typedef double lanes __attribute__((vector_size(64)));
    typedef wp::int64 bits __attribute__((vector_size(64)));
    typedef float floats __attribute__((vector_size(32)));
    typedef int float_bits __attribute__((vector_size(32)));
    typedef float_bits integers;
    typedef bool flags __attribute__((ext_vector_type(8)));
    static lanes absolute(const lanes& v) { return __builtin_elementwise_abs(v); }
    static lanes fuse(const lanes& a, const lanes& b, const lanes& c) { return __builtin_elementwise_fma(a, b, c); }
    static lanes root(const lanes& v) { return __builtin_elementwise_sqrt(v); }
    static bits negate(const bits& flags) { return ~flags; }
    static bool is_all(const bits&) { return false; }  // for a branch that saves nothing here
    static bool any(const bits& which) { return to_mask(which) != 0; }
    static unsigned int to_mask(const bits& which) {
        return (unsigned int)__builtin_bit_cast(unsigned char, __builtin_convertvector(which, flags));
    }
    static floats narrow(const lanes& v) { return __builtin_convertvector(v, floats); }
    static float_bits narrow_bits(const bits& which) { return __builtin_convertvector(which, float_bits); }
    template <class Point>
    static Point divide(const Point& v, const lanes& s) {
        return Point{v.x / s, v.y / s, v.z / s};
    }
};

struct Float64 : Points64<Lanes64> {
    typedef int ints __attribute__((vector_size(32)));
    typedef int loose_ints __attribute__((vector_size(32), aligned(4)));
    typedef double four __attribute__((vector_size(32), aligned(8)));
    static ints widen(unsigned int mask) {
        return -__builtin_convertvector(__builtin_bit_cast(flags, (unsigned char)mask), ints);
    }
    static ints look_up(const int* list) { return (ints) * (const loose_ints*)list; }
    // Points, each where so many numbers end.
    static Point gather(const double* position, const int* start) {
        auto at = [&](int k) { return *(const four*)(position + (unsigned int)start[k]); };
        lanes row[4];
        for (int k = 0; k < 4; ++k) {
            const int i = k < 2 ? k : k + 2;
            row[k] = __builtin_shufflevector(at(i), at(i + 2), 0, 1, 2, 3, 4, 5, 6, 7);
        }
        const lanes low_01 = __builtin_shufflevector(row[0], row[1], 0, 8, 2, 10, 4, 12, 6, 14);
        const lanes low_23 = __builtin_shufflevector(row[2], row[3], 0, 8, 2, 10, 4, 12, 6, 14);
        const lanes high_01 = __builtin_shufflevector(row[0], row[1], 1, 9, 3, 11, 5, 13, 7, 15);
        const lanes high_23 = __builtin_shufflevector(row[2], row[3], 1, 9, 3, 11, 5, 13, 7, 15);
        return Point{__builtin_shufflevector(low_01, low_23, 0, 1, 4, 5, 8, 9, 12, 13),
                     __builtin_shufflevector(high_01, high_23, 0, 1, 4, 5, 8, 9, 12, 13),
                     __builtin_shufflevector(low_01, low_23, 2, 3, 6, 7, 10, 11, 14, 15)};
    }
    // As `Float32::append`.
    static void append_ints(int* list, const ints& item, unsigned int which) {
#if defined(__AVX512VL__)
        *(loose_ints*)list = __builtin_ia32_compresssi256_mask(item, ints{}, which);
#else
        for (int n = 0; which != 0; which &= which - 1)
            list[n++] = item[__builtin_ctz(which)];
#endif
    }
};
