// Slabs of an object pair: when they pay, and what they need before the first subtree.
#pragma once
#include "builtin.h"
#include "search/slabs.h"

struct SlabAxes {
    typedef Slabs::lanes lanes;
    typedef Slabs::Box Box;
    // A face's normal, of unit length, or 0.
    static void find_normal(const void* near, const int* corner, float* normal) {
        const float *a = (const float*)near + 4 * (wp::int64)corner[0],
                    *b = (const float*)near + 4 * (wp::int64)corner[1];
        const float* c = (const float*)near + 4 * (wp::int64)corner[2];
        double u[3], v[3], n[3];
        for (int k = 0; k < 3; ++k) {
            u[k] = (double)b[k] - a[k];
            v[k] = (double)c[k] - a[k];
        }
        for (int k = 0; k < 3; ++k)
            n[k] = u[(k + 1) % 3] * v[(k + 2) % 3] - u[(k + 2) % 3] * v[(k + 1) % 3];
        const double size = __builtin_sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
        for (int k = 0; k < 3; ++k)
            normal[k] = size > 0.0 ? (float)(n[k] / size) : 0.0f;
    }
    // The axes, and normals of the faces of A from which those of other faces differ least.
    __attribute__((noinline)) static void choose_axes(const Box* tree, const void* corners, const void* near,
                                                      float* axes) {
        constexpr int GROUPS = SLAB_SAMPLES / 16;
        float normal[3][SLAB_SAMPLES];
        lanes angle[SLAB_SAMPLES][GROUPS];  // sines
        float least[SLAB_SAMPLES];
        unsigned int bits = 1;
        for (int i = 0; i < SLAB_SAMPLES; ++i) {
            int node = tree[1].skip;
            while (tree[node].face < 0) {
                bits = bits * 1664525u + 1013904223u;
                node = tree[2 * node + (bits >> 31)].skip;
            }
            float n[3];
            find_normal(near, (const int*)corners + 4 * (wp::int64)tree[node].face, n);
            for (int k = 0; k < 3; ++k)
                normal[k][i] = n[k];
        }
        typedef float loose __attribute__((vector_size(64), aligned(4)));
        auto sines = [&](const float* n, lanes* into) {
            for (int g = 0; g < GROUPS; ++g) {
                const lanes x = *(const loose*)(normal[0] + 16 * g), y = *(const loose*)(normal[1] + 16 * g);
                const lanes z = *(const loose*)(normal[2] + 16 * g), cosine = n[0] * x + n[1] * y + n[2] * z;
                const lanes square = 1.0f - cosine * cosine;
                into[g] = __builtin_elementwise_sqrt(square > 0.0f ? square : lanes{});
            }
        };
        for (int i = 0; i < SLAB_SAMPLES; ++i) {
            const float n[3] = {normal[0][i], normal[1][i], normal[2][i]};
            sines(n, angle[i]);
        }
        for (int i = 0; i < SLAB_SAMPLES; ++i)
            least[i] = 1.0f;
        for (int d = 0; d < 14; ++d) {
            float n[3] = {d == 0 ? 1.0f : 0.0f, d == 1 ? 1.0f : 0.0f, d == 2 ? 1.0f : 0.0f};
            lanes given[GROUPS];
            if (d >= 3) {
                lanes gains[GROUPS] = {};
                for (int i = 0; i < SLAB_SAMPLES; ++i)
                    for (int g = 0; g < GROUPS; ++g)
                        gains[g] += angle[i][g] < least[i] ? least[i] - angle[i][g] : lanes{};
                int best = 0;
                for (int i = 1; i < SLAB_SAMPLES; ++i)
                    if (gains[i / 16][i % 16] > gains[best / 16][best % 16])
                        best = i;
                for (int k = 0; k < 3; ++k)
                    n[k] = normal[k][best];
            }
            sines(n, given);
            for (int i = 0; i < SLAB_SAMPLES; ++i)
                least[i] = given[i / 16][i % 16] < least[i] ? given[i / 16][i % 16] : least[i];
            for (int k = 0; k < 3; ++k)
                axes[16 * k + d] = n[k];
        }
    }
};

template <class Trees, class PairPose>
wp::int64 slab_cost(const Trees& trees, const PairPose& pose, wp::int32 repeats) {
    const auto& models = trees.models;
    const auto& states = trees.states;
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

template <class Trees, class PairPose, class Descent>
void open_subtrees(const Trees& trees, const PairPose& pose, Descent& descent, wp::array_t<wp::float32> memory) {
    const auto& states = trees.states;
    const Slabs::Memory kept = Slabs::find_memory(memory.data, memory.shape[1], descent.thread);
    const Slabs::Box* nodes = (const Slabs::Box*)states.node_box.data;
    const Slabs::Content a = Slabs::content_of(states.node_start.data, states.model.data, states.lod.data, pose.node_a);
    if (!(*kept.whose == a)) {
        SlabAxes::choose_axes(nodes + pose.node_a, states.face_corner.data + pose.corner_a,
                              trees.models.vertex_near.data, kept.axes);
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
        // Three times the margin of boxes covers all rounding: docs/exactness.md, bound 11. A direction that tells
        // nothing, since the margin is half of A's size or more, has slabs of B that reach everywhere. Of a margin for
        // distances, what is not for rounding counts once.
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
