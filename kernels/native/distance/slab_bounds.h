// Bounds of pairs of nodes by slabs and boxes together, squares of twice the distance.
#pragma once
#include "builtin.h"

struct SlabBounds {
    // A number each of A's eight nodes, then of B's; or of 16 pairs.
    typedef float lanes __attribute__((vector_size(64)));
    lanes axes[3][3], shift[3];  // to the other tree's frame: rotation, and twice the translation
    float scale, margin;
    lanes home[3][3], there[3];  // from A's frame to B's; twice the translation of B to A

    static lanes of_a(const lanes& v) {
        return __builtin_shufflevector(v, v, 0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7);
    }
    static lanes of_b(const lanes& v) {
        return __builtin_shufflevector(v, v, 8, 9, 8, 9, 10, 11, 10, 11, 12, 13, 12, 13, 14, 15, 14, 15);
    }
    // Upper bounds of twice the coordinate of each node along a direction of its own frame, by its box and by its slab.
    lanes tops(const lanes (&w)[3], const lanes& along, const lanes (&normal)[3], const lanes& low, const lanes& high,
               const lanes (&sum)[3], const lanes (&size)[3]) const {
        // Terms in several sums, short chains: it is latency that takes the time.
        const lanes wide = 2.0f * scale * (along > 0.0f ? high : low);
        lanes rest[3], rest_size[3], w_size[3];
        for (int i = 0; i < 3; ++i) {
            rest[i] = fuse(-along, normal[i], w[i]);
            rest_size[i] = __builtin_elementwise_abs(rest[i]);
            w_size[i] = __builtin_elementwise_abs(w[i]);
        }
        const lanes top = fuse(along, wide, dot(rest, sum)) + dot(rest_size, size);
        const lanes plain = dot(w, sum) + dot(w_size, size);
        return top < plain ? top : plain;
    }
    static lanes fuse(const lanes& a, const lanes& b, const lanes& c) { return __builtin_elementwise_fma(a, b, c); }
    static lanes dot(const lanes (&a)[3], const lanes (&b)[3]) {
        return fuse(a[2], b[2], fuse(a[1], b[1], a[0] * b[0]));
    }
    static lanes square(const lanes& gap) { return gap > 0.0f ? gap * gap : lanes{}; }

    // The other lane of a pair of lanes, or of pairs of them, added to each.
    static lanes add_next(const lanes& v) {
        return v + __builtin_shufflevector(v, v, 1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14);
    }
    static lanes add_second(const lanes& v) {
        return v + __builtin_shufflevector(v, v, 2, 3, 0, 1, 6, 7, 4, 5, 10, 11, 8, 9, 14, 15, 12, 13);
    }
    static lanes inverse_root(const lanes& square) {
        return square > 0x1p-100f ? 1.0f / __builtin_elementwise_sqrt(square) : lanes{};
    }

    // Along the direction between the middles of an item's nodes, turned a little towards their mean normals, by boxes
    // and slabs; across it by balls about the middles of boxes. See `slab_bound`.
    lanes bound_between(const lanes (&slab)[8], const lanes (&sum)[3], const lanes (&size)[3],
                        const lanes (&apart)[3]) const {
        constexpr float NORMAL_WEIGHT = 0.0625f;
        const lanes normal[3] = {slab[0], slab[1], slab[2]};
        lanes w[3], a[3], b[3], back[3], way[3];
        for (int i = 0; i < 3; ++i) {
            w[i] = -add_second(add_next(apart[i]));
            a[i] = add_second(of_a(normal[i]));
            b[i] = add_next(of_b(fuse(axes[i][2], normal[2], fuse(axes[i][1], normal[1], axes[i][0] * normal[0]))));
        }
        const lanes unit = inverse_root(dot(w, w));
        const lanes of_first = NORMAL_WEIGHT * unit * dot(a, w), of_second = NORMAL_WEIGHT * unit * dot(b, w);
        for (int i = 0; i < 3; ++i)
            w[i] = fuse(of_second, b[i], fuse(of_first, a[i], unit * w[i]));
        const lanes length = inverse_root(dot(w, w));
        for (int i = 0; i < 3; ++i)
            w[i] *= length;
        for (int i = 0; i < 3; ++i) {
            back[i] = -fuse(home[i][2], w[2], fuse(home[i][1], w[1], home[i][0] * w[0]));
            way[i] = __builtin_shufflevector(w[i], back[i], 0, 0, 4, 4, 8, 8, 12, 12, 16, 16, 20, 20, 24, 24, 28, 28);
        }
        const lanes top = tops(way, dot(way, normal), normal, slab[3], slab[4], sum, size);
        const lanes ball = slab[6] * (2.0f * scale), d = dot(apart, w), far = dot(there, w);
        lanes across = {};
        for (int i = 0; i < 3; ++i) {
            const lanes x = fuse(-d, w[i], apart[i]);
            across = fuse(x, x, across);
        }
        return square(far - (of_a(top) + of_b(top)) - margin) +
               square(__builtin_elementwise_sqrt(across) - (of_a(ball) + of_b(ball)) - margin);
    }

    // Along the mean normal of either node: own slab against the other's box and slab.
    lanes bound_normals(const lanes (&slab)[8], const lanes (&sum)[3], const lanes (&size)[3],
                        const lanes (&apart)[3]) const {
        lanes rotated[3], along = {};
        for (int i = 0; i < 3; ++i)
            rotated[i] = fuse(axes[i][2], slab[2], fuse(axes[i][1], slab[1], axes[i][0] * slab[0]));
        // Both in A's frame.
        const lanes of_first[3] = {of_a(slab[0]), of_a(slab[1]), of_a(slab[2])};
        const lanes of_second[3] = {of_b(rotated[0]), of_b(rotated[1]), of_b(rotated[2])};
        lanes bound = {};
        along = dot(of_first, of_second);
        for (int k = 0; k < 2; ++k) {
            // The other's reach along a node's normal, which is turned away from the other.
            lanes w[3], normal[3], middle[3], half[3], step = {};
            for (int i = 0; i < 3; ++i) {
                w[i] = k == 0 ? of_a(rotated[i]) : of_b(rotated[i]);
                normal[i] = k == 0 ? of_b(slab[i]) : of_a(slab[i]);
                middle[i] = k == 0 ? of_b(sum[i]) : of_a(sum[i]);
                half[i] = k == 0 ? of_b(size[i]) : of_a(size[i]);
                step = fuse(apart[i], k == 0 ? of_first[i] : -of_second[i], step);
            }
            const lanes sign = step > 0.0f ? lanes{} + 1.0f : lanes{} - 1.0f;
            const lanes own_low = k == 0 ? of_a(slab[3]) : of_b(slab[3]),
                        own_high = k == 0 ? of_a(slab[4]) : of_b(slab[4]);
            const lanes low = k == 0 ? of_b(slab[3]) : of_a(slab[3]), high = k == 0 ? of_b(slab[4]) : of_a(slab[4]);
            lanes shifted = {};
            for (int i = 0; i < 3; ++i) {
                w[i] = sign * w[i];
                shifted = fuse(k == 0 ? of_first[i] : of_b(slab[i]), lanes{} + shift[i][k == 0 ? 15 : 0], shifted);
            }
            const lanes top = tops(w, sign * along, normal, low, high, middle, half);
            const lanes own = (sign > 0.0f ? own_low : -own_high) * (2.0f * scale);
            const lanes gap = square(own - top - sign * shifted - margin);
            bound = bound > gap ? bound : gap;
        }
        return bound;
    }
};
