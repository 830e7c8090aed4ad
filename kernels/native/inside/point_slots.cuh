// The points that a warp measures at once, one a lane, in shared memory: any lane looks at any of them. On the CPU a
// warp is one thread.
#pragma once
#include "builtin.h"
#include "base/sizes.h"

struct PointSlots {
    double x[3][WARP_SIZE], least[WARP_SIZE];
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

inline CUDA_CALLABLE void put_point(wp::int32 slot, wp::vec3d point, wp::float64 most, wp::int32 none) {
    volatile PointSlots& slots = point_slots();
    for (int i = 0; i < 3; ++i)
        slots.x[i][slot] = point[i];
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
