// Offers of faces that are apart to slots: of one pair in each thread of a GPU, of 16 on the CPU.
#pragma once
#include "builtin.h"
#include "contacts/slots.cuh"
#include "distance/faces32.h"

// Faces look at one another whose normals have no greater product: within 60 degrees.
constexpr float LOOKS_AT = -0.5f;
// Farther than any point.
constexpr float FAR_AWAY = 0x1p60f;
// Of the smaller object's size: of parallel faces that are no smaller it counts where their edges cross.
constexpr float LARGE_FACE = 0x1p-3f;

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
        bits inside, counts;
        CUDA_CALLABLE Scores() {}
        CUDA_CALLABLE Scores(const Vector& n, const float* directions)
            : Base(Base::find_bin(n, directions), directions) {}
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
    static CUDA_CALLABLE lanes face_size(const Point (&c)[3]) {
        return N::most(N::largest(F::minus(c[1], c[0])), N::largest(F::minus(c[2], c[0])));
    }
    // Rates the points over one another of edges that cross, seen along a normal: corners of what faces share.
    static CUDA_CALLABLE void offer_crossings(N::Corners c, const Point& normal, float gap, float weight,
                                              const lanes& slack, const bits& counts, Scores& scores) {
        lanes s;
        // One edge of A after the other, so that a GPU needs no stack.
#pragma unroll 1
        for (int i = 0; i < 3; ++i) {
            const Point e = F::minus(c.a[1], c.a[0]);
            for (int j = 0; j < 3; ++j) {
                const Point f = F::minus(c.b[(j + 1) % 3], c.b[j]);
                const Point v = N::between_edges(F::minus(c.b[j], c.a[0]), e, f, N::invert(F::dot(e, e)),
                                                 N::invert(F::dot(f, f)), s);
                const lanes height = F::dot(v, normal), square = height * height;
                const bits over = F::dot(v, v) <= F::fuse(square, lanes{} + (1.0f + 0x1p-6f), slack * slack);
                const bits near = (height <= gap) & (height >= -gap);
                scores.offer(weight, vector_of(N::add(c.a[0], s, e)), height, counts & over & near);
            }
            const Point first = c.a[0];
            c.a[0] = c.a[1];
            c.a[1] = c.a[2];
            c.a[2] = first;
        }
    }
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
        const bits along = column | touches,
                   inside = column & (distance > size * 0x1p-20f) & (ahead_a < 0.0f) & (ahead_b < 0.0f);
        const lanes separation = inside ? -distance : distance, least = distance * 0x1p-6f;
        // What lies deeper inside than its distance is not measured by it (`near_points`).
        lanes lowest = zero;
        for (int k = 0; k < 6; ++k)
            lowest = joined.height[k] < lowest ? joined.height[k] : lowest;
        const bits fits = (separation >= 0.0f) | (-lowest <= distance * (1.0f + 0x1p-10f) + size * 0x1p-20f);
        const bits counts = (distance <= gap) & fits & (along | ((ahead_a > least) & (ahead_b > least)));
        if (!F::any(counts)) {
            Scores none;
            none.inside = counts;
            none.counts = counts;
            return none;
        }
        const Point n = F::choose(along, F::minus(joined.normal_a, joined.normal_b), joined.way);
        Scores scores(vector_of(n), directions);
        scores.inside = inside;
        scores.counts = counts;
        // What touches beside a column, perhaps looking away, goes behind all that is in one.
        const lanes rank = column ? separation : separation + (along ? zero + gap : zero);
        scores.offer(weight, vector_of(N::add(joined.at, zero + 0.5f, joined.way)), rank, counts);
        for (int k = 0; k < 6; ++k) {
            const bits near = (joined.height[k] <= gap) & (joined.height[k] >= -gap);
            scores.offer(weight, vector_of(joined.corner[k]), joined.height[k],
                         counts & column & (separation >= 0.0f) & near);
        }
        const lanes smaller = N::least(face_size(c.a), face_size(c.b));
        const bits large = counts & column & (separation >= 0.0f) & (smaller * weight >= LARGE_FACE * gap) &
                           (F::dot(joined.normal_a, joined.normal_b) <= (float)-ALONG);
        if (F::any(large))
            offer_crossings(c, joined.normal_a, gap, weight, size * 0x1p-20f, large, scores);
        return scores;
    }
    // Where the slots are that scores belong in, and how many: of what is inside the deepest alone.
    static CUDA_CALLABLE int find_slots(int bin, bool inside, int& count) {
        count = inside ? 1 : SCORES;
        return SLOTS_A_BIN * (bin / 9) + (inside ? 2 * SCORES : SCORES);
    }
    static CUDA_CALLABLE unsigned long long name_of(const wp::vec2i& widths, int face_a, int face_b) {
        return ((unsigned long long)face_a << widths[1]) | (unsigned int)face_b;
    }
};

template <class Corners>
CUDA_CALLABLE void offer_faces(const Corners& a, const Corners& b, wp::float32 gap, wp::float32 weight,
                               wp::array_t<wp::float32> directions, wp::vec2i widths, wp::int32 face_a,
                               wp::int32 face_b, wp::int32 pair, wp::array_t<wp::int64> slots) {
    typedef NearOffer O;
    O::N::Corners c;
    spread_corners(a, c.a);
    spread_corners(b, c.b);
    const O::Scores scores = O::rate(c, gap, weight, directions.data);
#if defined(__CUDA_ARCH__)
    const bool counts = scores.counts, inside = scores.inside;
    const int bin = scores.bin;
    const float (&own)[SCORES] = scores.score;
#else
    const bool counts = scores.counts[0], inside = scores.inside[0];
    const int bin = scores.bin[0];
    float own[SCORES];
    for (int k = 0; k < SCORES; ++k)
        own[k] = scores.score[k][0];
#endif
    if (counts) {
        int count;
        wp::int64* const at = slots.data + (wp::int64)pair * SLOT_ROOM + O::find_slots(bin, inside, count);
        put_into_slots(at, own, count, widths[0] + widths[1], O::name_of(widths, face_a, face_b));
    }
}
