// Slots of contact witnesses: bins of normals, of each the deepest and those that lie farthest in eight directions.
#pragma once
#include "builtin.h"
#include "base/sizes.h"
#include "base/float32.h"

// A score that none has.
constexpr float NO_SCORE = -0x1p126f;

// Scores of points, of one or of 16: L numbers, B flags, I whole numbers.
template <class L, class B, class I>
struct SlotScores {
    struct Vector {
        L x, y, z;
    };
    I bin;
    Vector across[2];
    L score[SCORES];

    static CUDA_CALLABLE L dot(const Vector& u, const Vector& v) {
        return Float32::fuse(u.x, v.x, Float32::fuse(u.y, v.y, u.z * v.z));
    }
    // Nine times the bin of a normal. Directions: normals of bins and two vectors across each, by component; two bins
    // each have opposite normals.
    static CUDA_CALLABLE I find_bin(const Vector& n, const float* directions) {
        L best = L{} + NO_SCORE;
        I bin = I{};
        for (int k = 0; k < NORMAL_BINS; ++k) {
            const int opposite = k ^ (k < 8 ? 7 : 3);
            if (opposite < k)
                continue;
            const float* d = directions + 9 * k;
            const L along = dot(n, Vector{L{} + d[0], L{} + d[1], L{} + d[2]}), cosine = Float32::absolute(along);
            const auto more = cosine > best;
            best = more ? cosine : best;
            bin = more ? (along >= 0.0f ? I{} + 9 * k : I{} + 9 * opposite) : bin;
        }
        return bin;
    }
    CUDA_CALLABLE SlotScores() {}
    CUDA_CALLABLE SlotScores(const I& bin, const float* directions) : bin(bin) {
        for (int k = 0; k < 2; ++k) {
            const float* d = directions + 3 + 3 * k;
            across[k] = Vector{Float32::pick(d, bin), Float32::pick(d + 1, bin), Float32::pick(d + 2, bin)};
        }
        for (int k = 0; k < SCORES; ++k)
            score[k] = L{} + NO_SCORE;
    }
    CUDA_CALLABLE void offer(float weight, const Vector& point, const L& separation, const B& counts) {
        // No score is -0. What does not count is so deep that reach is lost in rounding.
        const L x = dot(across[0], point) * weight, y = dot(across[1], point) * weight;
        const L depth = counts ? L{} - separation : L{} + NO_SCORE;
        const L sum = (x + y) * 0.70710678f, difference = (x - y) * 0.70710678f;
        const L along[SCORES] = {depth,       depth + x,   depth - x,          depth + y,         depth - y,
                                 depth + sum, depth - sum, depth + difference, depth - difference};
        for (int k = 0; k < SCORES; ++k)
            score[k] = Float32::most(along[k], score[k]);
    }
};

// A score as a number that sorts alike, above the bits of a name, of which the lower comes first.
inline CUDA_CALLABLE unsigned long long make_slot_key(float score, int width, unsigned long long name) {
    union {
        float x;
        unsigned int bits;
    } number = {score};
    const unsigned int sorted = number.bits >> 31 ? ~number.bits : number.bits | 0x80000000u;
    const unsigned long long kept = width > 32 ? sorted >> (width - 32) : sorted;
    return (kept << (width > 32 ? width : 32)) | (((1ull << width) - 1) & ~name);
}

// Puts scores into slots side by side, which keep the greatest of all keys.
inline CUDA_CALLABLE void put_into_slots(wp::int64* slots, const float* scores, int count, int width,
                                         unsigned long long name) {
    unsigned long long* const keys = (unsigned long long*)slots;
#if defined(__CUDA_ARCH__)
    // All loads before any atomic, so that they are under way together; few go on to one.
    unsigned long long others[SCORES];
#pragma unroll
    for (int k = 0; k < SCORES; ++k)
        others[k] = k < count ? __ldcg(keys + k) : ~0ull;
#pragma unroll
    for (int k = 0; k < SCORES; ++k) {
        const unsigned long long key = make_slot_key(scores[k], width, name);
        if (scores[k] > NO_SCORE && key > others[k])
            atomicMax(keys + k, key);
    }
#else
    for (int k = 0; k < count; ++k) {
        const unsigned long long key = make_slot_key(scores[k], width, name);
        if (scores[k] > NO_SCORE && key > keys[k])
            keys[k] = key;
    }
#endif
}

#if !defined(__CUDA_ARCH__)
// Scores of several pairs of faces as the high bits of keys, to put them into slots one pair after the other.
template <class L, class B, class I>
struct SlotKeys {
    typedef unsigned int numbers __attribute__((vector_size(sizeof(L))));
    typedef unsigned int eight __attribute__((vector_size(32)));
    typedef unsigned long long keys __attribute__((vector_size(64)));
    typedef unsigned long long loose_keys __attribute__((vector_size(64), aligned(8)));
    const SlotScores<L, B, I>& scores;
    const int width;
    numbers kept[SCORES];
    I whole;  // whether there are all scores of a pair

    SlotKeys(const SlotScores<L, B, I>& scores, int width) : scores(scores), width(width), whole(I{} - 1) {
        const int dropped = width > 32 ? width - 32 : 0;
        for (int k = 0; k < SCORES; ++k) {
            const numbers x = (numbers)scores.score[k];
            kept[k] = ((I)x < 0 ? ~x : x | 0x80000000u) >> dropped;
            whole &= scores.score[k] > NO_SCORE;
        }
    }
    // As `put_into_slots`.
    void put(wp::int64* slots, int lane, int count, unsigned long long name) const {
        if (count != SCORES || !whole[lane]) {
            float own[SCORES];
            for (int k = 0; k < count; ++k)
                own[k] = scores.score[k][lane];
            put_into_slots(slots, own, count, width, name);
            return;
        }
        static_assert(SCORES == 9, "eight and another one");
        const int shift = width > 32 ? width : 32;
        const unsigned long long low = ((1ull << width) - 1) & ~name;
        eight high;
        for (int k = 0; k < 8; ++k)
            high[k] = kept[k][lane];
        const keys key = __builtin_convertvector(high, keys) << shift | low, other = *(const loose_keys*)slots;
        *(loose_keys*)slots = key > other ? key : other;
        const unsigned long long last = (unsigned long long)kept[8][lane] << shift | low;
        if (last > (unsigned long long)slots[8])
            slots[8] = last;
    }
};
#endif
