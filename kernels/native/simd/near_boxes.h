// Bounds of the distances of four pairs of boxes at a time, as `bound_children` one by one.
#pragma once
#include "builtin.h"

struct NearBoxes {
    // Groups of four numbers: x, y, z and one that is not in use.
    typedef float groups __attribute__((vector_size(64)));
    typedef float loose __attribute__((vector_size(64), aligned(16)));
    typedef int bits __attribute__((vector_size(64)));
    typedef float eight __attribute__((vector_size(32)));
    typedef int ints __attribute__((vector_size(32)));
    typedef wp::int64 longs __attribute__((vector_size(32)));
    typedef float four __attribute__((vector_size(16)));
    typedef int fours __attribute__((vector_size(16)));
    typedef bool flags __attribute__((ext_vector_type(8)));
    typedef wp::int64 loose_longs __attribute__((vector_size(32), aligned(8)));
    typedef float loose_four __attribute__((vector_size(16), aligned(4)));
    struct Taken {
        const char *a, *b;
        unsigned int used;
    };
    // Up to four pairs of children: bounds, items that follow, and which are nodes and which faces, a bit each.
    struct Tested {
        four bound;
        longs item;
        unsigned int used, leaves;
    };
    groups axes[3], sizes[3], shift, wide;
    float scale;
    const char *tree_a, *tree_b;

    static NearBoxes make(const wp::float32 (&r)[3][3], const wp::vec_t<3, float>& back, const wp::vec_t<3, float>& there,
                          float margin, float scale, const void* trees, int a, int b) {
        NearBoxes s;
        // For both children of A, then for both children of B.
        for (int k = 0; k < 3; ++k) {
            s.axes[k] = groups{r[k][0], r[k][1], r[k][2], 0.0f, r[k][0], r[k][1], r[k][2], 0.0f,
                               r[0][k], r[1][k], r[2][k], 0.0f, r[0][k], r[1][k], r[2][k], 0.0f};
            s.sizes[k] = __builtin_elementwise_abs(s.axes[k]);
        }
        const float h[3] = {back[0] * 2, back[1] * 2, back[2] * 2};
        const float f[3] = {there[0] * 2, there[1] * 2, there[2] * 2};
        s.shift = groups{h[0], h[1], h[2], 0.0f, h[0], h[1], h[2], 0.0f, f[0], f[1], f[2], 0.0f, f[0], f[1], f[2], 0.0f};
        s.wide = groups{} + 2 * margin;
        s.scale = scale;
        s.tree_a = (const char*)trees + 32 * (wp::int64)a;
        s.tree_b = (const char*)trees + 32 * (wp::int64)b;
        return s;
    }
    Taken take(wp::int64 item) const {
        // As in `descend`: an item loads two siblings of either tree, and names those of the four pairs in use.
        constexpr unsigned long long PAIRS_USED = 0xfcfca854f3f3a251;
        const unsigned int x = (unsigned int)(item >> 32), y = (unsigned int)item;
        const unsigned long long turned = ((unsigned long long)item << 1) | ((unsigned long long)item >> 63);
        const Taken taken = {tree_a + 32 * (wp::int64)(x & 0x7ffffffe), tree_b + 32 * (wp::int64)(y & 0x7ffffffe),
                             (unsigned int)(PAIRS_USED >> (((turned & 3) << 2) | ((turned >> 28) & 48))) & 15};
        __builtin_prefetch(taken.a);
        __builtin_prefetch(taken.b);
        return taken;
    }
    static groups of_a(const groups& v) {
        return __builtin_shufflevector(v, v, 0, 1, 2, 3, 0, 1, 2, 3, 4, 5, 6, 7, 4, 5, 6, 7);
    }
    static groups of_b(const groups& v) {
        return __builtin_shufflevector(v, v, 8, 9, 10, 11, 12, 13, 14, 15, 8, 9, 10, 11, 12, 13, 14, 15);
    }
    static groups spread_x(const groups& v) {
        return __builtin_shufflevector(v, v, 0, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8, 12, 12, 12, 12);
    }
    static groups spread_y(const groups& v) {
        return __builtin_shufflevector(v, v, 1, 1, 1, 1, 5, 5, 5, 5, 9, 9, 9, 9, 13, 13, 13, 13);
    }
    static groups spread_z(const groups& v) {
        return __builtin_shufflevector(v, v, 2, 2, 2, 2, 6, 6, 6, 6, 10, 10, 10, 10, 14, 14, 14, 14);
    }
    // Squares of what |x| exceeds a reach by, summed in each group.
    static groups square_gap(const groups& x, const groups& reach) {
        const groups over = __builtin_elementwise_abs(x) - reach, gap = over > 0.0f ? over : groups{};
        const groups square = gap * gap;
        const groups two = square + __builtin_shufflevector(square, square, 1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12,
                                                            15, 14);
        return two + __builtin_shufflevector(two, two, 2, 3, 0, 1, 6, 7, 4, 5, 10, 11, 8, 9, 14, 15, 12, 13);
    }
    Tested test(const Taken& taken) const {
        const groups none = {};
        const groups a = *(const loose*)taken.a, b = *(const loose*)taken.b;
        groups low = __builtin_shufflevector(a, b, 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27);
        groups high = __builtin_shufflevector(a, b, 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31);
        low = __builtin_shufflevector(low, none, 0, 1, 2, 16, 4, 5, 6, 16, 8, 9, 10, 16, 12, 13, 14, 16) * scale;
        high = __builtin_shufflevector(high, none, 0, 1, 2, 16, 4, 5, 6, 16, 8, 9, 10, 16, 12, 13, 14, 16) * scale;
        const groups sum = high + low, size = high - low;
        groups sum_there = __builtin_elementwise_fma(axes[2], spread_z(sum), shift);
        sum_there = __builtin_elementwise_fma(axes[1], spread_y(sum), sum_there);
        sum_there = __builtin_elementwise_fma(axes[0], spread_x(sum), sum_there);
        groups size_there = __builtin_elementwise_fma(sizes[2], spread_z(size), wide);
        size_there = __builtin_elementwise_fma(sizes[1], spread_y(size), size_there);
        size_there = __builtin_elementwise_fma(sizes[0], spread_x(size), size_there);
        const groups one = square_gap(of_a(sum) - of_b(sum_there), of_a(size) + of_b(size_there));
        const groups other = square_gap(of_a(sum_there) - of_b(sum), of_a(size_there) + of_b(size));
        const groups more = one > other ? one : other;
        Tested tested;
        tested.bound = __builtin_shufflevector(more, more, 0, 4, 8, 12);
        // What follows, as in `item_of`: of A for the four pairs, then of B.
        const bits whole_a = (bits)a, whole_b = (bits)b;
        const ints skip = __builtin_shufflevector(whole_a, whole_b, 3, 3, 11, 11, 19, 27, 19, 27);
        const ints face = __builtin_shufflevector(whole_a, whole_b, 7, 7, 15, 15, 23, 31, 23, 31);
        const ints across = __builtin_shufflevector(face, face, 4, 5, 6, 7, 0, 1, 2, 3);
        const eight span = (eight)face, other_span = (eight)across;
        const ints inner = (face | across) < 0, down = (face < 0) & (span + span <= other_span);
        const ints next = inner ? (down ? (skip + skip) | (1 << 31) : skip) : face;
        tested.item = (longs)__builtin_shufflevector(next, next, 4, 0, 5, 1, 6, 2, 7, 3);
        tested.used = taken.used;
        tested.leaves = 15 & ~__builtin_bit_cast(unsigned char, __builtin_convertvector(inner, flags));
        return tested;
    }
    static unsigned int up_to(const four& x, float most) {
        const fours which = x <= most;
        const flags both = __builtin_convertvector(__builtin_shufflevector(which, which, 0, 1, 2, 3, 0, 1, 2, 3), flags);
        return __builtin_bit_cast(unsigned char, both) & 15;
    }
    // Put what a mask names on a list, of which four places are written over.
    static void append_items(wp::int64* list, const longs& x, unsigned int which) {
#if defined(__AVX512VL__)
        *(loose_longs*)list = __builtin_ia32_compressdi256_mask(x, longs{}, which);
#else
        for (int k = 0, n = 0; k < 4; n += which >> k++ & 1)
            list[n] = x[k];
#endif
    }
    static void append_bounds(float* list, const four& x, unsigned int which) {
#if defined(__AVX512VL__)
        *(loose_four*)list = __builtin_ia32_compresssf128_mask(x, four{}, which);
#else
        for (int k = 0, n = 0; k < 4; n += which >> k++ & 1)
            list[n] = x[k];
#endif
    }
};
