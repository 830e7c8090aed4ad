// Slots of contact witnesses: bins of normals, of each the deepest and those that lie farthest in eight directions.
#pragma once
#include "builtin.h"
#include "base/sizes.h"
#include "base/float32.h"

// A score that none has.
constexpr float NO_SCORE = -0x1p126f;
constexpr wp::int64 NO_KEY = -0x7fffffffffffffff;
// The bit of a place that is a crossing contact, not one of the list of near face pairs.
constexpr unsigned int CROSSING_BIT = 0x80000000u;

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
    CUDA_CALLABLE SlotScores() {}
    // Directions: normals of bins and two vectors across each, by component.
    CUDA_CALLABLE SlotScores(const Vector& n, const float* directions) {
        const L none = L{} + NO_SCORE;
        L best = none;
        bin = I{};
        for (int k = 0; k < NORMAL_BINS; ++k) {
            const float* d = directions + 9 * k;
            const L cosine = dot(n, Vector{L{} + d[0], L{} + d[1], L{} + d[2]});
            const auto more = cosine > best;
            best = more ? cosine : best;
            bin = more ? I{} + 9 * k : bin;
        }
        for (int k = 0; k < 2; ++k) {
            const float* d = directions + 3 + 3 * k;
            across[k] = Vector{Float32::pick(d, bin), Float32::pick(d + 1, bin), Float32::pick(d + 2, bin)};
        }
        for (int k = 0; k < SCORES; ++k)
            score[k] = none;
    }
    CUDA_CALLABLE void offer(float weight, const Vector& point, const L& separation, const B& counts) {
        const L x = dot(across[0], point) * weight, y = dot(across[1], point) * weight, depth = -separation;
        const L sum = (x + y) * 0.70710678f, difference = (x - y) * 0.70710678f, none = L{} + NO_SCORE;
        const L along[SCORES] = {depth,     depth + x,   depth - x,          depth + y,         depth - y,
                                      depth + sum, depth - sum, depth + difference, depth - difference};
        for (int k = 0; k < SCORES; ++k) {
            const L found = counts ? along[k] : none;
            score[k] = found > score[k] ? found : score[k];
        }
    }
};

// A score as a number that sorts alike, above a place.
inline CUDA_CALLABLE wp::int64 make_slot_key(float score, unsigned int place) {
    union {
        float x;
        int bits;
    } number = {score};
    const int sorted = number.bits < 0 ? (int)(0x80000000u - (unsigned int)number.bits) : number.bits;
    return ((wp::int64)sorted << 32) | place;
}

// Of equal scores what crosses, then the lower place of contacts, and the lower faces of the list.
inline CUDA_CALLABLE bool beats(wp::int64 key, wp::int64 other, const wp::vec_t<3, wp::int32>* list) {
    if (other == NO_KEY || (key >> 32) != (other >> 32))
        return other == NO_KEY || key > other;
    const unsigned int place = (unsigned int)key, there = (unsigned int)other;
    if ((place | there) & CROSSING_BIT)
        return (place & CROSSING_BIT) && (!(there & CROSSING_BIT) || place < there);
    const wp::vec_t<3, wp::int32>&p = list[place], &q = list[there];
    return p[1] < q[1] || (p[1] == q[1] && p[2] < q[2]);
}

// Puts scores into slots side by side, which keep the best of all keys, whatever their order.
inline CUDA_CALLABLE void put_into_slots(wp::int64* slots, const float* scores, int count, unsigned int place,
                                         const wp::vec_t<3, wp::int32>* list) {
#if defined(__CUDA_ARCH__)
    // All loads before any atomic, so that they are under way together.
    long long others[SCORES];
#pragma unroll
    for (int k = 0; k < SCORES; ++k)
        others[k] = k < count ? __ldcg((const long long*)slots + k) : 0;
#pragma unroll
    for (int k = 0; k < SCORES; ++k) {
        const long long key = make_slot_key(scores[k], place);
        while (k < count && scores[k] > NO_SCORE && beats(key, others[k], list)) {
            const long long before = (long long)atomicCAS((unsigned long long*)slots + k, (unsigned long long)others[k],
                                                          (unsigned long long)key);
            if (before == others[k])
                break;
            others[k] = before;
        }
    }
#else
    for (int k = 0; k < count; ++k) {
        const wp::int64 key = make_slot_key(scores[k], place);
        if (scores[k] > NO_SCORE && beats(key, slots[k], list))
            slots[k] = key;
    }
#endif
}

inline CUDA_CALLABLE void offer_point(wp::vec_t<3, wp::float32> normal, wp::vec_t<3, wp::float32> point,
                                      wp::float32 separation, wp::float32 weight,
                                      wp::array_t<wp::float32> directions, wp::int32 place, wp::int32 pair,
                                      wp::array_t<wp::vec_t<3, wp::int32>> list, wp::array_t<wp::int64> slots) {
    typedef SlotScores<float, bool, int> Scores;
    Scores scores({normal[0], normal[1], normal[2]}, directions.data);
    scores.offer(weight, {point[0], point[1], point[2]}, separation, true);
    wp::int64* const slot = slots.data + (wp::int64)pair * SLOT_ROOM + SLOTS_A_BIN * (scores.bin / 9);
    put_into_slots(slot, scores.score, SCORES, CROSSING_BIT | (unsigned int)place, list.data);
}
