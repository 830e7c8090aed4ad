// Bounds of pairs of nodes by slabs and boxes together, squares of twice the distance.
#pragma once
#include "builtin.h"

struct SlabBounds {
    // A number each of A's eight nodes, then of B's; or of 16 pairs.
    typedef float lanes __attribute__((vector_size(64)));
    lanes axes[3][3], shift[3];  // to the other tree's frame: rotation, and twice the translation
    float scale, margin;
    lanes way[3], far;  // direction from A for A's nodes, to A for B's, in their own frames; and -t . n of B's

    static lanes of_a(const lanes& v) {
        return __builtin_shufflevector(v, v, 0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7);
    }
    static lanes of_b(const lanes& v) {
        return __builtin_shufflevector(v, v, 8, 9, 8, 9, 10, 11, 10, 11, 12, 13, 12, 13, 14, 15, 14, 15);
    }
    // Take a unit vector of A's frame as the direction along which slabs are compared.
    void look(const float* n) {
        float back[3];
        for (int i = 0; i < 3; ++i)
            back[i] = axes[0][i][15] * n[0] + axes[1][i][15] * n[1] + axes[2][i][15] * n[2];
        const float t = shift[0][15] * n[0] + shift[1][15] * n[1] + shift[2][15] * n[2];
        for (int i = 0; i < 3; ++i) {
            const float a = n[i], b = -back[i];
            way[i] = lanes{a, a, a, a, a, a, a, a, b, b, b, b, b, b, b, b};
        }
        far = lanes{0, 0, 0, 0, 0, 0, 0, 0, t, t, t, t, t, t, t, t};
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

    // Along the direction from A to B by boxes and slabs, across it by balls about the middles of boxes.
    lanes bound_way(const lanes (&slab)[8], const lanes (&sum)[3], const lanes (&size)[3],
                    const lanes (&apart)[3]) const {
        const lanes normal[3] = {slab[0], slab[1], slab[2]};
        const lanes along = way[0] * slab[0] + way[1] * slab[1] + way[2] * slab[2];
        const lanes top = tops(way, along, normal, slab[3], slab[4], sum, size) - far;
        const lanes ball = slab[6] * (2.0f * scale);
        const lanes w[3] = {lanes{} + way[0][0], lanes{} + way[1][0], lanes{} + way[2][0]};
        const lanes d = apart[0] * w[0] + apart[1] * w[1] + apart[2] * w[2];
        lanes across = {};
        for (int i = 0; i < 3; ++i) {
            const lanes x = apart[i] - d * w[i];
            across += x * x;
        }
        return square(-(of_a(top) + of_b(top)) - margin) +
               square(__builtin_elementwise_sqrt(across) - (of_a(ball) + of_b(ball)) - margin);
    }

    // Along the mean normal of either node: own slab against the other's box and slab.
    lanes bound_normals(const lanes (&slab)[8], const lanes (&sum)[3], const lanes (&size)[3],
                        const lanes (&apart)[3]) const {
        lanes there[3], towards = {}, along = {};
        for (int i = 0; i < 3; ++i)
            there[i] = fuse(axes[i][2], slab[2], fuse(axes[i][1], slab[1], axes[i][0] * slab[0]));
        // Both in A's frame.
        const lanes of_first[3] = {of_a(slab[0]), of_a(slab[1]), of_a(slab[2])};
        const lanes of_second[3] = {of_b(there[0]), of_b(there[1]), of_b(there[2])};
        lanes bound = {};
        along = dot(of_first, of_second);
        for (int k = 0; k < 2; ++k) {
            // The other's reach along a node's normal, which is turned away from the other.
            lanes w[3], normal[3], middle[3], half[3], step = {};
            for (int i = 0; i < 3; ++i) {
                w[i] = k == 0 ? of_a(there[i]) : of_b(there[i]);
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
