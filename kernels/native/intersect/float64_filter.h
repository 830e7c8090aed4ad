// The float64 filter of the CPU: 8 face pairs at a time, as `float64_filter_triangles` one by one. It can list those
// that are apart, too.
#pragma once
#include "builtin.h"
#include "base/sizes.h"
#include "base/float64.h"
#include "intersect/filter_lists.h"
#include "intersect/sides.h"

// What the filter reads of an object pair, and its steps.
template <class PairPose>
struct Float64Filter {
    typedef Float64 F;
    typedef F::lanes lanes;
    typedef F::bits bits;
    typedef F::ints ints;
    typedef F::Point Point;
    typedef F::Sign Sign;
    typedef int four_ints __attribute__((vector_size(16)));
    typedef unsigned int counts __attribute__((vector_size(32)));
    typedef int ids[STRADDLING_ROOM];
    const PairPose& pose;
    const double *position, *corners;

    __attribute__((always_inline)) Point gather_posed(const int* start) const {
        return F::pose(pose.rotation.data, pose.translation, F::gather(position, start));
    }
    // Where the corners' numbers start, of A and of B, of so many pairs of faces.
    __attribute__((always_inline)) void find_corners(const wp::int64* items, int count, ids (&start)[6]) const {
        const bits some = bits{} + items[0];
        for (int i = 0; i < count; i += 8) {
            const bits lane = {0, 1, 2, 3, 4, 5, 6, 7};
            const bits item = lane < count - i ? (bits) * (const Float32::loose_longs*)(items + i) : some;
            const counts face[2] = {2 * (counts)(pose.corner_a + __builtin_convertvector(item >> 32, ints)),
                                    2 * (counts)(pose.corner_b + __builtin_convertvector(item, ints))};
            for (int k = 0; k < 2; ++k) {
                auto at = [&](int j) { return *(const four_ints*)(corners + face[k][j]); };
                ints row[4];
                for (int j = 0; j < 4; ++j)
                    row[j] = __builtin_shufflevector(at(j), at(j + 4), 0, 1, 2, 3, 4, 5, 6, 7);
                const ints low_01 = __builtin_shufflevector(row[0], row[1], 0, 8, 1, 9, 4, 12, 5, 13);
                const ints low_23 = __builtin_shufflevector(row[2], row[3], 0, 8, 1, 9, 4, 12, 5, 13);
                const ints high_01 = __builtin_shufflevector(row[0], row[1], 2, 10, 3, 11, 6, 14, 7, 15);
                const ints high_23 = __builtin_shufflevector(row[2], row[3], 2, 10, 3, 11, 6, 14, 7, 15);
                const ints x = __builtin_shufflevector(low_01, low_23, 0, 1, 8, 9, 4, 5, 12, 13);
                const ints y = __builtin_shufflevector(low_01, low_23, 2, 3, 10, 11, 6, 7, 14, 15);
                const ints z = __builtin_shufflevector(high_01, high_23, 0, 1, 8, 9, 4, 5, 12, 13);
                *(F::loose_ints*)(start[3 * k] + i) = 4 * x;
                *(F::loose_ints*)(start[3 * k + 1] + i) = 4 * y;
                *(F::loose_ints*)(start[3 * k + 2] + i) = 4 * z;
            }
        }
    }
    // The corners at a place of three lists, rotated so that the lone one comes first, in either direction.
    static void rotate(const Alone& alone, unsigned int back, const int* a, const int* b, const int* c, ints* rotated) {
        const ints corner[3] = {F::look_up(a), F::look_up(b), F::look_up(c)};
        const ints first = F::widen(alone.first), second = F::widen(alone.second), turns_back = F::widen(back);
        rotated[0] = first ? corner[0] : second ? corner[1] : corner[2];
        const ints q = first ? corner[1] : second ? corner[2] : corner[0];
        const ints r = first ? corner[2] : second ? corner[0] : corner[1];
        rotated[1] = turns_back ? r : q;
        rotated[2] = turns_back ? q : r;
    }
    static Sides filtered(const Sign& sign) {
        const lanes bound = BOUND_3D * sign.size;
        const unsigned int above = F::to_mask(sign.value > bound), below = F::to_mask(sign.value < -bound);
        return Sides{above, below, 255 & ~(above | below | F::to_mask(bound == 0.0))};
    }
    // Up to 8 straddling pairs from one on, which two more signs decide.
    __attribute__((always_inline)) void order_ends(const ids (&rotated)[6], const wp::int64* straddling, int first,
                                                   int count, FilterLists& lists) const {
        const Point p1 = F::gather(position, rotated[0] + first), q1 = F::gather(position, rotated[1] + first);
        const Point r1 = F::gather(position, rotated[2] + first), p2 = gather_posed(rotated[3] + first);
        const Point q2 = gather_posed(rotated[4] + first), r2 = gather_posed(rotated[5] + first);
        const bits item = *(const Float32::loose_longs*)(straddling + first);
        const Point p1p2 = F::minus(p1, p2);
        const Sign start =
            F::orient_edges(p1p2, F::minus(p1, q2), F::minus(q1, p2), F::minus(q1, q2), F::minus(p2, q2));
        const Sign end = F::orient_edges(F::minus(p1, r2), p1p2, F::minus(r1, r2), F::minus(r1, p2), F::minus(r2, p2));
        const Sides s = filtered(start);
        const Sides e = filtered(end);
        const unsigned int all = (1u << count) - 1, left = all & ~(s.above | e.above);
        unsigned int inexact = left & (s.open | e.open);
        lists.keep_apart(item, all & ~left);
        lists.keep_hits(item, left & ~inexact);
        for (; __builtin_expect(inexact != 0, 0); inexact &= inexact - 1)
            lists.rest[lists.open++] = straddling[first + __builtin_ctz(inexact)];  // `append` could write over unread
    }
    // From each corner of A to each of B: the other way round, every rounding is the same.
    __attribute__((always_inline)) void find_differences(const ids (&start)[6], int at, Point (&d)[3][3],
                                                         Point (&size)[3][3]) const {
        const Point a[3] = {F::gather(position, start[0] + at), F::gather(position, start[1] + at),
                            F::gather(position, start[2] + at)};
        const Point b[3] = {gather_posed(start[3] + at), gather_posed(start[4] + at), gather_posed(start[5] + at)};
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                d[i][j] = F::minus(b[j], a[i]);
                size[i][j] = F::sizes(d[i][j]);
            }
    }
    // Of pairs that are left, those of which a sign is open or all are 0; of these, those that share a corner.
    static unsigned int find_undecided(unsigned int left, const lanes (&bound)[6], const Point (&size)[3][3],
                                       Sides (&side_a)[3], Sides (&side_b)[3], unsigned int& shared) {
        for (int i = 0; i < 3; ++i) {
            side_a[i].open = ~(side_a[i].above | side_a[i].below | F::to_mask(bound[i] == 0.0));
            side_b[i].open = ~(side_b[i].above | side_b[i].below | F::to_mask(bound[i + 3] == 0.0));
        }
        unsigned int undecided = Sides::has_all_zero(side_a) | Sides::has_all_zero(side_b);
        for (int i = 0; i < 3; ++i)
            undecided |= side_a[i].open | side_b[i].open;
        undecided &= left;
        shared = 0;
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                shared |= F::to_mask((size[i][j].x + size[i][j].y) + size[i][j].z == 0.0);
        shared &= undecided;
        return undecided;
    }
};

template <class Trees, class PairPose, class FaceLists>
void simd_float64_filter(const Trees& trees, const PairPose& pose, bool first_ends, bool lists_apart,
                         FaceLists& lists) {
#pragma clang fp contract(off)
    typedef Float64 F;
    typedef Float64Filter<PairPose> Filter;
    typedef F::lanes lanes;
    typedef F::bits bits;
    typedef F::ints ints;
    typedef F::Point Point;
    typedef F::Sign Sign;
    const double* position = (const double*)trees.models.vertex_pos.data;
    const Filter filter = {pose, position, (const double*)trees.states.face_corner.data};
    wp::int64 *items = lists.uncertain_faces.data, *beside = lists_apart ? lists.apart_faces.data : nullptr;
    FilterLists decided = {lists.faces.data, items, beside, lists.met, 0, lists.apart};
    int kept = 0;
    // Straddling pairs, which two more signs decide, and their corners, rotated: p, q, r of A and of B.
    typename Filter::ids rotated[6], start[6];
    wp::int64 straddling[STRADDLING_ROOM];
    // Behind the end of the list stand corners that there are.
    auto order_kept = [&]() {
        for (int i = 0; i < 6; ++i)
            *(F::loose_ints*)(rotated[i] + kept) = ints{};
        for (int i = 0; i < kept; i += 8)
            filter.order_ends(rotated, straddling, i, kept - i < 8 ? kept - i : 8, decided);
        kept = 0;
    };
    const int waiting = lists.uncertain, before = lists.met, at_once = first_ends ? 8 : STRADDLING_ROOM;
    int done = 0;
    while (done < waiting && (decided.met == before || !first_ends)) {
        const int count = waiting - done < 8 ? waiting - done : 8;
        const int at = done % at_once;
        if (at == 0)
            filter.find_corners(items + done, waiting - done < at_once ? waiting - done : at_once, start);
        const bits item = *(const Float32::loose_longs*)(items + done);
        done += count;
        Point d[3][3], d_size[3][3];
        filter.find_differences(start, at, d, d_size);
        Sides side_a[3], side_b[3];
        lanes bound[6];
#pragma clang loop unroll(full)
        for (int i = 0; i < 3; ++i) {
            const Sign of_a = F::determinant(d[i][0], d[i][1], d[i][2], d_size[i][0], d_size[i][1], d_size[i][2]);
            const Sign of_b = F::determinant(d[0][i], d[1][i], d[2][i], d_size[0][i], d_size[1][i], d_size[2][i]);
            bound[i] = BOUND_3D * of_a.size;
            bound[i + 3] = BOUND_3D * of_b.size;
            side_a[i] = Sides{F::to_mask(of_a.value > bound[i]), F::to_mask(of_a.value < -bound[i]), 0};
            side_b[i] = Sides{F::to_mask(of_b.value < -bound[i + 3]), F::to_mask(of_b.value > bound[i + 3]), 0};
        }
        const unsigned int all = (1u << count) - 1,
                           parted = all & (Sides::one_sided(side_a) | Sides::one_sided(side_b));
        decided.keep_apart(item, parted);
        unsigned int left = all & ~parted;
        Alone alone_a = Sides::find_lone(side_a), alone_b = Sides::find_lone(side_b);
        // Else no sign that counts is open or 0.
        if (__builtin_expect((left & ~(Sides::has_sides(side_a) & Sides::has_sides(side_b))) != 0, 0)) {
            unsigned int shared;
            const unsigned int undecided = Filter::find_undecided(left, bound, d_size, side_a, side_b, shared);
            left &= ~undecided;
            decided.keep_hits(item, shared);
            decided.keep_open(item, undecided & ~shared);
            alone_a = Sides::find_alone(side_a);
            alone_b = Sides::find_alone(side_b);
        }
        ints order[6];
        Filter::rotate(alone_a, alone_b.back, start[0] + at, start[1] + at, start[2] + at, order);
        Filter::rotate(alone_b, alone_a.back, start[3] + at, start[4] + at, start[5] + at, order + 3);
        for (int i = 0; i < 6; ++i)
            F::append_ints(rotated[i] + kept, order[i], left);
        Float32::append(straddling + kept, item, left);
        kept += __builtin_popcount(left);
        const bool last = first_ends || done == waiting;
        if (last || kept > STRADDLING_ROOM - 16)
            order_kept();
    }
    lists.met = decided.met;
    lists.uncertain = decided.open;
    lists.apart = decided.apart;
    lists.tested = done;
}
