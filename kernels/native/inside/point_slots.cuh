// The points that a warp measures at once, one a lane, in shared memory: any lane looks at any of them. On the CPU a
// warp is one thread.
#pragma once
#include "builtin.h"
#include "base/sizes.h"
#include "distance/point_boxes.cuh"

struct PointSlots {
    double x[3][WARP_SIZE], least[WARP_SIZE];
    float below[3][WARP_SIZE], above[3][WARP_SIZE];  // the point as boxes see it, rounded both ways, on CUDA alone
    int face[WARP_SIZE];
};

inline CUDA_CALLABLE volatile PointSlots& point_slots() {
#if defined(__CUDA_ARCH__)
    __shared__ PointSlots slots;
#else
    static PointSlots slots;
#endif
    return slots;
}

inline CUDA_CALLABLE void put_point(wp::int32 slot, wp::vec3d point, wp::vec3d x, wp::float64 most, wp::int32 none) {
    volatile PointSlots& slots = point_slots();
    for (int i = 0; i < 3; ++i) {
        slots.x[i][slot] = point[i];
#if defined(__CUDA_ARCH__)
        slots.below[i][slot] = __double2float_rd(x[i]);
        slots.above[i][slot] = __double2float_ru(x[i]);
#endif
    }
    slots.least[slot] = most;
    slots.face[slot] = none;
}

inline CUDA_CALLABLE wp::vec3d point_of_slot(wp::int32 slot) {
    volatile PointSlots& slots = point_slots();
    return wp::vec3d(slots.x[0][slot], slots.x[1][slot], slots.x[2][slot]);
}

inline CUDA_CALLABLE wp::float64 least_of_slot(wp::int32 slot) { return point_slots().least[slot]; }

inline CUDA_CALLABLE wp::int32 face_of_slot(wp::int32 slot) { return point_slots().face[slot]; }

inline CUDA_CALLABLE void offer_point_face(bool live, wp::int32 slot, wp::float64 distance, wp::int32 face,
                                           wp::int32 none) {
    volatile PointSlots& slots = point_slots();
#if defined(__CUDA_ARCH__)
    const double before = slots.least[threadIdx.x];
    __syncwarp();
    if (live)  // numbers from 0 on are in the order of their bits
        atomicMin((long long*)&slots.least[slot], __double_as_longlong(distance));
    __syncwarp();
    if (slots.least[threadIdx.x] != before)
        slots.face[threadIdx.x] = none;
    __syncwarp();
    if (live && slots.least[slot] == distance)
        atomicMin((int*)&slots.face[slot], face);
    __syncwarp();
#else
    if (live && (distance < slots.least[slot] || (distance == slots.least[slot] && face < slots.face[slot]))) {
        slots.least[slot] = distance;
        slots.face[slot] = face;
    }
#endif
}

// Lower bounds of the squared distances of a slot's point from the boxes of a node's children, as `open_node` has them.
inline CUDA_CALLABLE void bound_children_of_slot(wp::array_t<wp::vec4> boxes, wp::int32 start, wp::int32 node,
                                                 wp::int32 slot, wp::vec3d x, wp::vec2& bounds, wp::vec2i& codes) {
#if defined(__CUDA_ARCH__)
    volatile PointSlots& slots = point_slots();
    const float4* const records = (const float4*)(boxes.data + 2 * (wp::int64)start) + 4 * (wp::int64)node;
    const float below[3] = {slots.below[0][slot], slots.below[1][slot], slots.below[2][slot]};
    const float above[3] = {slots.above[0][slot], slots.above[1][slot], slots.above[2][slot]};
    for (int k = 0; k < 2; ++k) {
        const float4 low = records[2 * k], high = records[2 * k + 1];
        const int skip = __float_as_int(low.w), face = __float_as_int(high.w);
        bounds[k] = skip < 0 ? INFINITY : square_below(low, high, below, above);
        codes[k] = face >= 0 ? ~face : skip;
    }
#else
    wp::vec2d squares;
    open_node(boxes, start, node, x, squares, codes);
    for (int k = 0; k < 2; ++k) {
        bounds[k] = (float)squares[k];
        if ((double)bounds[k] > squares[k])
            bounds[k] = __builtin_nextafterf(bounds[k], 0.0f);
    }
#endif
}
