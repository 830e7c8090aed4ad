// A warp's lists of a search for the nearest faces: a ring of node pairs, face pairs to be measured in float32 and
// those to be measured in float64, each with a bound of its distance.
#pragma once
#include "builtin.h"
#include "search/warp_stack.cuh"

inline CUDA_CALLABLE wp::uint64 nearest_stack() {
#if defined(__CUDA_ARCH__)
    __shared__ long long items[NEAREST_LENGTH + NEAREST_LENGTH / 2];
    return __cvta_generic_to_shared(items);
#else
    static long long items[NEAREST_LENGTH + NEAREST_LENGTH / 2];
    return (wp::uint64)items;
#endif
}

inline CUDA_CALLABLE wp::uint64 thread_lists(wp::array_t<wp::int64> memory, wp::int32 thread) {
    return (wp::uint64)(memory.data + (wp::int64)thread * memory.shape[1]);
}

inline CUDA_CALLABLE wp::float32 read_bound(wp::uint64 items, wp::int32 i) {
    return *entry<volatile float>(items, 2 * NEAREST_LENGTH + i);
}

inline CUDA_CALLABLE void write_bound(wp::uint64 items, wp::int32 i, wp::float32 bound) {
    *entry<volatile float>(items, 2 * NEAREST_LENGTH + i) = bound;
}

inline CUDA_CALLABLE void put_in_turn(wp::vec_t<4, wp::int32>& kinds, wp::vec_t<4, wp::int64>& children,
                                      wp::vec_t<4, wp::float32>& bounds, int i, int j) {
    const bool turn = bounds[i] < bounds[j];
    const float bound = bounds[i];
    const long long child = children[i];
    const int kind = kinds[i];
    bounds[i] = turn ? bounds[j] : bound;
    bounds[j] = turn ? bound : bounds[j];
    children[i] = turn ? children[j] : child;
    children[j] = turn ? child : children[j];
    kinds[i] = turn ? kinds[j] : kind;
    kinds[j] = turn ? kind : kinds[j];
}

// The nearest comes last, so that it is taken first.
inline CUDA_CALLABLE void put_nearer_last(wp::vec_t<4, wp::int32>& kinds, wp::vec_t<4, wp::int64>& children,
                                          wp::vec_t<4, wp::float32>& bounds) {
    put_in_turn(kinds, children, bounds, 0, 1);
}

inline CUDA_CALLABLE void put_nearest_last(wp::vec_t<4, wp::int32>& kinds, wp::vec_t<4, wp::int64>& children,
                                           wp::vec_t<4, wp::float32>& bounds) {
    const int order[5][2] = {{0, 1}, {2, 3}, {0, 2}, {1, 3}, {1, 2}};
#pragma unroll
    for (int n = 0; n < 5; ++n)
        put_in_turn(kinds, children, bounds, order[n][0], order[n][1]);
}

inline CUDA_CALLABLE void push_in_order(wp::uint64 items, wp::int32& end, wp::vec_t<4, wp::int32> kinds,
                                        wp::vec_t<4, wp::int64> children) {
    const int mine = (kinds[0] != 0) + (kinds[1] != 0) + (kinds[2] != 0) + (kinds[3] != 0);
#if defined(__CUDA_ARCH__)
    int sum = mine;
    for (int step = 1; step < 32; step <<= 1) {
        const int more = __shfl_up_sync(0xffffffffu, sum, step);
        sum += (int)threadIdx.x >= step ? more : 0;
    }
    const int top = end + __shfl_sync(0xffffffffu, sum, 31);
    // The first lane's children on top.
    int at = top - (sum - mine);
    for (int k = 0; k < 4; ++k)
        if (kinds[k] != 0) {
            --at;
            *entry<volatile long long>(items, at) = children[k];
            *entry<volatile float>(items, 2 * NEAREST_LENGTH + at) = (float)kinds[k];
        }
    end = top;
#else
    int at = end + mine;
    for (int k = 0; k < 4; ++k)
        if (kinds[k] != 0) {
            --at;
            ((long long*)items)[at] = children[k];
            ((float*)((long long*)items + NEAREST_LENGTH))[at] = (float)kinds[k];
        }
    end += mine;
#endif
}

inline CUDA_CALLABLE void push_open(wp::uint64 items, wp::int32& end, bool flag, wp::int64 item, wp::float32 bound) {
    const int at = next_place(end, flag);
    if (flag) {
        *entry<volatile long long>(items, NEAREST_OPEN_START + at) = item;
        *entry<volatile float>(items, 2 * NEAREST_LENGTH + NEAREST_OPEN_START + at) = bound;
    }
}
