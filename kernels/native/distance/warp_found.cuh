// Upper bounds and nearest faces shared by all warps at work on an object pair.
#pragma once
#include "builtin.h"

inline CUDA_CALLABLE wp::vec2 load_upper(wp::array_t<wp::vec2> upper, wp::int32 i) {
#if defined(__CUDA_ARCH__)
    // Lanes that were not together read at different times; what follows needs the same numbers in all.
    const unsigned long long both = *(const volatile unsigned long long*)(upper.data + i);
    const unsigned long long x = __shfl_sync(0xffffffffu, both, 0);
    return wp::vec2(__int_as_float((int)x), __int_as_float((int)(x >> 32)));
#else
    return upper.data[i];
#endif
}

inline CUDA_CALLABLE void lower_upper(wp::array_t<wp::vec2> upper, wp::int32 i, wp::int32 k, wp::float32 x) {
#if defined(__CUDA_ARCH__)
    // Numbers of 0 and more are in the order of their bits.
    if (threadIdx.x == 0)
        atomicMin((int*)(upper.data + i) + k, __float_as_int(x));
    __syncwarp();
#else
    float& most = upper.data[i][k];
    most = x < most ? x : most;
#endif
}

inline CUDA_CALLABLE wp::float64 load_distance(wp::array_t<wp::float64> distance, wp::int32 i) {
#if defined(__CUDA_ARCH__)
    return __shfl_sync(0xffffffffu, *(const volatile double*)(distance.data + i), 0);
#else
    return distance.data[i];
#endif
}

inline CUDA_CALLABLE wp::int64 load_faces(wp::array_t<wp::int64> faces, wp::int32 i) {
#if defined(__CUDA_ARCH__)
    return __shfl_sync(0xffffffffu, *(const volatile long long*)(faces.data + i), 0);
#else
    return faces.data[i];
#endif
}

inline CUDA_CALLABLE void offer_nearest(wp::array_t<wp::float64> distance, wp::array_t<wp::int64> faces, wp::int32 i,
                                        wp::float64 d, wp::int64 item) {
#if defined(__CUDA_ARCH__)
    if (threadIdx.x == 0) {
        // Who takes the faces, and leaves -1, has the pair for itself.
        unsigned long long* place = (unsigned long long*)(faces.data + i);
        unsigned long long held = atomicExch(place, ~0ull);
        while (held == ~0ull) {
            __nanosleep(20);
            held = atomicExch(place, ~0ull);
        }
        __threadfence();
        volatile double* least = (volatile double*)(distance.data + i);
        if (d < *least || (d == *least && item < (long long)held)) {
            *least = d;
            held = (unsigned long long)item;
        }
        __threadfence();
        atomicExch(place, held);
    }
    __syncwarp();
#else
    if (d < distance.data[i] || (d == distance.data[i] && item < faces.data[i])) {
        distance.data[i] = d;
        faces.data[i] = item;
    }
#endif
}
