// Squared distances of a point from the boxes of two siblings, and what these stand for.
#pragma once
#include "builtin.h"

inline CUDA_CALLABLE void open_node(wp::array_t<wp::vec4> boxes, wp::int32 start, wp::int32 node, wp::vec3d x,
                                    wp::vec2d& squares, wp::vec2i& codes) {
    const float* const tree = (const float*)(boxes.data + 2 * (wp::int64)start);
    const float* const records = tree + 16 * (wp::int64)node;
    for (int k = 0; k < 2; ++k) {
        const float *const lower = records + 8 * k, *const upper = lower + 4;
#if defined(__CUDA_ARCH__)
        const float4 low = *(const float4*)lower, high = *(const float4*)upper;
        double total = 0.0;
        const double gaps[3] = {fmax(fmax((double)low.x - x[0], x[0] - (double)high.x), 0.0),
                                fmax(fmax((double)low.y - x[1], x[1] - (double)high.y), 0.0),
                                fmax(fmax((double)low.z - x[2], x[2] - (double)high.z), 0.0)};
        for (int i = 0; i < 3; ++i)
            total = __dadd_rn(total, __dmul_rn(gaps[i], gaps[i]));
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
