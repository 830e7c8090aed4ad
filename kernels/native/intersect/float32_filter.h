// The float32 filter of the CPU: 16 face pairs at a time, as `float32_filter_triangles` one by one. With a gap, 0 or
// more, it also lists those that are apart, but not by more than the gap along the normal of a plane or of an edge.
#pragma once
#include "builtin.h"
#include "intersect/sides.h"
#include "triangle/face_items.h"
#include "triangle/float32_filter.cuh"

// In A's frame and scaled, of corners in the frames of their models.
template <class PairPose>
inline void pose_corners(const PairPose& pose, Float32::Point (&a)[3], Float32::Point (&b)[3]) {
    typedef Float32 F;
    const auto& r = pose.rotation32.data;
    const auto& t = pose.translation32;
    const float scale = (float)pose.scale;
    for (int k = 0; k < 3; ++k) {
        const F::Point p = a[k], q = b[k];
        a[k] = F::Point{p.x * scale, p.y * scale, p.z * scale};
        F::lanes x[3];
        for (int i = 0; i < 3; ++i) {
            x[i] = F::fuse(F::every(r[i][2]), q.z, F::every(t[i]));
            x[i] = F::fuse(F::every(r[i][0]), q.x, F::fuse(F::every(r[i][1]), q.y, x[i]));
        }
        b[k] = F::Point{x[0] * scale, x[1] * scale, x[2] * scale};
    }
}

// Of three corners over a plane their sides; where they lie on one side, where they lie there farther than a gap, and
// where one is UNCERTAIN or all are 0.
struct FilterSides {
    typedef Float32 F;
    Sides sides[3];
    unsigned int one_sided, far, uncertain;

    static FilterSides make(const PlaneFilter::Heights& x) {
        FilterSides s;
        unsigned int any_open = 0, all_open = ~0u;
        for (int i = 0; i < 3; ++i) {
            const unsigned int above = F::to_mask(x.value[i] > x.bound), below = F::to_mask(x.value[i] < -x.bound);
            s.sides[i] = Sides{above, below, ~(above | below)};
            any_open |= s.sides[i].open;
            all_open &= s.sides[i].open;
        }
        s.far = s.one_sided = Sides::one_sided(s.sides);
        s.uncertain = any_open & (~F::to_mask(x.bound == 0.0f) | all_open);
        return s;
    }
    void find_far(const PlaneFilter::Heights& x, const F::lanes& wide) {
        far = F::to_mask((x.value[0] > wide) & (x.value[1] > wide) & (x.value[2] > wide)) |
              F::to_mask((x.value[0] < -wide) & (x.value[1] < -wide) & (x.value[2] < -wide));
    }
    // The corners rotated so that the lone one comes first.
    void rotate(const F::Point (&c)[3], F::bits& back, F::Point& p, F::Point& q, F::Point& last) const {
        const Alone alone = Sides::find_alone(sides);
        const F::bits first = F::widen(alone.first), second = F::widen(alone.second);
        back = F::widen(alone.back);
        p = F::choose(first, c[0], F::choose(second, c[1], c[2]));
        q = F::choose(first, c[1], F::choose(second, c[2], c[0]));
        last = F::choose(first, c[2], F::choose(second, c[0], c[1]));
    }
};

template <class Trees, class PairPose, class FaceLists>
void simd_float32_filter(const Trees& trees, const PairPose& pose, wp::vec3 bounds, bool first_ends, FaceLists& lists) {
#pragma clang fp contract(off)
    typedef Float32 F;
    typedef F::bits bits;
    typedef F::Point Point;
    const float error = bounds[0], gap = bounds[2];
    const PlaneFilter filter = {error, bounds[1]};
    wp::int64 *list = lists.faces.data, *rest = lists.uncertain_faces.data, *beside = lists.apart_faces.data;
    const int waiting = lists.waiting;
    int met = 0, open = 0, done = 0, near_count = 0;
    if (error == __builtin_inff()) {
        for (; open < waiting; ++open)
            rest[open] = list[open];
        done = waiting;
    }
    while (done < waiting && (done == 0 || met == 0 || !first_ends)) {
        const int count = waiting - done < 16 ? waiting - done : 16;
        const FaceItems items(list + done, count);
        done += count;
        Point a[3], b[3];
        items.gather(trees, pose, a, b);
        pose_corners(pose, a, b);
        PlaneFilter::Heights of_a, of_b;
        filter.compare_planes(a, b, of_a, of_b);
        FilterSides sides_a = FilterSides::make(of_a), sides_b = FilterSides::make(of_b);
        const unsigned int one_sided = sides_a.one_sided | sides_b.one_sided;
        unsigned int all = (1u << count) - 1;
        auto keep_near = [&](unsigned int which) { near_count += items.append(beside + near_count, which); };
        if (gap >= 0.0f) {
            sides_a.find_far(of_a, filter.widen(of_a.bound, gap, b));
            sides_b.find_far(of_b, filter.widen(of_b.bound, gap, a));
            all &= ~(sides_a.far | sides_b.far);
            all &= ~F::to_mask(filter.are_beyond_edge(a, b, gap) | filter.are_beyond_edge(b, a, gap));
            keep_near(all & one_sided);
        }
        const unsigned int left = ~one_sided & all;
        const unsigned int planes_open = sides_a.uncertain | sides_b.uncertain;
        // For coincident or nearly coincident meshes, usually every pair is uncertain here.
        if ((left & ~planes_open) == 0) {
            open += items.append(rest + open, left);
            continue;
        }
        bits back_a, back_b;
        Point p1, q1, r1, p2, q2, r2;
        sides_a.rotate(a, back_a, p1, q1, r1);
        sides_b.rotate(b, back_b, p2, q2, r2);
        unsigned int clear = 0, ends_open = 0;
        auto order = [&](const Point& p, const Point& q, const Point& r, const Point& t) {
            F::lanes bound;
            const F::lanes value = filter.side_of_plane(p, q, r, t, bound);
            const unsigned int above = F::to_mask(value > bound);
            clear |= above;
            ends_open |= ~(above | F::to_mask(value < -bound) | F::to_mask(bound == 0.0f));
        };
        order(p1, F::choose(back_b, r1, q1), p2, F::choose(back_a, r2, q2));
        order(p1, F::choose(back_b, q1, r1), F::choose(back_a, q2, r2), p2);
        const unsigned int opens = left & (planes_open | (~clear & ends_open));
        const unsigned int meet = left & ~opens & ~clear;
        if (gap >= 0.0f)
            keep_near(left & ~opens & clear);
        if (opens != 0)
            open += items.append(rest + open, opens);
        // Last: those that meet take the place of pairs that were tested, perhaps of these.
        met += items.append(list + met, meet);
    }
    lists.met = met;
    lists.uncertain = open;
    lists.apart = near_count;
    lists.tested = done;
}
