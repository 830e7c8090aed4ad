// Bounds of the distances of 16 pairs of boxes at a time, those of four items: as `bound_children` one by one.
#pragma once
#include "builtin.h"
#include "base/float32.h"
#include "distance/slab_bounds.h"
#include "search/siblings.h"

struct NearBoxes : SlabBounds {
    // Lanes are two siblings of one tree as they lie in memory; or a number each of A's eight nodes, then of B's.
    typedef float loose __attribute__((vector_size(64), aligned(16)));
    typedef int bits __attribute__((vector_size(64)));
    typedef Float32::longs longs;
    typedef Siblings Taken;
    // 16 pairs of children: bounds, items that follow, and which are in use and which are faces, a bit each.
    struct Tested {
        lanes bound;
        longs low, high;
        unsigned int used, leaves;
    };
    lanes sizes[3][3];
    float wide;
    const char *tree_a, *tree_b;
    wp::int64 slabs;  // where the slab of a node lies, from the node; 0 for none
    bool normals;     // whether slabs are compared along the nodes' own normals

    static NearBoxes make(const wp::float32 (&r)[3][3], const wp::vec3& back, const wp::vec3& there, float margin,
                          float scale, const void* trees, int a, int b) {
        NearBoxes s;
        auto join = [](float a, float b) { return lanes{a, a, a, a, a, a, a, a, b, b, b, b, b, b, b, b}; };
        for (int i = 0; i < 3; ++i) {
            for (int k = 0; k < 3; ++k) {
                s.axes[i][k] = join(r[k][i], r[i][k]);
                s.home[i][k] = lanes{} + r[k][i];
                s.sizes[i][k] = __builtin_elementwise_abs(s.axes[i][k]);
            }
            s.shift[i] = join(2 * back[i], 2 * there[i]);
            s.there[i] = lanes{} + 2 * there[i];
        }
        s.wide = 2 * margin;
        s.slabs = 0;
        s.normals = false;
        s.scale = scale;
        s.tree_a = (const char*)trees + 32 * (wp::int64)a;
        s.tree_b = (const char*)trees + 32 * (wp::int64)b;
        return s;
    }
    Taken take(wp::int64 item) const {
        const Taken taken = take_siblings(tree_a, tree_b, item);
        __builtin_prefetch(taken.a + slabs);
        __builtin_prefetch(taken.b + slabs);
        return taken;
    }
    static lanes square_gap(const lanes& x, const lanes& reach) {
        const lanes over = __builtin_elementwise_abs(x) - reach, gap = over > 0.0f ? over : lanes{};
        return gap * gap;
    }
    // A node's eight numbers, of A's nodes in order, then of B's.
    static void turn(const Taken (&taken)[4], wp::int64 offset, lanes (&field)[8]) {
        lanes row[8], half[8], part[8];
        for (int i = 0; i < 4; ++i) {
            row[i] = *(const loose*)(taken[i].a + offset);
            row[4 + i] = *(const loose*)(taken[i].b + offset);
        }
        // Numbers k of the siblings of two items side by side, then of four.
        for (int i = 0; i < 4; ++i) {
            const lanes &a = row[2 * i], &b = row[2 * i + 1];
            half[2 * i] = __builtin_shufflevector(a, b, 0, 8, 16, 24, 1, 9, 17, 25, 2, 10, 18, 26, 3, 11, 19, 27);
            half[2 * i + 1] = __builtin_shufflevector(a, b, 4, 12, 20, 28, 5, 13, 21, 29, 6, 14, 22, 30, 7, 15, 23, 31);
        }
        for (int i = 0; i < 2; ++i)
            for (int k = 0; k < 2; ++k) {
                const lanes &a = half[4 * i + k], &b = half[4 * i + 2 + k];
                part[4 * i + 2 * k] =
                    __builtin_shufflevector(a, b, 0, 1, 2, 3, 16, 17, 18, 19, 4, 5, 6, 7, 20, 21, 22, 23);
                part[4 * i + 2 * k + 1] =
                    __builtin_shufflevector(a, b, 8, 9, 10, 11, 24, 25, 26, 27, 12, 13, 14, 15, 28, 29, 30, 31);
            }
        for (int k = 0; k < 4; ++k) {
            const lanes &a = part[k], &b = part[4 + k];
            field[2 * k] = __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23);
            field[2 * k + 1] =
                __builtin_shufflevector(a, b, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
        }
    }
    Tested test(const Taken (&taken)[4]) const {
        lanes field[8], sum[3], size[3], apart[3], bound = {}, other = {};
        turn(taken, 0, field);
        for (int i = 0; i < 3; ++i) {
            const lanes low = field[i] * scale, high = field[4 + i] * scale;
            sum[i] = high + low;
            size[i] = high - low;
        }
        for (int i = 0; i < 3; ++i) {
            lanes sum_there = shift[i], size_there = lanes{} + wide;
            for (int k = 2; k >= 0; --k) {
                sum_there = __builtin_elementwise_fma(axes[i][k], sum[k], sum_there);
                size_there = __builtin_elementwise_fma(sizes[i][k], size[k], size_there);
            }
            apart[i] = of_a(sum[i]) - of_b(sum_there);
            bound += square_gap(apart[i], of_a(size[i]) + of_b(size_there));
            other += square_gap(of_a(sum_there) - of_b(sum[i]), of_a(size_there) + of_b(size[i]));
        }
        Tested tested;
        tested.bound = bound > other ? bound : other;
        if (slabs != 0) {
            lanes slab[8];
            turn(taken, slabs, slab);
            const lanes more = normals ? bound_normals(slab, sum, size, apart) : bound_between(slab, sum, size, apart);
            tested.bound = tested.bound > more ? tested.bound : more;
        }
        // What follows, as in `item_of`.
        const bits face_a = (bits)of_a(field[7]), face_b = (bits)of_b(field[7]);
        const bits skip_a = (bits)of_a(field[3]), skip_b = (bits)of_b(field[3]);
        const lanes span_a = (lanes)face_a, span_b = (lanes)face_b;
        const bits inner = (face_a | face_b) < 0;
        const bits down_a = span_a + span_a <= span_b, down_b = span_b + span_b <= span_a;
        const bits x = inner ? (down_a ? (skip_a + skip_a) | (1 << 31) : skip_a) : face_a;
        const bits y = inner ? (down_b ? (skip_b + skip_b) | (1 << 31) : skip_b) : face_b;
        tested.low = (longs)__builtin_shufflevector(y, x, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
        tested.high =
            (longs)__builtin_shufflevector(y, x, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
        tested.used = taken[0].used | taken[1].used << 4 | taken[2].used << 8 | taken[3].used << 12;
        tested.leaves = 0xffff & ~Float32::to_mask(inner);
        return tested;
    }
};
