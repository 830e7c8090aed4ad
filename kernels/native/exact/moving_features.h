// Proof that a corner and a face, or two edges, stay apart for some time while their corners move straight.
// Polynomials of time are in Bernstein's form: where all coefficients have a sign, they have it at all times between.
// What they err by: docs/exactness.md, bound 21.
#pragma once
#include "builtin.h"
#include "exact/double_word.cuh"

// A point of double words.
struct Point {
    DoubleWord x[3];

    CALLED Point operator+(const Point& b) const { return {{x[0] + b.x[0], x[1] + b.x[1], x[2] + b.x[2]}}; }
    CALLED Point operator-(const Point& b) const { return {{x[0] - b.x[0], x[1] - b.x[1], x[2] - b.x[2]}}; }
    CALLED Point operator*(const DoubleWord& b) const { return {{x[0] * b, x[1] * b, x[2] * b}}; }
    CALLED DoubleWord dot(const Point& b) const { return x[0] * b.x[0] + x[1] * b.x[1] + x[2] * b.x[2]; }
    CALLED Point cross(const Point& b) const {
        return {{x[1] * b.x[2] - x[2] * b.x[1], x[2] * b.x[0] - x[0] * b.x[2], x[0] * b.x[1] - x[1] * b.x[0]}};
    }
    CUDA_CALLABLE double largest() const {
        return DoubleWord::larger(DoubleWord::larger(fabs(x[0].high), fabs(x[1].high)), fabs(x[2].high));
    }
    // Return the float64 numbers next to it.
    CUDA_CALLABLE Point rounded() const { return {{{x[0].high, 0.0}, {x[1].high, 0.0}, {x[2].high, 0.0}}}; }
};

struct MovingFeatures {
    Point first[3], last[3];  // corners 1 to 3 seen from corner 0: a corner and a face, or edges 0 1 and 2 3
    double size, error;       // the largest coordinate; a form of coordinates errs by this times the size of the others
    bool edges;

    // Return the sign of numbers all of which differ from 0 by more than a bound, or 0.
    static CUDA_CALLABLE int sign_of(const DoubleWord* x, int count, double bound) {
        bool above = true, below = true;
        for (int i = 0; i < count; ++i) {
            above = above && x[i].high > bound;
            below = below && x[i].high < -bound;
        }
        return above ? 1 : below ? -1 : 0;
    }
    CUDA_CALLABLE void measure(double place_error) {
        size = 0.0;
        for (int k = 0; k < 3; ++k)
            size = DoubleWord::larger(size, DoubleWord::larger(first[k].largest(), last[k].largest()));
        error = 256.0 * place_error + 0x1p-95 * size;  // 2^11 u^2
    }
    // Return whether the four corners are at no time in one plane.
    CUDA_CALLABLE bool stay_off_plane() const {
        const Point a = first[1].cross(first[2]), c = last[1].cross(last[2]);
        const Point b = first[1].cross(last[2]) + last[1].cross(first[2]);
        const DoubleWord volume[4] = {first[0].dot(a), last[0].dot(a) + first[0].dot(b),
                                      first[0].dot(c) + last[0].dot(b), last[0].dot(c)};
        return sign_of(volume, 4, size * size * error) != 0;
    }
    // Return whether some edge, on its way, has the features on either side of it, seen along n.
    CUDA_CALLABLE bool apart_seen_along(const Point& n) const {
        const double bound = n.largest() * size * error;
        DoubleWord area[3][3], rest[3];  // of corners 2 3, 3 1 and 1 2
        int sign[3];
#pragma unroll 1
        for (int k = 0; k < 3; ++k) {
            const int i = k == 2 ? 0 : k + 1, j = k == 0 ? 2 : k - 1;
            const Point a = n.cross(first[i]), b = n.cross(last[i]);
            area[k][0] = a.dot(first[j]);
            area[k][1] = a.dot(last[j]) + b.dot(first[j]);
            area[k][2] = b.dot(last[j]);
            sign[k] = sign_of(area[k], 3, bound);
        }
        if (edges && sign[1] * sign[2] < 0)
            return true;
#pragma unroll 1
        for (int k = 0; k < (edges ? 1 : 3); ++k) {
            const int i = k == 2 ? 0 : k + 1, j = k == 0 ? 2 : k - 1;
            for (int m = 0; m < 3; ++m) {
                rest[m] = area[i][m] + area[j][m];
                if (edges)
                    rest[m] = rest[m] + area[k][m];
            }
            if (sign[k] * sign_of(rest, 3, bound) * (edges ? -1 : 1) < 0)
                return true;
        }
        return false;
    }
    // Return whether there is a gap along n.
    CUDA_CALLABLE bool apart_along(const Point& n) const {
        DoubleWord gap[8];
#pragma unroll 1
        for (int k = 0; k < 2; ++k) {
            const Point* at = k == 0 ? first : last;
            const DoubleWord a = n.dot(at[0]), b = n.dot(at[1]), c = n.dot(at[2]);
            gap[4 * k] = b;
            gap[4 * k + 1] = c;
            gap[4 * k + 2] = edges ? b - a : a;
            gap[4 * k + 3] = edges ? c - a : a;
        }
        return sign_of(gap, 8, n.largest() * error) != 0;
    }
    // Return a direction halfway: the normal; of edges that are nearly parallel, that of their plane; or an edge, in
    // place of a first one that is a point the way from there.
    CUDA_CALLABLE Point direction(int k) const {
        const Point a = first[0] + last[0], b = first[1] + last[1], c = first[2] + last[2];
        if (k >= 5)
            return k == 6 ? c - b : edges && a.largest() == 0.0 ? b : a;
        if (k == 0 || k == 4)
            return edges ? a.cross(c - b) : (b - a).cross(c - a);
        return k == 1 ? a.cross(b) : k == 2 ? b.cross(c) : c.cross(a);
    }
    CUDA_CALLABLE bool stay_apart() const {
        if (stay_off_plane())
            return true;
#pragma unroll 1
        for (int k = 0; k < 7; ++k) {
            const Point n = direction(k).rounded();
            if (k < 4 ? apart_seen_along(n) : apart_along(n))
                return true;
        }
        return false;
    }
};
