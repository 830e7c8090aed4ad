// Directions of slabs: the axes, and normals of faces that stand for those of the others.
#pragma once
#include "builtin.h"
#include "intersect/slabs.h"

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
