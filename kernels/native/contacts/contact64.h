// Arithmetic of contacts in 8 lanes, as functions of the same names one by one: no rounding differs.
#pragma once
#include "builtin.h"
#include "base/sizes.h"
#include "base/float64.h"
#include "triangle/segment.cuh"

struct Contact64 : SharedSegment<Lanes64> {
    typedef Float64 F;

    // A determinant, in double words where it extends and float64 errs too much. Adds the lanes that it is not sure of
    // to a mask.
    template <class Extend>
    static lanes filter(bool extends, double bound, const Sign& sign, const Extend& extend, bits& unsure) {
        lanes value = sign.value;
        bits open = errs(bound, sign);
        if (__builtin_expect(extends && F::to_mask(open) != 0, 0))
            round(extend(), BOUND_DOUBLE * sign.size, value, open);
        unsure |= open;
        return value;
    }
    // Of triangle c and d, with u, v and w their differences, perhaps all turned round.
    static lanes filter_volume(bool extends, const Point (&c)[3], const Point& d, const Point& u, const Point& v,
                               const Point& w, bits& unsure) {
        auto extend = [&] { return Words::orient3d(c[0], c[1], c[2], d); };
        return filter(extends, BOUND_3D, F::volume(u, v, w), extend, unsure);
    }
    static lanes filter_area(bool extends, const lanes& ax, const lanes& ay, const lanes& bx, const lanes& by,
                             const lanes& cx, const lanes& cy, bits& unsure) {
        auto extend = [&] { return Words::orient2d(ax, ay, bx, by, cx, cy); };
        return filter(extends, BOUND_2D, F::area(ax, ay, bx, by, cx, cy), extend, unsure);
    }
    static Point filter_normal(bool extends, const Point& a, const Point& b, const Point& c, bits& unsure) {
        return unit_vector(Point{filter_area(extends, a.y, a.z, b.y, b.z, c.y, c.z, unsure),
                                 filter_area(extends, a.z, a.x, b.z, b.x, c.z, c.x, unsure),
                                 filter_area(extends, a.x, a.y, b.x, b.y, c.x, c.y, unsure)});
    }
    static Point blend_normals(const Point& normal_a, const Point& normal_b) {
        const Point normal = F::minus(normal_a, normal_b);
        return unit_vector(F::choose(dot(normal, normal) <= SHORTEST_NORMAL * SHORTEST_NORMAL, normal_a, normal));
    }
    // 1 where faces intersect, 0 where a gap lies between them.
    static void load_crossed(const double* separation, bool with_gap, int first, int count, lanes& crossed) {
        crossed = lanes{} + 1.0;
        for (int k = 0; k < (with_gap ? count : 0); ++k)
            crossed[k] = separation[first + k] < 0.0 ? 1.0 : 0.0;
    }
    // So many points, of 24 numbers, one point after the other; 0 behind them.
    static Point load(const double* numbers, int count) {
        typedef double loose __attribute__((vector_size(64), aligned(8)));
        double few[24] = {};
        if (__builtin_expect(count < 8, 0)) {
            for (int k = 0; k < 3 * count; ++k)
                few[k] = numbers[k];
            numbers = few;
        }
        const lanes a = *(const loose*)numbers, b = *(const loose*)(numbers + 8), c = *(const loose*)(numbers + 16);
        const lanes x_ab = __builtin_shufflevector(a, b, 0, 3, 6, 9, 12, 15, 0, 0);
        const lanes y_ab = __builtin_shufflevector(a, b, 1, 4, 7, 10, 13, 1, 1, 1);
        const lanes z_ab = __builtin_shufflevector(a, b, 2, 5, 8, 11, 14, 2, 2, 2);
        return Point{__builtin_shufflevector(x_ab, c, 0, 1, 2, 3, 4, 5, 10, 13),
                     __builtin_shufflevector(y_ab, c, 0, 1, 2, 3, 4, 8, 11, 14),
                     __builtin_shufflevector(z_ab, c, 0, 1, 2, 3, 4, 9, 12, 15)};
    }
    // Points as such numbers.
    static void store(double* numbers, const Point& p) {
        typedef double loose __attribute__((vector_size(64), aligned(8)));
        const lanes xy_low = __builtin_shufflevector(p.x, p.y, 0, 8, 1, 9, 2, 10, 3, 11);
        const lanes xy_high = __builtin_shufflevector(p.x, p.y, 4, 12, 5, 13, 6, 14, 7, 15);
        const lanes xy_middle = __builtin_shufflevector(p.x, p.y, 10, 3, 11, 4, 12, 5, 13, 6);
        *(loose*)numbers = __builtin_shufflevector(xy_low, p.z, 0, 1, 8, 2, 3, 9, 4, 5);
        *(loose*)(numbers + 8) = __builtin_shufflevector(xy_middle, p.z, 10, 1, 2, 11, 3, 4, 12, 5);
        *(loose*)(numbers + 16) = __builtin_shufflevector(xy_high, p.z, 3, 13, 4, 5, 14, 6, 7, 15);
    }
};

// Corners of face pairs that have contacts.
template <class PairPose>
struct ContactFaces {
    typedef Float64 F;
    typedef F::Point Point;
    const PairPose& pose;
    const wp::vec3i* faces;
    const double* vertices;
    const wp::vec4i* corners;

    // Of so many, of A and of B, in A's frame; the first in the place of those that lack.
    void load(const int* hit, int count, Point (&a)[3], Point (&b)[3]) const {
        const bool back = pose.swapped != 0;
        int start[6][8];
        for (int k = 0; k < 8; ++k) {
            const wp::vec3i& pair = faces[hit[k < count ? k : 0]];
            const wp::vec4i& a = corners[pose.corner_a + pair[back ? 2 : 1]];
            const wp::vec4i& b = corners[pose.corner_b + pair[back ? 1 : 2]];
            for (int i = 0; i < 3; ++i) {
                start[i][k] = 4 * a[i];
                start[3 + i][k] = 4 * b[i];
            }
        }
        for (int i = 0; i < 3; ++i) {
            a[i] = F::gather(vertices, start[i]);
            b[i] = F::pose(pose.rotation.data, pose.translation, F::gather(vertices, start[3 + i]));
        }
    }
};
