// Slabs of an object pair: when they pay, and what they need before the first subtree.
#pragma once
#include "builtin.h"
#include "intersect/slab_axes.h"
#include "intersect/slabs.h"

template <class ModelPool, class StatePool, class PairPose>
wp::int64 slab_cost(const ModelPool& models, const StatePool& states, const PairPose& pose, wp::int32 repeats) {
    wp::int64 cost = 0;
    // About how many faces an object has at its LOD: each vertex split adds as many as any other.
    auto faces_of = [&](int place) {
        const Slabs::Content x = Slabs::content_of(states.node_start.data, states.model.data, states.lod.data, place);
        return (wp::int64)models.face_count.data[x.model] * (x.lod + 1) / (models.lod_max.data[x.model] + 1);
    };
    const wp::int64 faces_a = faces_of(pose.node_a), faces_b = faces_of(pose.node_b);
    // Slabs of more than 2^14 faces do not stay in a cache.
    cost = faces_b < 16384 ? faces_b : faces_b * (faces_b >> 14);
    if (repeats < 2)
        cost += faces_a / 2;
    return cost;
}

template <class ModelPool, class StatePool, class PairPose, class Descent>
void open_subtrees(const ModelPool& models, const StatePool& states, const PairPose& pose, Descent& descent,
                   wp::array_t<wp::float32> memory) {
    const Slabs::Memory kept = Slabs::find_memory(memory.data, memory.shape[1], descent.thread);
    const Slabs::Box* nodes = (const Slabs::Box*)states.node_box.data;
    const Slabs::Content a = Slabs::content_of(states.node_start.data, states.model.data, states.lod.data, pose.node_a);
    if (!(*kept.whose == a)) {
        SlabAxes::choose_axes(nodes + pose.node_a, states.face_corner.data + pose.corner_a, models.vertex_near.data,
                              kept.axes);
        *kept.whose = a;
        for (int i = 0; i < kept.slots; ++i)
            kept.roots[i] = 0;
    }
    for (int i = 0; i < kept.slots; ++i)
        kept.roots[kept.slots + i] = 0;
    const auto& r = pose.rotation.data;
    const auto& t = pose.translation32;
    const Slabs::Box& whole = nodes[pose.node_a + 1];
    for (int d = 0; d < 16; ++d) {
        const double n[3] = {kept.axes[d], kept.axes[16 + d], kept.axes[32 + d]};
        double size = 0.0, middle = 0.0, shift = 0.0, reach = 0.0;
        for (int j = 0; j < 3; ++j) {
            const double low = whole.lower[j], high = whole.upper[j];
            size += __builtin_elementwise_abs(n[j]) * (high - low);
            middle += 0.5 * n[j] * (high + low);
            shift += n[j] * t[j];
            reach = __builtin_elementwise_max(reach, high - low);
        }
        // Slabs of A depend on A alone, which keeps them for other pairs. Where A is flat, numbers could overflow.
        const double steps = d < 14 && size * 0x1p20 > reach ? 65536.0 / size : 0.0;
        // Three times the margin of boxes covers all rounding, see docs/exactness.md. A direction that tells nothing,
        // since the margin is half of A's size or more, has slabs of B that reach everywhere.
        // Of a margin for distances, what is not for rounding counts once.
        const double margin = steps * (3.0 * pose.margin - 1.99 * pose.within);
        const double scale = margin < 32768.0 ? steps : 0.0;
        for (int j = 0; j < 3; ++j) {
            kept.of_a[16 * j + d] = (float)(steps * n[j]);
            kept.of_b[16 * j + d] = (float)(-scale * ((n[0] * r[0][j] + n[1] * r[1][j]) + n[2] * r[2][j]));
        }
        kept.of_a[48 + d] = (float)(-steps * middle);
        kept.of_b[48 + d] = (float)(scale * (middle - shift));
        kept.of_b[64 + d] = scale > 0.0 ? (float)margin : 65536.0f;
    }
    kept.floors[0] = descent.floors[0] = Slabs::find_floor(nodes + pose.node_a);
    kept.floors[1] = descent.floors[1] = Slabs::find_floor(nodes + pose.node_b);
}
