// Hits by object pair on CUDA: where those of each pair start, a place for each, then each pair's own in order.
#pragma once
#include "builtin.h"
#include "base/sizes.h"
#include "io/segment_sort.h"

inline CUDA_CALLABLE void start_segments(wp::int32 tile, wp::int32 rows, wp::int32 pair_mask,
                                         wp::array_t<wp::int64> count, wp::array_t<wp::vec3i> face,
                                         wp::array_t<wp::int32> start) {
    const int pairs = start.shape[0] - 1, first = tile * SEGMENT_THREADS;
#if defined(__CUDA_ARCH__)
    __shared__ int tally[SEGMENT_THREADS];
    __shared__ long long sums[2][SEGMENT_THREADS / 32];
    const int thread = threadIdx.x, lane = thread & 31, pair = first + thread;
    long long whole = 0, before = 0;
    for (int p = thread; p < pairs; p += SEGMENT_THREADS) {
        const long long x = count.data[p];
        whole += x;
        before += p < first ? x : 0;
    }
    int own = pair < pairs ? (int)count.data[pair] : 0;
    auto sum_block = [&](long long x, long long* sums) {
        for (int step = 16; step > 0; step /= 2)
            x += __shfl_xor_sync(0xffffffffu, x, step);
        if (lane == 0)
            sums[thread / 32] = x;
        __syncthreads();
        x = 0;
        for (int k = 0; k < SEGMENT_THREADS / 32; ++k)
            x += sums[k];
        return x;
    };
    if (sum_block(whole, sums[0]) != rows) {
        // Rows are missing: those that there are count.
        tally[thread] = 0;
        before = 0;
        __syncthreads();
        for (int i = thread; i < rows; i += SEGMENT_THREADS) {
            const int p = face.data[i][0] & pair_mask;
            before += p < first;
            if (p >= first && p < first + SEGMENT_THREADS)
                atomicAdd(&tally[p - first], 1);
        }
        __syncthreads();
        own = tally[thread];
    }
    int place = (int)sum_block(before, sums[1]), sum = own;
    for (int step = 1; step < 32; step *= 2) {
        const int other = __shfl_up_sync(0xffffffffu, sum, step);
        sum += lane >= step ? other : 0;
    }
    __syncthreads();
    if (lane == 31)
        tally[thread / 32] = sum;
    __syncthreads();
    for (int k = 0; k < thread / 32; ++k)
        place += tally[k];
    // Each pair's places are taken from its start on, so that what is behind it becomes the next one's start.
    if (pair < pairs)
        start.data[pair + 1] = place + sum - own;
    if (pair == 0)
        start.data[0] = 0;
#else
    // Rows alone, which are what counts say wherever none is missing.
    int tally[SEGMENT_THREADS] = {}, place = 0;
    for (int i = 0; i < rows; ++i) {
        const int p = face.data[i][0] & pair_mask;
        place += p < first;
        if (p >= first && p < first + SEGMENT_THREADS)
            ++tally[p - first];
    }
    if (first == 0)
        start.data[0] = 0;
    for (int k = 0; k < SEGMENT_THREADS && first + k < pairs; ++k) {
        start.data[first + k + 1] = place;
        place += tally[k];
    }
#endif
}

inline CUDA_CALLABLE wp::int32 take_place(wp::array_t<wp::int32> end, wp::int32 pair) {
#if defined(__CUDA_ARCH__)
    // Lanes whose hits are of one pair take their places together.
    const unsigned int same = __match_any_sync(__activemask(), pair), lane = threadIdx.x & 31;
    const int leader = __ffs(same) - 1;
    int place = 0;
    if (lane == leader)
        place = atomicAdd(end.data + pair + 1, __popc(same));
    return __shfl_sync(same, place, leader) + __popc(same & ((1u << lane) - 1u));
#else
    return end.data[pair + 1]++;
#endif
}

inline CUDA_CALLABLE void sort_segment(wp::int32 thread, wp::int32 threads, wp::int32 flag,
                                       wp::array_t<wp::int32> start, wp::array_t<wp::int64> key,
                                       wp::array_t<wp::vec3i> sorted) {
    typedef SegmentSort::word word;
    const int pair = thread / threads, run = SEGMENT_KEYS * threads;
    SegmentSort sort;
    sort.threads = threads;
#if defined(__CUDA_ARCH__)
    __shared__ word memory[2 * SEGMENT_KEYS * SEGMENT_THREADS];
    const int group = threadIdx.x / threads;
    sort.begin = threadIdx.x & (threads - 1);
    sort.end = sort.begin + 1;
    sort.barrier = 1 + group;
    word *near = memory + 2 * run * group, *far = near + run;
#else
    word memory[2 * SEGMENT_KEYS * SEGMENT_THREADS], *near = memory, *far = near + run;
    sort.begin = 0;
    sort.end = threads;
    sort.barrier = 0;
#endif
    if (pair + 1 >= start.shape[0])
        return;
    // Rows that no launch has written may send starts and ends anywhere up to twice the room.
    const int room = sorted.shape[0] < key.shape[0] / 2 ? sorted.shape[0] : key.shape[0] / 2;
    const int first = start.data[pair], end = start.data[pair + 1], n = (end < room ? end : room) - first;
    if (n <= 0)
        return;
    word *own = (word*)key.data + first, *other = own + key.shape[0] / 2;
    if (n <= run) {
        sort.sort_lanes(own, near, n);
        sort.sync();
        sort.write_rows(sort.merge_all(near, far, n, 32), n, pair, flag, sorted.data + first);
        return;
    }
    for (int i = 0; i < n; i += run) {
        const int some = n - i < run ? n - i : run;
        sort.sort_lanes(own + i, near, some);
        sort.sync();
        sort.copy(sort.merge_all(near, far, some, 32), own + i, some);
        sort.sync();
    }
    sort.write_rows(sort.merge_all(own, other, n, run), n, pair, flag, sorted.data + first);
}
