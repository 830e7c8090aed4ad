// Squared distances of a point from the boxes of two siblings, on CUDA rounded down, and what these stand for.
#pragma once
#include "builtin.h"

#if defined(__CUDA_ARCH__)
// Of a point rounded down and up; float64 would take most of the time of a search.
inline __device__ float square_below(const float4& low, const float4& high, const float (&below)[3],
                                     const float (&above)[3]) {
    const float lower[3] = {low.x, low.y, low.z}, upper[3] = {high.x, high.y, high.z};
    float total = 0.0f;
    for (int i = 0; i < 3; ++i) {
        const float gap = fmaxf(fmaxf(__fsub_rd(lower[i], above[i]), __fsub_rd(below[i], upper[i])), 0.0f);
        total = __fmaf_rd(gap, gap, total);
    }
    return total;
}
#endif

inline CUDA_CALLABLE void open_node(wp::array_t<wp::vec4> boxes, wp::int32 start, wp::int32 node, wp::vec3d x,
                                    wp::vec2d& squares, wp::vec2i& codes) {
    const float* const tree = (const float*)(boxes.data + 2 * (wp::int64)start);
    const float* const records = tree + 16 * (wp::int64)node;
    for (int k = 0; k < 2; ++k) {
        const float *const lower = records + 8 * k, *const upper = lower + 4;
#if defined(__CUDA_ARCH__)
        const float4 low = *(const float4*)lower, high = *(const float4*)upper;
        const float below[3] = {__double2float_rd(x[0]), __double2float_rd(x[1]), __double2float_rd(x[2])};
        const float above[3] = {__double2float_ru(x[0]), __double2float_ru(x[1]), __double2float_ru(x[2])};
        const double total = square_below(low, high, below, above);
        const int skip = __float_as_int(low.w), face = __float_as_int(high.w);
#else
        typedef float four __attribute__((vector_size(16)));
        typedef double wide __attribute__((vector_size(32)));
        const four low = *(const four*)lower, high = *(const four*)upper;
        const wide p = {x[0], x[1], x[2], 0.0}, zero = {};
        const wide under = __builtin_convertvector(low, wide) - p, over = p - __builtin_convertvector(high, wide);
        wide gap = under > over ? under : over;
        gap = gap > zero ? gap : zero;
        const wide square = gap * gap;
        const double total = (square[0] + square[1]) + square[2];
        const int skip = ((const int*)lower)[3], face = ((const int*)upper)[3];
        __builtin_prefetch(tree + 16 * (wp::int64)(face >= 0 || skip < 0 ? 0 : skip));
#endif
        squares[k] = skip < 0 ? (double)INFINITY : total;
        codes[k] = face >= 0 ? ~face : skip;
    }
}
