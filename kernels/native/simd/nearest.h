// The search for the nearest faces on the CPU: node pairs in vector instructions, faces in float32 with bounds.
#pragma once
#include "builtin.h"
#include "simd/near_boxes.h"
#include "simd/near_faces32.h"
#include "simd/nearest_memory.h"

void open_search(wp::float32 upper, wp::int64 first, wp::int32 thread, wp::array_t<wp::float32> memory) {
#include "simd/nearest_memory.h"
    const NearestMemory m = NearestMemory::find(memory.data, thread);
    NearestMemory::Header& h = *m.header;
    h = NearestMemory::Header{};
    h.upper = upper;
    h.top = 1;
    m.item[0] = first;
    m.bound[0] = 0.0f;
}

template <class ModelPool, class StatePool, class PairPose, class Frame>
wp::vec_t<3, wp::int32> search_nearest(ModelPool models, StatePool states, PairPose pose, Frame frame, wp::vec_t<4, wp::float32> spare,
                                       wp::int32 thread, wp::array_t<wp::float32> memory) {
#if defined(__CUDA_ARCH__)
    __trap();  // warps have a search of their own
    return wp::vec_t<3, wp::int32>();
#else
#include "simd/near_boxes.h"
#include "simd/near_faces32.h"
#include "simd/nearest_memory.h"
    typedef NearFaces N;
    typedef N::F F;
    const NearestMemory m = NearestMemory::find(memory.data, thread);
    NearestMemory::Header& h = *m.header;
    const auto& r = pose.rotation32.data;
    const NearBoxes boxes = NearBoxes::make(r, frame.back, frame.translation, frame.margin, frame.scale,
                                            states.node_box.data, pose.node_a, pose.node_b);
    const float INF = __builtin_inff();
    // Bounds over `limit` are dropped; those over `soon` wait for later, when a nearer pair may have been found.
    float cut = 0.0f, limit = 0.0f, soon = 0.0f;
    auto set_limits = [&]() {
        constexpr float PART[] = {0.6f, 0.85f, 1.0f};
        cut = NearestMemory::cut_of(h.upper, spare);
        auto to_bound = [&](float x) {
            const float y = 2.0f * (x * frame.grow + frame.least);
            return x < 0.0f ? -1.0f : y * y;
        };
        limit = to_bound(cut);
        soon = h.level < 2 && h.upper < INF ? to_bound(PART[h.level] * cut) : limit;
    };
    auto measure = [&](int count) {
        h.waiting -= count;
        wp::int64* items = m.face + h.waiting;
        const N::Corners corners = N::load(models.vertex_near.data, states.face_corner.data, pose.corner_a,
                                           pose.corner_b, r, frame.translation, frame.scale, items, count);
        F::lanes size, error;
        const F::lanes square = N::measure(corners, size);
        error = size * FACES_ERROR + frame.error;
        const F::lanes d = __builtin_elementwise_sqrt(square), over = d + error, under = d - error;
        float low[16];
        for (int i = 0; i < count; ++i)
            h.upper = over[i] < h.upper ? over[i] : h.upper;
        __builtin_memcpy(low, &under, sizeof(low));
        set_limits();
        for (int i = 0; i < count; ++i)
            if (low[i] <= h.upper) {
                m.open[h.open_count] = items[i];
                m.open_bound[h.open_count++] = low[i];
            }
        h.face_tests += count;
    };
    auto keep_open = [&]() {
        int kept = 0;
        for (int i = 0; i < h.open_count; ++i)
            if (m.open_bound[i] <= h.upper) {
                m.open[kept] = m.open[i];
                m.open_bound[kept++] = m.open_bound[i];
            }
        h.open_count = kept;
    };
    set_limits();
    while (h.open_count <= OPEN_LENGTH - 16) {
        while (h.top > 0 && h.waiting < 16) {
            const int room = (CPU_STACK_LENGTH - DEPTH_FIRST_LENGTH - h.top) / 3, fits = room > 1 ? room : 1;
            const int most = h.upper < INF ? NEAREST_AT_ONCE : 1, wanted = fits < most ? fits : most;
            NearBoxes::Taken taken[NEAREST_AT_ONCE];
            int count = 0;
            while (h.top > 0 && count < wanted) {
                --h.top;
                const float bound = m.bound[h.top];
                if (bound > limit)
                    continue;
                if (bound > soon && h.later < LATER_LENGTH) {
                    m.later[h.later] = m.item[h.top];
                    m.later_bound[h.later++] = bound;
                } else
                    taken[count++] = boxes.take(m.item[h.top]);
            }
            for (int i = 0; i < count; ++i) {
                const NearBoxes::Tested tested = boxes.test(taken[i]);
                h.node_tests += __builtin_popcount(tested.used);
                int nearest = h.top;
                for (int k = 0; k < 4; ++k) {
                    const bool used = (tested.used >> k & 1) && tested.bound[k] <= limit;
                    const bool leaf = used && (tested.leaves >> k & 1), node = used && !leaf;
                    m.item[h.top] = m.face[h.waiting] = tested.item[k];
                    m.bound[h.top] = tested.bound[k];
                    nearest = node && tested.bound[k] < m.bound[nearest] ? h.top : nearest;
                    h.top += node;
                    h.waiting += leaf;
                }
                // The nearest comes last, so that it is taken first.
                if (nearest < h.top) {
                    const wp::int64 item = m.item[nearest];
                    const float bound = m.bound[nearest];
                    m.item[nearest] = m.item[h.top - 1];
                    m.bound[nearest] = m.bound[h.top - 1];
                    m.item[h.top - 1] = item;
                    m.bound[h.top - 1] = bound;
                }
            }
            if (h.upper == INF && h.waiting > 0)
                break;
        }
        if (h.waiting > 0) {
            measure(h.waiting < 16 ? h.waiting : 16);
            if (h.open_count > OPEN_LENGTH - 16)
                keep_open();
        } else if (h.later > 0) {
            // What waited for later, of which much is too far by now; on the stack as much as leaves it room.
            h.level = h.level < 2 ? h.level + 1 : 2;
            set_limits();
            int kept = 0;
            for (int i = 0; i < h.later; ++i) {
                const float bound = m.later_bound[i];
                const wp::int64 item = m.later[i];
                if (bound <= soon && h.top < CPU_STACK_LENGTH / 2) {
                    m.item[h.top] = item;
                    m.bound[h.top++] = bound;
                } else if (bound <= limit) {
                    m.later[kept] = item;
                    m.later_bound[kept++] = bound;
                }
            }
            h.later = kept;
        } else if (h.top == 0) {
            keep_open();
            return wp::vec_t<3, wp::int32>(1, h.node_tests, h.face_tests);
        }
    }
    return wp::vec_t<3, wp::int32>(0, h.node_tests, h.face_tests);
#endif
}

wp::int64 take_nearest(wp::float32 upper, wp::float32 cut, wp::int32 thread, wp::array_t<wp::float32> memory) {
#include "simd/nearest_memory.h"
    const NearestMemory m = NearestMemory::find(memory.data, thread);
    NearestMemory::Header& h = *m.header;
    h.upper = upper < h.upper ? upper : h.upper;
    if (h.open_count == 0)
        return -1;
    int best = 0;
    for (int i = 1; i < h.open_count; ++i)
        best = m.open_bound[i] < m.open_bound[best] ? i : best;
    if (m.open_bound[best] > (cut < h.upper ? cut : h.upper)) {
        h.open_count = 0;
        return -1;
    }
    const wp::int64 item = m.open[best];
    m.open[best] = m.open[--h.open_count];
    m.open_bound[best] = m.open_bound[h.open_count];
    return item;
}
