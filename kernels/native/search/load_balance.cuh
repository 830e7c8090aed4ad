// The queue of dynamic load balancing between warps: counters, and slots that idle warps wait at.
#pragma once
#include "builtin.h"
#include "base/counters.cuh"
#include "base/sizes.h"

inline CUDA_CALLABLE wp::int32 first_ended(bool descends, wp::array_t<wp::int32> counter) {
    const int noted = *(const volatile int*)(counter.data + 4);
    return descends || noted != 0 ? 0 : -NO_UNIT;
}

inline CUDA_CALLABLE wp::int32 first_unit(wp::array_t<wp::int32> counter) {
#if defined(__CUDA_ARCH__)
    const int taken = *(const volatile int*)(counter.data + 3);
    return __shfl_sync(0xffffffffu, taken >= NO_UNIT ? NO_UNIT : (int)blockIdx.x, 0);
#else
    return counter.data[3] >= NO_UNIT ? NO_UNIT : 0;
#endif
}

inline CUDA_CALLABLE wp::int32 take_thread(wp::array_t<wp::int32> counter) {
#if defined(__CUDA_ARCH__)
    return 0;
#else
    return __atomic_fetch_add(counter.data + 1, 1, __ATOMIC_RELAXED);
#endif
}

inline CUDA_CALLABLE wp::int64 load_tickets(wp::array_t<wp::int32> counter) {
#if defined(__CUDA_ARCH__)
    // One load of both, past the first-level cache.
    return *(const volatile long long*)counter.data;
#else
    return 0;
#endif
}

inline CUDA_CALLABLE wp::int32 count_idle(wp::int64 tickets) {
    // Lanes that were not together read at different times; what follows needs the same number in all.
    return hold_uniform((int)(tickets >> 32) - (int)tickets);
}

inline CUDA_CALLABLE wp::int32 await_donation(wp::array_t<wp::int32> counter, wp::array_t<wp::int32> flag,
                                              wp::int32 ended) {
#if defined(__CUDA_ARCH__)
    int slot = -1, left = 1;
    if (threadIdx.x == 0) {
        __threadfence();  // a slot that this warp has freed, before the last one fills it with -1
        // Both under way at once.
        const int ticket = atomicAdd(counter.data + 1, 1);
        left = ended > 0 ? atomicSub(counter.data + 2, ended) - ended : *(const volatile int*)(counter.data + 2);
        const volatile int* mine = (const volatile int*)(flag.data + (ticket & (SLOT_COUNT - 1)));
        __threadfence();
        // The warp that ends the last unit terminates those that have tickets by then.
        if (left != 0) {
            int got = *mine;
            while (got != ticket + 1 && got != -1) {
                __nanosleep(100);
                got = *mine;
            }
            if (got != -1)
                slot = ticket & (SLOT_COUNT - 1);
        }
        __threadfence();
    }
    __syncwarp();
    if (ended > 0 && __shfl_sync(0xffffffffu, left, 0) == 0) {
        counter.data[4] = 0;
        for (int i = threadIdx.x; i < SLOT_COUNT / 4; i += 32)
            ((int4*)flag.data)[i] = make_int4(-1, -1, -1, -1);
    }
    return __shfl_sync(0xffffffffu, slot, 0);
#else
    counter.data[2] -= ended;
    counter.data[4] = 0;
    return -1;
#endif
}

inline CUDA_CALLABLE void free_slot(wp::array_t<wp::int32> flag, wp::int32 slot) {
#if defined(__CUDA_ARCH__)
    __syncwarp();
    if (threadIdx.x == 0) {
        __threadfence();
        *(volatile int*)(flag.data + slot) = 0;
    }
#endif
}

inline CUDA_CALLABLE wp::int32 claim_slot(wp::array_t<wp::int32> counter, wp::array_t<wp::int32> flag) {
#if defined(__CUDA_ARCH__)
    int ticket = 0;
    if (threadIdx.x == 0) {
        atomicAdd(counter.data + 2, 1);
        ticket = atomicAdd(counter.data, 1);
        while (*(const volatile int*)(flag.data + (ticket & (SLOT_COUNT - 1))) != 0)
            __nanosleep(100);
        __threadfence();
    }
    __syncwarp();
    return __shfl_sync(0xffffffffu, ticket, 0);
#else
    return 0;
#endif
}

inline CUDA_CALLABLE void fill_slot(wp::array_t<wp::int32> flag, wp::int32 ticket) {
#if defined(__CUDA_ARCH__)
    __threadfence();
    __syncwarp();
    if (threadIdx.x == 0)
        *(volatile int*)(flag.data + (ticket & (SLOT_COUNT - 1))) = ticket + 1;
#endif
}
