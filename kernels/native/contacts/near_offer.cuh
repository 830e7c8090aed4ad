// Offers of faces that are apart to slots: of one pair in each thread of a GPU, of 16 on the CPU.
#pragma once
#include "builtin.h"
#include "contacts/edge_offer.cuh"
#include "contacts/slots.cuh"
#include "distance/faces32.h"

// Faces look at one another whose normals have no greater product: within 60 degrees.
constexpr float LOOKS_AT = -0.5f;
// Farther than any point.
constexpr float FAR_AWAY = 0x1p60f;
// Faces look away from one another whose normals have a product that is no less.
constexpr float LOOKS_AWAY = -0x1p-10f;
// Of the smaller object's size: of parallel faces that are no smaller it counts where their edges cross.
constexpr float LARGE_FACE = 0x1p-3f;

struct NearOffer {
    typedef NearestFaces N;
    typedef Float32 F;
    typedef F::lanes lanes;
    typedef F::bits bits;
    typedef F::Point Point;
    struct Scores : SlotScores<lanes, bits, F::integers> {
        typedef SlotScores<lanes, bits, F::integers> Base;
        bits inside, counts;
        CUDA_CALLABLE Scores() {}
        CUDA_CALLABLE Scores(const Vector& n, const float* directions)
            : Base(Base::find_bin(n, directions), directions) {}
    };

    static CUDA_CALLABLE Point unit_normal(const Point (&c)[3]) {
        const Point n = N::cross_exactly(F::minus(c[1], c[0]), F::minus(c[2], c[0]));
        const lanes s = F::invert(F::root(F::dot(n, n)));
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
        return F::most(N::largest(F::minus(c[1], c[0])), N::largest(F::minus(c[2], c[0])));
    }
    // Whether a face lies in front of a plane, or within a slack of it.
    static CUDA_CALLABLE bits is_ahead(const Point (&c)[3], const Point& of, const Point& normal, const lanes& slack) {
        lanes lowest = F::dot(F::minus(c[0], of), normal);
        for (int k = 1; k < 3; ++k)
            lowest = F::least(lowest, F::dot(F::minus(c[k], of), normal));
        return lowest >= -slack;
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
        const lanes slack = size * 0x1p-20f;
        const lanes ahead_a = F::dot(joined.way, joined.normal_a), ahead_b = -F::dot(joined.way, joined.normal_b);
        const lanes product = F::dot(joined.normal_a, joined.normal_b);
        const bits facing = product <= LOOKS_AT;
        // Along a normal, or so near that normals tell the direction.
        const lanes least = distance * 0x1p-6f, straight = distance * 0.99f;
        const lanes most = F::most(F::absolute(ahead_a), F::absolute(ahead_b));
        const bits touches = distance <= slack, column = facing & (touches | (most >= straight));
        // An edge or a corner that stands over the other face, and not along it.
        const bits tilted = (product < LOOKS_AWAY) & (product > (float)-ALONG),
                   ahead = (ahead_a > least) & (ahead_b > least);
        bits over_a = tilted & ahead & (ahead_a >= straight), over_b = tilted & ahead & (ahead_b >= straight);
        if (F::any(tilted & touches)) {
            over_a = touches ? tilted & is_ahead(c.b, c.a[0], joined.normal_a, slack) : over_a;
            over_b = touches ? tilted & is_ahead(c.a, c.b[0], joined.normal_b, slack) : over_b;
        }
        over_b = over_a ? bits{} : over_b;
        const bits along = column | touches | over_a | over_b,
                   inside = column & (distance > slack) & (ahead_a < 0.0f) & (ahead_b < 0.0f);
        const lanes separation = inside ? -distance : distance;
        // What lies deeper inside than its distance is not measured by it (`near_points`).
        lanes lowest = zero;
        for (int k = 0; k < 6; ++k)
            lowest = joined.height[k] < lowest ? joined.height[k] : lowest;
        const bits fits = (separation >= 0.0f) | (-lowest <= distance * (1.0f + 0x1p-10f) + slack);
        const bits counts = (distance <= gap) & fits & (along | ahead);
        if (!F::any(counts)) {
            Scores none;
            none.inside = counts;
            none.counts = counts;
            return none;
        }
        // Faces that look at one another keep the mean: their slots then have more to choose from.
        const Point down = F::minus(Point{}, joined.normal_b), mean = F::minus(joined.normal_a, joined.normal_b);
        const bits takes_mean = along & (facing | ((over_a | over_b) == 0));
        const Point n =
            F::choose(takes_mean, mean, F::choose(over_a, joined.normal_a, F::choose(over_b, down, joined.way)));
        Scores scores(vector_of(n), directions);
        scores.inside = inside;
        scores.counts = counts;
        const bits shared = column & (separation >= 0.0f);
        const bits large = F::least(face_size(c.a), face_size(c.b)) * weight >= LARGE_FACE * gap;
        const bits of_a = shared | (over_b & large), of_b = shared | (over_a & large);
        // What touches beside a column, perhaps looking away, goes behind all that is in one.
        const lanes rank = (touches & ((column | over_a | over_b) == 0)) ? separation + gap : separation;
        scores.offer(weight, vector_of(N::add(joined.at, zero + 0.5f, joined.way)), rank, counts);
        for (int k = 0; k < 6; ++k) {
            const bits near = (joined.height[k] <= gap) & (joined.height[k] >= -gap);
            scores.offer(weight, vector_of(joined.corner[k]), joined.height[k], counts & (k % 2 ? of_a : of_b) & near);
        }
        const bits over = counts & large & ((shared & (product <= (float)-ALONG)) | over_a | over_b),
                   edges = counts & large & (along == 0);
        if (F::any(over)) {
            const Point up = F::choose(over_b, down, joined.normal_a);
            EdgeOffer<Scores>::offer_crossings(c, up, gap, weight, distance, slack, over, scores);
        }
        if (F::any(edges))
            EdgeOffer<Scores>::offer_ends(c, weight, distance * (1.0f + 0x1p-10f) + slack, edges, scores);
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
