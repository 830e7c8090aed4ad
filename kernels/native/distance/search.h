// The search for the nearest faces on the CPU: node pairs in vector instructions, faces in float32 with bounds.
#pragma once
#include "builtin.h"
#include "distance/boxes.h"
#include "distance/corners32.h"
#include "distance/memory.h"

// Bounds over `limit` are dropped; those over `soon` wait for later, when a nearer pair may have been found.
struct NearestLimits {
    float limit, soon;

    template <class SearchScale>
    void set(const NearestMemory::Header& h, const wp::vec4& terms, const SearchScale& scaling) {
        constexpr float PART[] = {0.6f, 0.85f, 1.0f};
        const float cut = h.found ? NearestMemory::cut_of(h.upper, terms) : h.upper;
        auto to_bound = [&](float x) {
            const float y = 2.0f * (x * scaling.grow + scaling.least);
            return x < 0.0f ? -1.0f : y * y;
        };
        limit = to_bound(cut);
        soon = h.level < 2 && !h.diving ? to_bound(PART[h.level] * cut) : limit;
    }
};

// Measure up to 16 pairs of faces in float32: those that may be nearest wait for float64.
template <class Trees, class PairPose, class SearchScale>
void measure_faces(const Trees& trees, const PairPose& pose, const SearchScale& scaling, const wp::vec4& terms,
                   const NearestMemory& m, const wp::int64* items, int count, NearestLimits& limits) {
    typedef NearestFaces N;
    typedef N::F F;
    NearestMemory::Header& h = *m.header;
    const N::Corners corners = NearestCorners::load(trees, pose, scaling.translation, scaling.scale, items, count);
    F::lanes size;
    const F::lanes d = __builtin_elementwise_sqrt(N::measure(corners, size));
    const F::lanes error = N::error_of(d, size, scaling.error), over = d + error, under = d - error;
    float low[16];
    h.diving = 0;
    for (int i = 0; i < count; ++i)
        if (over[i] < h.upper) {
            h.upper = over[i];
            h.found = 1;
        }
    __builtin_memcpy(low, &under, sizeof(low));
    limits.set(h, terms, scaling);
    for (int i = 0; i < count; ++i)
        if (low[i] <= h.upper) {
            m.open[h.open_count] = items[i];
            m.open_bound[h.open_count++] = low[i];
        }
    h.face_tests += count;
}

template <class Trees, class PairPose, class SearchScale, class Slabs, class PairTests>
bool search_nearest(const Trees& trees, const PairPose& pose, const SearchScale& scaling, wp::vec4 terms,
                    const Slabs& slabs, bool with_slabs, wp::int32 thread, wp::array_t<wp::float32> memory,
                    PairTests& tests) {
    const NearestMemory m = NearestMemory::find(memory.data, thread);
    NearestMemory::Header& h = *m.header;
    const auto& r = pose.rotation32.data;
    NearBoxes boxes = NearBoxes::make(r, scaling.back, scaling.translation, scaling.margin, scaling.scale,
                                      trees.states.node_box.data, pose.node_a, pose.node_b);
    boxes.margin = SLAB_MARGINS * scaling.margin;
    if (with_slabs) {
        boxes.slabs = (const char*)slabs.record.data - (const char*)trees.states.node_box.data;
        boxes.normals = h.face_tests >= NORMALS_LEAST;
    }
    // Apart from the memory that lists are written to.
    int top = h.top, later = h.later, waiting = h.waiting, node_tests = h.node_tests;
    NearestLimits limits;
    limits.set(h, terms, scaling);
    while (h.open_count <= OPEN_LENGTH - 16) {
        while (top > 0 && waiting < 16) {
            const int room = (CPU_STACK_LENGTH - DEPTH_FIRST_LENGTH - 16 - top) / 3, fits = room > 1 ? room : 1;
            const int most = h.diving ? 1 : NEAREST_AT_ONCE, wanted = fits < most ? fits : most;
            NearBoxes::Taken taken[NEAREST_AT_ONCE / 4][4];
            int count = 0;
            while (top > 0 && count < wanted) {
                --top;
                if (m.bound[top] <= limits.limit) {
                    taken[count >> 2][count & 3] = boxes.take(m.item[top]);
                    ++count;
                }
            }
            for (int i = count; i & 3; ++i) {
                taken[i >> 2][i & 3] = taken[0][0];
                taken[i >> 2][i & 3].used = 0;
            }
            const float now = later <= LATER_LENGTH - 4 * NEAREST_AT_ONCE - 16 ? limits.soon : limits.limit;
            for (int i = 0; 4 * i < count; ++i) {
                const NearBoxes::Tested tested = boxes.test(taken[i]);
                node_tests += __builtin_popcount(tested.used);
                const unsigned int near = tested.used & Float32::to_mask(tested.bound <= limits.limit);
                const unsigned int nodes = near & ~tested.leaves, first = nodes & Float32::to_mask(tested.bound <= now);
                Float32::append(m.item + top, tested.low, tested.high, first);
                Float32::append(m.bound + top, tested.bound, first);
                Float32::append(m.later + later, tested.low, tested.high, nodes & ~first);
                Float32::append(m.later_bound + later, tested.bound, nodes & ~first);
                Float32::append(m.face + waiting, tested.low, tested.high, near & tested.leaves);
                const int end = top + __builtin_popcount(first);
                later += __builtin_popcount(nodes & ~first);
                waiting += __builtin_popcount(near & tested.leaves);
                if (h.diving)
                    m.put_nearest_last(top, end);
                top = end;
            }
            if (h.diving && waiting > 0)
                break;
        }
        if (waiting > 0) {
            const int count = waiting < 16 ? waiting : 16;
            waiting -= count;
            measure_faces(trees, pose, scaling, terms, m, m.face + waiting, count, limits);
            boxes.normals = h.face_tests >= NORMALS_LEAST;
            if (h.open_count > OPEN_LENGTH - 16)
                m.keep_open();
        } else if (later > 0) {
            h.level = h.level < 2 ? h.level + 1 : 2;
            limits.set(h, terms, scaling);
            m.take_later(limits.soon, limits.limit, top, later);
        } else if (top == 0) {
            m.keep_open();
            tests.nodes = node_tests;
            tests.faces = h.face_tests;
            return false;
        }
    }
    h.top = top;
    h.later = later;
    h.waiting = waiting;
    h.node_tests = node_tests;
    return true;
}
