// Slabs of the nodes of a subtree, along directions that an object pair shares. A record has minima and negated maxima,
// 16 lanes each, in steps that divide A's size along a direction into 2^16, rounded outwards, and at most +-32767. For
// B the directions are negated, so that both are apart where the sum of two lanes is positive. The last two lanes of
// either are none: there lie `skip` with the minima and `face` with the maxima.
#pragma once
#include "builtin.h"
#include "sizes.h"

struct Slabs {
    typedef float lanes __attribute__((vector_size(64), aligned(64)));
    typedef short Record __attribute__((vector_size(64), aligned(64)));
    typedef int words __attribute__((vector_size(64), aligned(64)));
    typedef short half __attribute__((vector_size(32)));
    struct Box {
        float lower[3];
        int skip;
        float upper[3];
        int face;
    };
    // What a thread keeps: a header, then of each object the roots of the subtrees in its slots, then records.
    struct Memory {
        int* whose;                 // node + 1, model and LOD of the A whose axes and subtrees these are, 0 for none
        int* floors;                // levels of the subtrees' roots
        float *axes, *of_a, *of_b;  // unit directions, then scaled: three rows and a shift
        int slots, *roots;
        Record* records;
    };
    static Memory find_memory(float* data, int words, int thread) {
        const unsigned long long start = (unsigned long long)(data + (wp::int64)words * thread);
        float* base = (float*)((start + 63) & ~63ull);
        const int slots = (words - 16 - SLAB_HEADER) / (2 + 32 * SUBTREE_RECORDS);
        return Memory{(int*)base,
                      (int*)base + 3,
                      base + 16,
                      base + 64,
                      base + 128,
                      slots,
                      (int*)base + SLAB_HEADER,
                      (Record*)(base + SLAB_HEADER + 2 * slots)};
    }
    // One of both objects.
    struct Side {
        const Box* tree;
        const int* corners;  // four a face
        lanes axis[3], shift, margin;
        int floor;   // level of the subtrees' roots
        int* roots;  // of the subtrees in the slots, 0 for none
        Record* records;
    };
    static int level_of(unsigned int node) { return 31 - __builtin_clz(node); }
    static int place_of(unsigned int node, int floor) {
        const int below = 1 << (level_of(node) - floor);
        return below | (node & (below - 1));
    }
    // The first level at which subtrees are small enough: all leaves lie on two levels.
    static int find_floor(const Box* tree) {
        int node = tree[1].skip;
        while (tree[node].face < 0)
            node = tree[2 * node].skip;
        const int floor = level_of(node) + 1 - SUBTREE_DEPTH;
        return floor > 0 ? floor : 0;
    }
    // Rounded outwards: NaN does not occur.
    static half round_down(const lanes& x) {
        const lanes least = lanes{} - 32767.0f, most = lanes{} + 32767.0f;
        const lanes above = x < least ? least : x, within = above > most ? most : above;
        return __builtin_convertvector(__builtin_convertvector(__builtin_elementwise_floor(within), words), half);
    }
    static Record project(const Side& side, const void* near, int face) {
        lanes low = {}, high = {};
        for (int k = 0; k < 3; ++k) {
            const float* p = (const float*)near + 4 * (wp::int64)side.corners[4 * (wp::int64)face + k];
            lanes x = __builtin_elementwise_fma(side.axis[2], lanes{} + p[2], side.shift);
            x = __builtin_elementwise_fma(side.axis[1], lanes{} + p[1], x);
            x = __builtin_elementwise_fma(side.axis[0], lanes{} + p[0], x);
            low = k == 0 ? x : (x < low ? x : low);
            high = k == 0 ? x : (x > high ? x : high);
        }
        return __builtin_shufflevector(round_down(low - side.margin), round_down(-(high + side.margin)), 0, 1, 2, 3, 4,
                                       5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25,
                                       26, 27, 28, 29, 30, 31);
    }
    // Kept out of the traversal: inlined, it takes registers from the loops that every object pair runs through.
    __attribute__((noinline)) static void fill(const Side& side, const void* near, unsigned int root, Record* records) {
        unsigned int nodes[2 * SUBTREE_LEAVES];
        int count = 1;
        nodes[0] = root;
        for (int i = 0; i < count; ++i) {
            const Box& box = side.tree[nodes[i]];
            if (box.face < 0) {
                nodes[count] = 2 * box.skip;
                nodes[count + 1] = 2 * box.skip + 1;
                count += 2;
                __builtin_prefetch(side.tree + 2 * box.skip);
            } else
                __builtin_prefetch(side.corners + 4 * (wp::int64)box.face);
        }
        for (int i = 0; i < count; ++i) {
            const Box& box = side.tree[nodes[i]];
            for (int k = 0; k < 3 && box.face >= 0; ++k)
                __builtin_prefetch((const float*)near + 4 * (wp::int64)side.corners[4 * (wp::int64)box.face + k]);
        }
        while (count-- > 0) {
            const unsigned int node = nodes[count];
            const Box& box = side.tree[node];
            Record record;
            if (box.face >= 0)
                record = project(side, near, box.face);
            else {
                const Record* child = records + place_of(2 * box.skip, side.floor);
                record = __builtin_elementwise_min(child[0], child[1]);
            }
            words whole = (words)record;
            whole[7] = box.skip;
            whole[15] = box.face;
            record = (Record)whole;
            records[place_of(node, side.floor)] = record;
            if (box.skip != (int)node)
                records[place_of(box.skip, side.floor)] = record;
        }
        records[0] = records[1];  // a root alone, the first of two siblings
    }
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
