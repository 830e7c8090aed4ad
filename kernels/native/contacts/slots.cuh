// Slots of contact witnesses: bins of normals, of each the deepest and those that lie farthest in eight directions.
#pragma once
#include "builtin.h"
#include "base/sizes.h"
#include "distance/faces32.h"

// Faces look at one another whose normals have no greater product: within 60 degrees.
constexpr float LOOKS_AT = -0.5f;
// A score that none has, and what is farther than any point.
constexpr float NO_SCORE = -0x1p126f, FAR_AWAY = 0x1p60f;
constexpr wp::int64 NO_KEY = -0x7fffffffffffffff;
// The bit of a place that is a crossing contact, not one of the list of near face pairs.
constexpr unsigned int CROSSING_BIT = 0x80000000u;

inline CUDA_CALLABLE float fuse_any(float a, float b, float c) {
#if defined(__CUDA_ARCH__)
    return __fmaf_rn(a, b, c);
#else
    return __builtin_fmaf(a, b, c);
#endif
}
#if !defined(__CUDA_ARCH__)
inline Float32::lanes fuse_any(const Float32::lanes& a, const Float32::lanes& b, const Float32::lanes& c) {
    return Float32::fuse(a, b, c);
}
#endif
inline CUDA_CALLABLE int pick(const int* from, int at) { return from[at]; }
inline CUDA_CALLABLE float pick(const float* from, int at) { return from[at]; }
#if !defined(__CUDA_ARCH__)
inline Float32::lanes pick(const float* from, const Float32::bits& at) {
    Float32::lanes x;
    for (int k = 0; k < 16; ++k)
        x[k] = from[at[k]];
    return x;
}
#endif

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
        return fuse_any(u.x, v.x, fuse_any(u.y, v.y, u.z * v.z));
    }
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
            across[k] = Vector{pick(d, bin), pick(d + 1, bin), pick(d + 2, bin)};
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

// Keeps the best of all keys, whatever their order.
inline CUDA_CALLABLE void put_into_slot(wp::int64* slot, wp::int64 key, const wp::vec_t<3, wp::int32>* list) {
#if defined(__CUDA_ARCH__)
    long long other = __ldcg((const long long*)slot);
    while (beats(key, other, list)) {
        const long long before =
            (long long)atomicCAS((unsigned long long*)slot, (unsigned long long)other, (unsigned long long)key);
        if (before == other)
            return;
        other = before;
    }
#else
    if (beats(key, *slot, list))
        *slot = key;
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
    for (int k = 0; k < SCORES; ++k)
        put_into_slot(slot + k, make_slot_key(scores.score[k], CROSSING_BIT | (unsigned int)place), list.data);
}

// Near faces that do not cross: of one pair in each thread of a GPU, of 16 on the CPU.
struct NearOffer {
    typedef NearestFaces N;
    typedef Float32 F;
    typedef F::lanes lanes;
    typedef F::bits bits;
    typedef F::Point Point;
#if defined(__CUDA_ARCH__)
    typedef int integers;
#else
    typedef bits integers;
#endif
    struct Scores : SlotScores<lanes, bits, integers> {
        typedef SlotScores<lanes, bits, integers> Base;
        bits inside;
        CUDA_CALLABLE Scores(const Vector& n, const float* directions) : Base(n, directions) {}
    };

    static CUDA_CALLABLE Point unit_normal(const Point (&c)[3]) {
        const Point n = N::cross_exactly(F::minus(c[1], c[0]), F::minus(c[2], c[0]));
        const lanes s = N::invert(F::root(F::dot(n, n)));
        return Point{n.x * s, n.y * s, n.z * s};
    }
    // What joins two faces: from a point of A to the nearest of B; corners over a face, and how far in front of it.
    struct Joined {
        Point normal_a, normal_b, at, way, corner[6];
        lanes square, height[6];
        int count;
        CUDA_CALLABLE void offer(const Point& v, const Point& point) {
            const lanes found = F::dot(v, v);
            const auto closer = found < square;
            square = closer ? found : square;
            way = F::choose(closer, v, way);
            at = F::choose(closer, point, at);
        }
        CUDA_CALLABLE void note(const Point& v, const Point& point, const Point& normal) {
            corner[count] = point;
            height[count++] = v.x < FAR_AWAY ? F::dot(v, normal) : lanes{} + FAR_AWAY;
        }
        CUDA_CALLABLE void offer_edges(const Point& v, const Point& p, const lanes& s, const Point& e) {
            offer(v, N::add(p, s, e));
        }
        CUDA_CALLABLE void offer_corner_of_b(const Point& v, const Point& point) {
            note(v, point, normal_a);
            offer(v, F::minus(point, v));
        }
        CUDA_CALLABLE void offer_corner_of_a(const Point& v, const Point& point) {
            note(v, point, normal_b);
            offer(Point{-v.x, -v.y, -v.z}, point);
        }
    };
    static CUDA_CALLABLE Scores::Vector vector_of(const Point& p) { return {p.x, p.y, p.z}; }
    static CUDA_CALLABLE Scores rate(const N::Corners& c, float gap, float weight, const float* directions) {
        const lanes zero = {};
        Joined joined;
        joined.normal_a = unit_normal(c.a);
        joined.normal_b = unit_normal(c.b);
        joined.square = zero + 0x1.fffffep127f;
        joined.at = joined.way = Point{zero, zero, zero};
        joined.count = 0;
        const lanes size = N::visit(c, joined), distance = F::root(joined.square);
        const lanes ahead_a = F::dot(joined.way, joined.normal_a), ahead_b = -F::dot(joined.way, joined.normal_b);
        const bits facing = F::dot(joined.normal_a, joined.normal_b) <= LOOKS_AT;
        // Along a normal, or so near that normals tell the direction.
        const lanes most = N::most(F::absolute(ahead_a), F::absolute(ahead_b));
        const bits touches = distance <= size * 0x1p-20f, column = facing & (touches | (most >= distance * 0.99f));
        const bits along = column | touches, inside = column & (distance > size * 0x1p-20f) & (ahead_a < 0.0f) & (ahead_b < 0.0f);
        const lanes separation = inside ? -distance : distance, least = distance * 0x1p-6f;
        // What lies deeper inside than its distance is not measured by it (`near_points`).
        lanes lowest = zero;
        for (int k = 0; k < 6; ++k)
            lowest = joined.height[k] < lowest ? joined.height[k] : lowest;
        const bits fits = (separation >= 0.0f) | (-lowest <= distance * (1.0f + 0x1p-10f) + size * 0x1p-20f);
        const bits counts = (distance <= gap) & fits & (along | ((ahead_a > least) & (ahead_b > least)));
        const Point n = F::choose(along, F::minus(joined.normal_a, joined.normal_b), joined.way);
        Scores scores(vector_of(n), directions);
        scores.inside = inside;
        // What touches beside a column, perhaps looking away, goes behind all that is in one.
        const lanes rank = column ? separation : separation + (along ? zero + gap : zero);
        scores.offer(weight, vector_of(N::add(joined.at, zero + 0.5f, joined.way)), rank, counts);
        for (int k = 0; k < 6; ++k) {
            const bits near = (joined.height[k] <= gap) & (joined.height[k] >= -gap);
            scores.offer(weight, vector_of(joined.corner[k]), joined.height[k], counts & column & (separation >= 0.0f) & near);
        }
        return scores;
    }
    // Puts the scores of a lane into the slots of its object pair: of what is inside the deepest alone.
    static CUDA_CALLABLE void put(const Scores& scores, int lane, int place, wp::int64* slots,
                                  const wp::vec_t<3, wp::int32>* list) {
#if defined(__CUDA_ARCH__)
        const int bin = scores.bin / 9;
        const bool inside = scores.inside;
#else
        const int bin = scores.bin[lane] / 9;
        const bool inside = scores.inside[lane] != 0;
#endif
        wp::int64* const slot = slots + SLOTS_A_BIN * bin + (inside ? 2 * SCORES : SCORES);
        for (int k = 0; k < (inside ? 1 : SCORES); ++k) {
#if defined(__CUDA_ARCH__)
            const float score = scores.score[k];
#else
            const float score = scores.score[k][lane];
#endif
            if (score > NO_SCORE)
                put_into_slot(slot + k, make_slot_key(score, place), list);
        }
    }
};

template <class Corners>
CUDA_CALLABLE void offer_faces(const Corners& a, const Corners& b, wp::float32 gap, wp::float32 weight,
                               wp::array_t<wp::float32> directions, wp::int32 place, wp::int32 pair,
                               wp::array_t<wp::vec_t<3, wp::int32>> list, wp::array_t<wp::int64> slots) {
    typedef NearOffer O;
    const O::lanes zero = {};
    O::N::Corners c;
    for (int k = 0; k < 3; ++k) {
        c.a[k] = O::Point{zero + a.data[k][0], zero + a.data[k][1], zero + a.data[k][2]};
        c.b[k] = O::Point{zero + b.data[k][0], zero + b.data[k][1], zero + b.data[k][2]};
    }
    const O::Scores scores = O::rate(c, gap, weight, directions.data);
    O::put(scores, 0, place, slots.data + (wp::int64)pair * SLOT_ROOM, list.data);
}
