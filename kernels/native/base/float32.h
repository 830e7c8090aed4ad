// Numbers, masks and points in float32: of 16 face pairs on the CPU, of one in each lane of a GPU.
#pragma once
#include "builtin.h"

// Between these numbers reciprocals are normal, rounded to nearest; of others they are 0.
constexpr float INVERTED_LEAST = 0x1p-126f, INVERTED_MOST = 0x1p125f;

#if defined(__CUDA_ARCH__)
struct Float32 {
    typedef float lanes;
    typedef bool bits;
    typedef int integers;
    static constexpr int LANES = 1;
    struct Point {
        float x, y, z;
    };
    static CUDA_CALLABLE float absolute(float v) { return fabsf(v); }
    static CUDA_CALLABLE float fuse(float a, float b, float c) { return fmaf(a, b, c); }
    static CUDA_CALLABLE Point minus(const Point& a, const Point& b) { return Point{a.x - b.x, a.y - b.y, a.z - b.z}; }
    static CUDA_CALLABLE Point cross(const Point& u, const Point& v) {
        return Point{fuse(u.y, v.z, -(u.z * v.y)), fuse(u.z, v.x, -(u.x * v.z)), fuse(u.x, v.y, -(u.y * v.x))};
    }
    static CUDA_CALLABLE float dot(const Point& u, const Point& v) { return fuse(u.x, v.x, fuse(u.y, v.y, u.z * v.z)); }
    // As IEEE, without the branches that division and root have for what is not normal.
    static CUDA_CALLABLE float invert(float v) {
        float r;
        asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(v));
        r = fuse(r, fuse(-v, r, 1.0f), r);
        return ((v > INVERTED_LEAST) & (v < INVERTED_MOST)) ? r : 0.0f;
    }
    static CUDA_CALLABLE float root(float v) {
        const bool tiny = v < 0x1p-96f;
        const float x = tiny ? v * 0x1p64f : v;
        float r;
        asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x));
        const float near = x * r, y = fuse(fuse(-near, near, x), 0.5f * r, near);
        return (v == 0.0f) | (v == INFINITY) ? v : tiny ? y * 0x1p-32f : y;
    }
    static CUDA_CALLABLE float divide(float a, float b) {
        const float inverse = invert(b), near = a * inverse;
        return inverse == 0.0f ? 0.0f : fuse(fuse(-b, near, a), inverse, near);
    }
    static CUDA_CALLABLE float first(float v) { return v; }
    static CUDA_CALLABLE int first(int v) { return v; }
    static CUDA_CALLABLE float get_lane(float v, int) { return v; }
    static CUDA_CALLABLE int get_lane(int v, int) { return v; }
    static CUDA_CALLABLE bool any(bool flag) { return flag; }
    static CUDA_CALLABLE float pick(const float* from, int at) { return from[at]; }
    static CUDA_CALLABLE Point choose(bool which, const Point& a, const Point& b) { return which ? a : b; }
    static CUDA_CALLABLE float sum_sizes(const Point& v) { return (absolute(v.x) + absolute(v.y)) + absolute(v.z); }
    static CUDA_CALLABLE float most(float a, float b) { return fmaxf(a, b); }
    static CUDA_CALLABLE float least(float a, float b) { return fminf(a, b); }
    static CUDA_CALLABLE float largest(float x, float y, float z) { return most(x, most(y, z)); }
};
#else
struct Float32 {
    typedef float lanes __attribute__((vector_size(64)));
    typedef int bits __attribute__((vector_size(64)));
    typedef bits integers;
    static constexpr int LANES = 16;
    typedef bool flags __attribute__((ext_vector_type(16)));
    typedef float loose __attribute__((vector_size(64), aligned(4)));
    typedef wp::int64 longs __attribute__((vector_size(64)));
    typedef wp::int64 loose_longs __attribute__((vector_size(64), aligned(8)));
    typedef float four __attribute__((vector_size(16)));
    typedef float eight __attribute__((vector_size(32)));
    typedef int eight_ints __attribute__((vector_size(32)));
    typedef unsigned int sixteen[16];
    struct Point {
        lanes x, y, z;
    };

    static lanes every(float v) { return lanes{v, v, v, v, v, v, v, v, v, v, v, v, v, v, v, v}; }
    template <class Lanes>
    static Lanes invert(const Lanes& v) {
        return ((v > INVERTED_LEAST) & (v < INVERTED_MOST)) ? 1.0f / v : Lanes{};
    }
    static lanes root(const lanes& v) { return __builtin_elementwise_sqrt(v); }
    static float root(float v) { return __builtin_sqrtf(v); }
    static float divide(float a, float b) {
        const float inverse = invert(b), near = a * inverse;
        return inverse == 0.0f ? 0.0f : fuse(fuse(-b, near, a), inverse, near);
    }
    static float first(const lanes& v) { return v[0]; }
    static int first(const bits& v) { return v[0]; }
    static float get_lane(const lanes& v, int k) { return v[k]; }
    static int get_lane(const integers& v, int k) { return v[k]; }
    static bool any(const bits& flags) { return to_mask(flags) != 0; }
    static float pick(const float* from, int at) { return from[at]; }
    static lanes pick(const float* from, const bits& at) {
        lanes x;
        for (int k = 0; k < 16; ++k)
            x[k] = from[at[k]];
        return x;
    }
    static eight pick(const float* from, const eight_ints& at) {
        eight x;
        for (int k = 0; k < 8; ++k)
            x[k] = from[at[k]];
        return x;
    }
    template <class Lanes>
    static Lanes absolute(const Lanes& v) {
        return __builtin_elementwise_abs(v);
    }
    static lanes fuse(const lanes& a, const lanes& b, const lanes& c) { return __builtin_elementwise_fma(a, b, c); }
    static float fuse(float a, float b, float c) { return __builtin_fmaf(a, b, c); }
    static eight fuse(const eight& a, const eight& b, const eight& c) { return __builtin_elementwise_fma(a, b, c); }
    static lanes sum_sizes(const Point& v) { return (absolute(v.x) + absolute(v.y)) + absolute(v.z); }
    static Point minus(const Point& a, const Point& b) { return Point{a.x - b.x, a.y - b.y, a.z - b.z}; }
    static Point cross(const Point& u, const Point& v) {
        return Point{fuse(u.y, v.z, -(u.z * v.y)), fuse(u.z, v.x, -(u.x * v.z)), fuse(u.x, v.y, -(u.y * v.x))};
    }
    static lanes dot(const Point& u, const Point& v) { return fuse(u.x, v.x, fuse(u.y, v.y, u.z * v.z)); }
    template <class Lanes>
    static Lanes most(const Lanes& a, const Lanes& b) {
        return a > b ? a : b;
    }
    static lanes least(const lanes& a, const lanes& b) { return a < b ? a : b; }
    static lanes largest(const lanes& x, const lanes& y, const lanes& z) { return most(x, most(y, z)); }
    static Point choose(const bits& which, const Point& a, const Point& b) {
        return Point{which ? a.x : b.x, which ? a.y : b.y, which ? a.z : b.z};
    }
    static unsigned int to_mask(const bits& which) {
        return (unsigned int)__builtin_bit_cast(unsigned short, __builtin_convertvector(which, flags));
    }
    static bits widen(unsigned int mask) {
        return -__builtin_convertvector(__builtin_bit_cast(flags, (unsigned short)mask), bits);
    }
    // Put what a mask names behind a list, of which as many places as there are lanes are written over. No branch
    // depends on a single one: it could not be predicted, and what follows would wait for the longest chain of
    // operations.
    static void append(float* list, const lanes& x, unsigned int which) {
#if defined(__AVX512VL__)
        *(loose*)list = __builtin_ia32_compresssf512_mask(x, lanes{}, which);
#else
        for (; which != 0; which &= which - 1)
            *list++ = x[__builtin_ctz(which)];
#endif
    }
    static void append(wp::int64* list, const longs& x, unsigned int which) {
#if defined(__AVX512VL__)
        *(loose_longs*)list = __builtin_ia32_compressdi512_mask(x, longs{}, which);
#else
        for (; which != 0; which &= which - 1)
            *list++ = x[__builtin_ctz(which)];
#endif
    }
    static void append(wp::int64* list, const longs& low, const longs& high, unsigned int which) {
        append(list, low, which & 255);
        append(list + __builtin_popcount(which & 255), high, which >> 8);
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
};
#endif

// The corners of one face, in rows, in all lanes.
template <class Rows>
CUDA_CALLABLE void spread_corners(const Rows& rows, Float32::Point (&corners)[3]) {
    const Float32::lanes zero = {};
    for (int k = 0; k < 3; ++k)
        corners[k] = Float32::Point{zero + rows.data[k][0], zero + rows.data[k][1], zero + rows.data[k][2]};
}
