// Leaves of two small trees in a warp's shared memory, where its stack lies otherwise. On the CPU a warp is one thread.
#pragma once
#include "builtin.h"
#include "base/lanes.cuh"
#include "base/shared.cuh"
#include "base/sizes.h"

struct alignas(16) Quarter {
    float x, y, z, w;
};

inline CUDA_CALLABLE wp::int32 read_number(wp::uint64 items, wp::int32 i) { return *entry<volatile int>(items, i); }

inline CUDA_CALLABLE void write_number(wp::uint64 items, wp::int32 i, bool flag, wp::int32 x) {
    if (flag)
        *entry<volatile int>(items, i) = x;
}

inline CUDA_CALLABLE wp::vec4 read_quarter(wp::uint64 items, wp::int32 i) {
    const Quarter q = *entry<Quarter>(items, i);
    return wp::vec4(q.x, q.y, q.z, q.w);
}

inline CUDA_CALLABLE void write_quarter(wp::uint64 items, wp::int32 i, bool flag, wp::vec4 x) {
    if (flag)
        *entry<Quarter>(items, i) = Quarter{x[0], x[1], x[2], x[3]};
}

inline CUDA_CALLABLE bool spans_overlap(wp::vec3 a, wp::vec3 b, wp::vec3 c, wp::vec3 d) {
    return (a[0] <= d[0]) & (a[1] <= d[1]) & (a[2] <= d[2]) & (c[0] <= b[0]) & (c[1] <= b[1]) & (c[2] <= b[2]);
}

inline CUDA_CALLABLE wp::int32 read_half(wp::uint64 items, wp::int32 i) {
    return *entry<volatile unsigned short>(items, i);
}

inline CUDA_CALLABLE void push_half(wp::uint64 items, wp::int32 end, bool flag, wp::int32 x) {
    const int at = next_place(end, flag);
    if (flag)
        *entry<volatile unsigned short>(items, at) = (unsigned short)x;
}

inline CUDA_CALLABLE wp::uint32 compare_boxes(wp::uint64 items, wp::int32 rows, wp::vec3 lower, wp::vec3 upper,
                                              wp::vec3 posed_lower, wp::vec3 posed_upper) {
    unsigned int bits = 0;
    // What lies behind the last row is read, too, and its bits are left out.
    for (int row = 0; row < rows; row += 2)
#pragma unroll
        for (int k = 0; k < 2; ++k) {
            float x[12];
#pragma unroll
            for (int q = 0; q < 3; ++q) {
                const Quarter part = *entry<Quarter>(items, 3 * (row + k) + q);
                x[4 * q] = part.x;
                x[4 * q + 1] = part.y;
                x[4 * q + 2] = part.z;
                x[4 * q + 3] = part.w;
            }
            bool overlap = true;
            for (int i = 0; i < 3; ++i) {
                overlap &= (x[i] <= posed_upper[i]) & (posed_lower[i] <= x[3 + i]);
                overlap &= (x[6 + i] <= upper[i]) & (lower[i] <= x[9 + i]);
            }
            bits |= overlap ? 1u << (row + k) : 0u;
        }
    return rows < 32 ? bits & ((1u << rows) - 1u) : bits;
}
