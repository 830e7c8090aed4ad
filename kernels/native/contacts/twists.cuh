// Choice of contact points by violated twists: a twist a thread of a block on a GPU, 16 in a vector on the CPU.
#pragma once
#include "builtin.h"
#include "base/float32.h"
#include "base/groups.cuh"
#include "base/numbers.cuh"
#include "base/sizes.h"

struct TwistChoice {
    typedef Float32 F;
    typedef F::lanes lanes;
    typedef F::Point Point;
    typedef F::integers integers;
#if defined(__CUDA_ARCH__)
    static constexpr int GROUPS = 1;
    static CUDA_CALLABLE lanes load(const float* from) { return from[threadIdx.x]; }
#else
    typedef float loose __attribute__((vector_size(64), aligned(4)));
    static constexpr int GROUPS = TWIST_COUNT / F::LANES;
    static lanes load(const float* from) { return *(const loose*)from; }
#endif
    struct Twists {
        Point linear, angular;
        lanes stop;          // part of the motion that the points chosen allow
        lanes worst;         // how deep it takes a candidate then, or a bound of that
        integers candidate;  // the first that goes so deep, UNKNOWN beside a bound
    };
    // A candidate: normal, separation; moment of the normal, and its number.
    struct Wrench {
        Point normal, moment;
        lanes separation;
    };
    static constexpr float RIM = 0.95f;
    static constexpr int FEW_TWISTS = 8;
    static constexpr int UNKNOWN = -1;
    // More than the rounding of a bound, and of one that is too small for all its digits.
    static constexpr float ROUNDING = 1.0f + 0x1p-20f, TINY = 0x1p-146f;
    const wp::array_t<wp::vec4>& wrenches;
    int first, end;
    CUDA_CALLABLE Wrench get(int c) const {
        const wp::vec4 n = load_entry(wrenches, 2 * (wp::int64)c), m = load_entry(wrenches, 2 * (wp::int64)c + 1);
        const lanes zero = {};
        return Wrench{{zero + n[0], zero + n[1], zero + n[2]}, {zero + m[0], zero + m[1], zero + m[2]}, zero + n[3]};
    }
    // The first of those candidates of which a number is greatest.
    template <class Value>
    CUDA_CALLABLE int find_most(const Value& value) const {
        float most = -0x1p126f;
        int at = first;
        for (int k = first + group_lane(); k < end; k += group_size()) {
            const float x = value(load_entry(wrenches, 2 * (wp::int64)k));
            at = x > most ? k : at;
            most = x > most ? x : most;
        }
        find_greatest(most, at);
        return at;
    }
    static CUDA_CALLABLE lanes rate_of(const Twists& t, const Wrench& c) {
        return F::dot(t.linear, c.normal) + F::dot(t.angular, c.moment);
    }
    // Of all candidates, or of every so many-th from one on.
    CUDA_CALLABLE void find_worst(Twists& t, int from = 0, int step = 1) const {
        t.worst = lanes{} - 0x1p126f;
        t.candidate = integers{} + first;
        for (int k = first + from; k < end; k += step) {
            const Wrench c = get(k);
            const lanes depth = F::fuse(-rate_of(t, c), t.stop, -c.separation);
            const auto deeper = depth > t.worst;
            t.worst = deeper ? depth : t.worst;
            t.candidate = deeper ? integers{} + k : t.candidate;
        }
    }
#if defined(__CUDA_ARCH__)
    // Of the twists of a warp that have changed: of few, by all lanes for one after the other.
    CUDA_CALLABLE void find_worst_again(Twists& t, bool changed) const {
        unsigned int left = __ballot_sync(0xffffffffu, changed);
        if (__popc(left) > FEW_TWISTS && changed)
            find_worst(t);
        for (left = __popc(left) > FEW_TWISTS ? 0 : left; left != 0; left &= left - 1) {
            const int owner = __ffs(left) - 1, lane = threadIdx.x & 31;
            float x[7] = {t.linear.x, t.linear.y, t.linear.z, t.angular.x, t.angular.y, t.angular.z, t.stop};
            for (int k = 0; k < 7; ++k)
                x[k] = __shfl_sync(0xffffffffu, x[k], owner);
            Twists one = {{x[0], x[1], x[2]}, {x[3], x[4], x[5]}, x[6]};
            find_worst(one, lane, 32);
            find_greatest_of_warp(one.worst, one.candidate);
            t.worst = lane == owner ? one.worst : t.worst;
            t.candidate = lane == owner ? one.candidate : t.candidate;
        }
    }
#else
    void find_worst_again(Twists& t, const integers& changed) const {
        if (F::any(changed))
            find_worst(t);
    }
#endif
    // Turns about a line across a candidate's normal, at the rim of the candidates in a direction: what only the
    // outermost of them stop. The first two components of a twist are the direction's, along two vectors across the
    // normal.
    CUDA_CALLABLE void tilt(Twists& t, int candidate) const {
        const wp::vec4 n = load_entry(wrenches, 2 * (wp::int64)candidate);
        const float x = fabsf(n[0]), y = fabsf(n[1]), z = fabsf(n[2]);
        const bool of_x = x <= y && x <= z, of_y = !of_x && y < x && y <= z;
        const float e[3] = {of_x ? 1.0f : 0.0f, of_y ? 1.0f : 0.0f, of_x || of_y ? 0.0f : 1.0f};
        float u[3] = {n[1] * e[2] - n[2] * e[1], n[2] * e[0] - n[0] * e[2], n[0] * e[1] - n[1] * e[0]};
        const float length = sqrtf(u[0] * u[0] + u[1] * u[1] + u[2] * u[2]);
        for (int k = 0; k < 3; ++k)
            u[k] = length > 0.0f ? u[k] / length : 0.0f;
        const float v[3] = {n[1] * u[2] - n[2] * u[1], n[2] * u[0] - n[0] * u[2], n[0] * u[1] - n[1] * u[0]};
        // Across the direction: n x (c u + s v) = c v - s u.
        const lanes c = t.linear.x, s = t.linear.y, zero = {};
        t.angular = Point{c * v[0] - s * u[0], c * v[1] - s * u[1], c * v[2] - s * u[2]};
        lanes reach = zero;
        for (int k = first; k < end; ++k)
            reach = F::most(reach, -F::dot(t.angular, get(k).moment));
        reach = reach * RIM;
        const lanes size = F::root(F::fuse(reach, reach, zero + 1.0f));
        t.linear = Point{reach * n[0] / size, reach * n[1] / size, reach * n[2] / size};
        t.angular = Point{t.angular.x / size, t.angular.y / size, t.angular.z / size};
    }
    // Lets a candidate stop the twists that go against it. What goes a part of its way takes no candidate deeper than
    // that part of what it did, since none is inside at first.
    static CUDA_CALLABLE void block(Twists& t, const Wrench& c) {
        const lanes rate = rate_of(t, c), closing = -rate;
        const auto stops = (closing > 0x1p-20f) & (c.separation < t.stop * closing);
        const lanes stop = stops ? c.separation / closing : t.stop, bound = t.worst * (stop / t.stop) * ROUNDING + TINY;
        t.worst = stops ? (bound <= 0.0f ? lanes{} : bound) : t.worst;
        t.candidate = stops ? integers{} + UNKNOWN : t.candidate;
        t.stop = stop;
    }
    // Finds the greatest depth of all twists that are known, and the first candidate that one of them takes so deep.
    static CUDA_CALLABLE void find_deepest(const Twists (&twist)[GROUPS], float& depth, int& at) {
        depth = -0x1p126f;
        at = 0x7fffffff;
        for (int g = 0; g < GROUPS; ++g) {
            for (int k = 0; k < F::LANES; ++k) {
                const float worst = F::get_lane(twist[g].worst, k);
                const int candidate = F::get_lane(twist[g].candidate, k);
                if (candidate != UNKNOWN && (worst > depth || (worst == depth && candidate < at))) {
                    depth = worst;
                    at = candidate;
                }
            }
        }
        find_greatest(depth, at);
    }
};

inline CUDA_CALLABLE wp::int32 choose_by_twists(wp::array_t<wp::vec4> wrenches, wp::int32 first, wp::int32 end,
                                                wp::array_t<wp::float32> twists, wp::float32 limit,
                                                wp::float32 tolerance, wp::float32 deep, wp::int32 most,
                                                wp::array_t<wp::int32> chosen) {
    typedef TwistChoice T;
    const T choice = {wrenches, first, end};
    // The nearest candidate, which must be among those chosen or about as near as one; and that whose normal is most
    // against its own.
    const int nearest_at = choice.find_most([](const wp::vec4& n) { return -n[3]; });
    const wp::vec4 own = load_entry(wrenches, 2 * (wp::int64)nearest_at);
    const int against_at = choice.find_most(
        [&](const wp::vec4& n) { return -Float32::fuse(own[0], n[0], Float32::fuse(own[1], n[1], own[2] * n[2])); });
    float reached = 0x1p126f;
    T::Twists twist[T::GROUPS];
    for (int g = 0; g < T::GROUPS; ++g) {
        const int number = group_lane() + T::F::LANES * g;
        T::lanes x[6];
        for (int k = 0; k < 6; ++k)
            x[k] = T::load(twists.data + TWIST_COUNT * k + T::F::LANES * g);
        twist[g] = T::Twists{{x[0], x[1], x[2]}, {x[3], x[4], x[5]}, T::lanes{} + limit};
        if (number >= RANDOM_TWISTS)
            choice.tilt(twist[g], number < (RANDOM_TWISTS + TWIST_COUNT) / 2 ? nearest_at : against_at);
        choice.find_worst(twist[g]);
    }
    int count = 0;
    while (count < most) {
        float depth;
        int at;
        T::find_deepest(twist, depth, at);
        // Of the others those that may be deeper, or as deep: where motions have no limit nothing is known (NaN).
        bool found = false;
        for (int g = 0; g < T::GROUPS; ++g) {
            const auto open = (twist[g].candidate == T::UNKNOWN) & ((twist[g].worst <= tolerance) == 0) &
                              ((twist[g].worst < depth) == 0);
            found |= T::F::any(open);
            choice.find_worst_again(twist[g], open);
        }
        if (group_any(found))
            T::find_deepest(twist, depth, at);
        const bool is_last = count + 1 == most || depth <= tolerance;
        if (is_last && reached > deep)
            at = nearest_at;
        else if (depth <= tolerance)
            break;
        chosen.data[count++] = at;
        const T::Wrench c = choice.get(at);
        reached = wp::min(reached, T::F::first(c.separation));
        for (int g = 0; g < T::GROUPS; ++g)
            choice.block(twist[g], c);
    }
    return count;
}
