// Blocks of triangles that one thread of the CPU hands to others, numbered from the first window on.
#pragma once
#include "builtin.h"
#include "base/sizes.h"

// A block that no other thread has, in the order in which they were added; -1 where there is none now.
wp::int32 take_block(wp::array_t<int> counter) {
#if !defined(__CUDA_ARCH__)
#include "base/sizes.h"
    int* taken = counter.data + BLOCKS_TAKEN;
    int u = __atomic_load_n(taken, __ATOMIC_ACQUIRE);
    while (u < __atomic_load_n(counter.data + BLOCKS_ADDED, __ATOMIC_ACQUIRE))
        if (__atomic_compare_exchange_n(taken, &u, u + 1, false, __ATOMIC_ACQ_REL, __ATOMIC_ACQUIRE))
            return u;
#endif
    return -1;
}

// Take all that are left; the first of them.
wp::int32 withdraw_blocks(wp::array_t<int> counter) {
#if defined(__CUDA_ARCH__)
    return 0;
#else
#include "base/sizes.h"
    return __atomic_exchange_n(counter.data + BLOCKS_TAKEN, counter.data[BLOCKS_ADDED], __ATOMIC_ACQ_REL);
#endif
}

// What was written before is seen by whoever reads the value with `read_flag`.
void write_flag(wp::array_t<int> flag, wp::int32 i, wp::int32 value) {
#if !defined(__CUDA_ARCH__)
    __atomic_store_n(flag.data + i, value, __ATOMIC_RELEASE);
#endif
}

wp::int32 read_flag(wp::array_t<int> flag, wp::int32 i) {
#if defined(__CUDA_ARCH__)
    return 0;
#else
    return __atomic_load_n(flag.data + i, __ATOMIC_ACQUIRE);
#endif
}

// Let another thread of the core go on for a moment.
void pause() {
#if defined(__x86_64__) && !defined(__CUDA_ARCH__)
    __builtin_ia32_pause();
#endif
}

// How many threads have come before this one.
wp::int32 count_up(wp::array_t<int> flag, wp::int32 i) {
#if defined(__CUDA_ARCH__)
    return 0;
#else
    return __atomic_fetch_add(flag.data + i, 1, __ATOMIC_ACQ_REL);
#endif
}
