// Numbers, masks and points in float32: of 16 face pairs on the CPU, of one in each lane of a GPU.
#pragma once
#include "builtin.h"

#if defined(__CUDA_ARCH__)
struct Float32 {
    typedef float lanes;
    typedef bool bits;
    struct Point {
        float x, y, z;
    };
    static CUDA_CALLABLE float absolute(float v) { return v < 0.0f ? -v : v; }
    static CUDA_CALLABLE float fuse(float a, float b, float c) { return fmaf(a, b, c); }
    static CUDA_CALLABLE Point minus(const Point& a, const Point& b) { return Point{a.x - b.x, a.y - b.y, a.z - b.z}; }
    static CUDA_CALLABLE Point cross(const Point& u, const Point& v) {
        return Point{fuse(u.y, v.z, -(u.z * v.y)), fuse(u.z, v.x, -(u.x * v.z)), fuse(u.x, v.y, -(u.y * v.x))};
    }
    static CUDA_CALLABLE float dot(const Point& u, const Point& v) { return fuse(u.x, v.x, fuse(u.y, v.y, u.z * v.z)); }
    static CUDA_CALLABLE float root(float v) { return sqrtf(v); }
    static CUDA_CALLABLE float first(float v) { return v; }
    static CUDA_CALLABLE int first(int v) { return v; }
    static CUDA_CALLABLE bool any(bool flag) { return flag; }
    static CUDA_CALLABLE float pick(const float* from, int at) { return from[at]; }
    static CUDA_CALLABLE Point choose(bool which, const Point& a, const Point& b) { return which ? a : b; }
};
#else
struct Float32 {
    typedef float lanes __attribute__((vector_size(64)));
    typedef int bits __attribute__((vector_size(64)));
    typedef bool flags __attribute__((ext_vector_type(16)));
    typedef float four __attribute__((vector_size(16)));
    typedef float eight __attribute__((vector_size(32)));
    typedef unsigned int sixteen[16];
    struct Point {
        lanes x, y, z;
    };
    // Of three signs those that are 1 and those that are -1, a bit each; where they lie on one side, where they lie
    // there farther than a gap, and where one is UNCERTAIN or all are 0.
    struct Sides {
        unsigned int above[3], below[3], one_sided, far, uncertain;
    };
    struct Side {
        unsigned int above, uncertain;
    };

    static lanes every(float v) { return lanes{v, v, v, v, v, v, v, v, v, v, v, v, v, v, v, v}; }
    static lanes root(const lanes& v) { return __builtin_elementwise_sqrt(v); }
    static float first(const lanes& v) { return v[0]; }
    static int first(const bits& v) { return v[0]; }
    static bool any(const bits& flags) { return to_mask(flags) != 0; }
    static float pick(const float* from, int at) { return from[at]; }
    static lanes pick(const float* from, const bits& at) {
        lanes x;
        for (int k = 0; k < 16; ++k)
            x[k] = from[at[k]];
        return x;
    }
    static lanes absolute(const lanes& v) { return __builtin_elementwise_abs(v); }
    static lanes fuse(const lanes& a, const lanes& b, const lanes& c) { return __builtin_elementwise_fma(a, b, c); }
    static float fuse(float a, float b, float c) { return __builtin_fmaf(a, b, c); }
    static lanes sum_sizes(const Point& v) { return (absolute(v.x) + absolute(v.y)) + absolute(v.z); }
    static Point minus(const Point& a, const Point& b) { return Point{a.x - b.x, a.y - b.y, a.z - b.z}; }
    static Point cross(const Point& u, const Point& v) {
        return Point{fuse(u.y, v.z, -(u.z * v.y)), fuse(u.z, v.x, -(u.x * v.z)), fuse(u.x, v.y, -(u.y * v.x))};
    }
    static lanes dot(const Point& u, const Point& v) { return fuse(u.x, v.x, fuse(u.y, v.y, u.z * v.z)); }
    static lanes bound_error(float error, float unit, const lanes& u, const lanes& v, const lanes& w) {
        const lanes p = u + 2.0f * error, q = v + 2.0f * error, s = w + 2.0f * error;
        return error * (p * q + s * (p + q)) + unit * (p * q * s);
    }
    static Point choose(const bits& which, const Point& a, const Point& b) {
        return Point{which ? a.x : b.x, which ? a.y : b.y, which ? a.z : b.z};
    }
    static unsigned int to_mask(const bits& which) {
        return (unsigned int)__builtin_bit_cast(unsigned short, __builtin_convertvector(which, flags));
    }
    static bits widen(unsigned int mask) {
        return -__builtin_convertvector(__builtin_bit_cast(flags, (unsigned short)mask), bits);
    }
    // Rows of four numbers, each where so many pairs of numbers end.
    static Point gather(const void* table, const sixteen& start) {
        auto at = [&](int k) { return *(const four*)((const double*)table + start[k]); };
        lanes row[4];
        for (int k = 0; k < 4; ++k) {
            const eight p = __builtin_shufflevector(at(k), at(k + 4), 0, 1, 2, 3, 4, 5, 6, 7);
            const eight q = __builtin_shufflevector(at(k + 8), at(k + 12), 0, 1, 2, 3, 4, 5, 6, 7);
            row[k] = __builtin_shufflevector(p, q, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
        }
        auto low = [](const lanes& a, const lanes& b) {
            return __builtin_shufflevector(a, b, 0, 16, 1, 17, 4, 20, 5, 21, 8, 24, 9, 25, 12, 28, 13, 29);
        };
        auto high = [](const lanes& a, const lanes& b) {
            return __builtin_shufflevector(a, b, 2, 18, 3, 19, 6, 22, 7, 23, 10, 26, 11, 27, 14, 30, 15, 31);
        };
        auto first = [](const lanes& a, const lanes& b) {
            return __builtin_shufflevector(a, b, 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29);
        };
        auto second = [](const lanes& a, const lanes& b) {
            return __builtin_shufflevector(a, b, 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31);
        };
        const lanes low_01 = low(row[0], row[1]), low_23 = low(row[2], row[3]);
        const lanes high_01 = high(row[0], row[1]), high_23 = high(row[2], row[3]);
        return Point{first(low_01, low_23), second(low_01, low_23), first(high_01, high_23)};
    }
    // As `length_bound`.
    static lanes length_bound(float error, float unit, const Point& u, const Point& v, const Point& normal) {
        const lanes p = sum_sizes(u) + 2.0f * error, q = sum_sizes(v) + 2.0f * error, most = sum_sizes(normal);
        const lanes length = __builtin_elementwise_sqrt(dot(normal, normal));
        return (most > 0x1p-50f ? length : most) + 2.0f * (error * (p + q) + unit * (p * q));
    }
    // Without a gap, below 0, what is far is on one side.
    static Sides sides_of_plane(float error, float unit, float gap, const Point& a, const Point& b, const Point& c,
                                const Point (&d)[3]) {
        const Point u = minus(b, a), v = minus(c, a);
        const Point w[3] = {minus(a, d[0]), minus(a, d[1]), minus(a, d[2])};
        const Point normal = cross(u, v);
        const lanes size[3] = {sum_sizes(w[0]), sum_sizes(w[1]), sum_sizes(w[2])};
        const lanes more = size[1] > size[2] ? size[1] : size[2];
        const lanes bound = bound_error(error, unit, sum_sizes(u), sum_sizes(v), size[0] > more ? size[0] : more);
        Sides s;
        unsigned int none[3];
        lanes value[3];
        for (int i = 0; i < 3; ++i) {
            value[i] = dot(w[i], normal);
            s.above[i] = to_mask(value[i] > bound);
            s.below[i] = to_mask(value[i] < -bound);
            none[i] = ~(s.above[i] | s.below[i]);
        }
        s.one_sided = (s.above[0] & s.above[1] & s.above[2]) | (s.below[0] & s.below[1] & s.below[2]);
        s.far = s.one_sided;
        if (gap >= 0.0f) {
            const lanes wide = (bound + gap * length_bound(error, unit, u, v, normal)) * (1.0f + 0x1p-18f);
            s.far = to_mask((value[0] > wide) & (value[1] > wide) & (value[2] > wide)) |
                    to_mask((value[0] < -wide) & (value[1] < -wide) & (value[2] < -wide));
        }
        s.uncertain = (none[0] | none[1] | none[2]) & (~to_mask(bound == 0.0f) | (none[0] & none[1] & none[2]));
        return s;
    }
    static Side side_of_plane(float error, float unit, const Point& a, const Point& b, const Point& c, const Point& d) {
        const Point u = minus(a, d), v = minus(b, d), w = minus(c, d);
        const lanes value = dot(u, cross(v, w));
        const lanes bound = bound_error(error, unit, sum_sizes(u), sum_sizes(v), sum_sizes(w));
        const unsigned int above = to_mask(value > bound);
        return Side{above, ~(above | to_mask(value < -bound) | to_mask(bound == 0.0f))};
    }
    // As `find_alone`, and the corners rotated so that this one comes first.
    static void rotate(const Sides& s, const Point (&c)[3], bits& back, Point& p, Point& q, Point& last) {
        const unsigned int pair_above = s.above[0] & s.above[1], odd_above = s.above[0] ^ s.above[1];
        const unsigned int pair_below = s.below[0] & s.below[1], odd_below = s.below[0] ^ s.below[1];
        const unsigned int positive = (odd_above ^ s.above[2]) & ~(pair_above & s.above[2]);
        const unsigned int negative = (odd_below ^ s.below[2]) & ~(pair_below & s.below[2]) & ~positive;
        const unsigned int zero = ~(positive | negative);
        auto is_kind = [&](int i) {
            return widen((positive & s.above[i]) | (negative & s.below[i]) | (zero & ~(s.above[i] | s.below[i])));
        };
        const bits first = is_kind(0), second = is_kind(1);
        back = widen(negative | (zero & (pair_above | (odd_above & s.above[2]))));
        p = choose(first, c[0], choose(second, c[1], c[2]));
        q = choose(first, c[1], choose(second, c[2], c[0]));
        last = choose(first, c[2], choose(second, c[0], c[1]));
    }
};
#endif
