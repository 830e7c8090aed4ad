// A merge sort by a group of threads of a block. On the CPU, for tests, one thread does what all of them do, in turn.
#pragma once
#include "builtin.h"

struct SegmentSort {
    typedef unsigned long long word;
    // Threads of the group that this one stands for, all of them, a power of two, and the barrier that they have.
    int begin, end, threads, barrier;

    CUDA_CALLABLE void sync() const {
#if defined(__CUDA_ARCH__)
        asm volatile("bar.sync %0, %1;" ::"r"(barrier), "r"(threads) : "memory");
#endif
    }
    // Put each 32 keys in order: on CUDA by a bitonic network, a key a lane. Source: Batcher 1968, Sorting networks.
    CUDA_CALLABLE void sort_lanes(const word* from, word* to, int n) const {
#if defined(__CUDA_ARCH__)
        const int lane = begin & 31;
        for (int i = begin; i - lane < n; i += threads) {
            word key = i < n ? from[i] : ~0ull;
#pragma unroll
            for (int size = 2; size <= 32; size *= 2) {
#pragma unroll
                for (int step = size / 2; step > 0; step /= 2) {
                    const word other = __shfl_xor_sync(0xffffffffu, key, step);
                    const bool keeps_less = ((lane & step) == 0) == ((lane & size) == 0);
                    key = (other < key) == keeps_less ? other : key;
                }
            }
            if (i < n)
                to[i] = key;
        }
#else
        for (int i = 0; i < n; ++i) {
            int place = i;
            for (; place % 32 > 0 && to[place - 1] > from[i]; --place)
                to[place] = to[place - 1];
            to[place] = from[i];
        }
#endif
    }
    // Merge runs, a power of two long, by twos: each thread so many keys in a row, a power of two.
    // Source: Green et al. 2012, GPU Merge Path.
    CUDA_CALLABLE void merge(const word* from, word* to, int n, int run) const {
        int chunk = 1;
        while (chunk < 2 * run && chunk * threads < n)
            chunk *= 2;
        for (int thread = begin; thread < end; ++thread) {
            for (int first = thread * chunk; first < n; first += threads * chunk) {
                const int start = first & -(2 * run), place = first - start;
                const word *a = from + start, *b = a + run;
                const int a_count = n - start < run ? n - start : run;
                const int b_count = (n - start < 2 * run ? n - start : 2 * run) - a_count;
                int low = place < b_count ? 0 : place - b_count, high = place < a_count ? place : a_count;
                // As many of the first `place` keys are of a as come before those of b.
                while (low < high) {
                    const int middle = (low + high) / 2;
                    if (a[middle] <= b[place - 1 - middle])
                        low = middle + 1;
                    else
                        high = middle;
                }
                int i = low, j = place - low;
                word x = i < a_count ? a[i] : ~0ull, y = j < b_count ? b[j] : ~0ull;
                const int last = n - first < chunk ? n : first + chunk;
                for (int k = first; k < last; ++k) {
                    const bool takes_a = x <= y;
                    to[k] = takes_a ? x : y;
                    if (takes_a)
                        x = ++i < a_count ? a[i] : ~0ull;
                    else
                        y = ++j < b_count ? b[j] : ~0ull;
                }
            }
        }
    }
    // Merge runs until one is left, and return the memory that it lies in.
    CUDA_CALLABLE word* merge_all(word* from, word* to, int n, int run) const {
        for (; run < n; run *= 2) {
            merge(from, to, n, run);
            sync();
            word* last = from;
            from = to;
            to = last;
        }
        return from;
    }
    CUDA_CALLABLE void copy(const word* from, word* to, int n) const {
        for (int thread = begin; thread < end; ++thread) {
            for (int i = thread; i < n; i += threads)
                to[i] = from[i];
        }
    }
    // Write keys as rows of an object pair; the lowest bit is the pair's flag.
    CUDA_CALLABLE void write_rows(const word* keys, int n, int pair, int flag, wp::vec3i* rows) const {
        for (int thread = begin; thread < end; ++thread) {
            for (int i = thread; i < n; i += threads)
                rows[i] = wp::vec3i(pair | (keys[i] & 1 ? flag : 0), (wp::int32)(keys[i] >> 32),
                                    (wp::int32)((unsigned int)keys[i] >> 1));
        }
    }
};
