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
    typedef wp::int64 loose_longs __attribute__((vector_size(64), aligned(8)));
    typedef int ints __attribute__((vector_size(32)));
    typedef int loose_ints __attribute__((vector_size(32), aligned(4)));
    typedef double four __attribute__((vector_size(32), aligned(8)));
    // Of 8 signs those that are 1, -1 and UNCERTAIN, a bit each.
    struct Sides {
        unsigned int above, below, open;
    };
    // Of 8 triangles those whose first corner is alone, whose second is, and whose lone corner lies on the negative
    // side.
    struct Alone {
        unsigned int first, second, back;
    };

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
    static Sides filtered(const lanes& value, const lanes& bound) {
        const unsigned int above = to_mask(value > bound), below = to_mask(value < -bound);
        const unsigned int open = 255 & ~(above | below);
        return Sides{above, below, open & ~to_mask(bound == 0.0)};
    }
    static unsigned int one_sided(const Sides (&s)[3]) {
        return (s[0].above & s[1].above & s[2].above) | (s[0].below & s[1].below & s[2].below);
    }
    static unsigned int has_sides(const Sides (&s)[3]) {
        return (s[0].above | s[0].below) & (s[1].above | s[1].below) & (s[2].above | s[2].below);
    }
    static unsigned int has_all_zero(const Sides (&s)[3]) {
        unsigned int any = 0;
        for (int i = 0; i < 3; ++i)
            any |= s[i].above | s[i].below | s[i].open;
        return ~any;
    }
    // As `find_alone`.
    static Alone find_alone(const Sides (&s)[3]) {
        const unsigned int pair_above = s[0].above & s[1].above, pair_below = s[0].below & s[1].below;
        const unsigned int odd_above = s[0].above ^ s[1].above, odd_below = s[0].below ^ s[1].below;
        const unsigned int positive = (odd_above ^ s[2].above) & ~(pair_above & s[2].above);
        const unsigned int negative = (odd_below ^ s[2].below) & ~(pair_below & s[2].below) & ~positive;
        const unsigned int zero = ~(positive | negative);
        auto is_kind = [&](const Sides& side) {
            return (positive & side.above) | (negative & side.below) | (zero & ~(side.above | side.below));
        };
        const unsigned int two_above = pair_above | (odd_above & s[2].above);
        return Alone{is_kind(s[0]), is_kind(s[1]), negative | (zero & two_above)};
    }
    // The same where none of the corners touches.
    static Alone find_lone(const Sides (&s)[3]) {
        const unsigned int odd = s[0].above ^ s[1].above, other = s[1].above ^ s[2].above;
        return Alone{odd & ~other, odd & other, (s[0].above & s[1].above) | (odd & s[2].above)};
    }
    // The corners at a place of three lists, rotated so that the lone one comes first, in either direction.
    static void rotate(const Alone& alone, unsigned int back, const int* a, const int* b, const int* c, ints* rotated) {
        const ints corner[3] = {look_up(a), look_up(b), look_up(c)};
        const ints first = widen(alone.first), second = widen(alone.second), turns_back = widen(back);
        rotated[0] = first ? corner[0] : second ? corner[1] : corner[2];
        const ints q = first ? corner[1] : second ? corner[2] : corner[0];
        const ints r = first ? corner[2] : second ? corner[0] : corner[1];
        rotated[1] = turns_back ? r : q;
        rotated[2] = turns_back ? q : r;
    }
    // Put what a mask names on a list, of which eight places are written over. No branch depends on a single pair of
    // faces: it could not be predicted, and what follows it would wait for the longest chain of operations.
    static void append(wp::int64* list, const bits& item, unsigned int which) {
#if defined(__AVX512VL__)
        *(loose_longs*)list = __builtin_ia32_compressdi512_mask(item, bits{}, which);
#else
        for (int n = 0; which != 0; which &= which - 1)
            list[n++] = item[__builtin_ctz(which)];
#endif
    }
    static void append_ints(int* list, const ints& item, unsigned int which) {
#if defined(__AVX512VL__)
        *(loose_ints*)list = __builtin_ia32_compresssi256_mask(item, ints{}, which);
#else
        for (int n = 0; which != 0; which &= which - 1)
            list[n++] = item[__builtin_ctz(which)];
#endif
    }
};
