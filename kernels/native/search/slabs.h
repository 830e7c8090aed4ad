// Slabs of the nodes of a subtree, along directions that an object pair shares. A record has minima and negated maxima,
// 16 lanes each, in steps that divide A's size along a direction into 2^16, rounded outwards, and at most +-32767. For
// B the directions are negated, so that both are apart where the sum of two lanes is positive. The last two lanes of
// either are none: there lie `skip` with the minima and `face` with the maxima.
#pragma once
#include "builtin.h"
#include "base/sizes.h"

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
    // A model at an LOD decides all that stands at its place, in whichever launch; place 0 is none.
    struct Content {
        int place, model, lod;
        bool operator==(const Content& other) const {
            return place == other.place && model == other.model && lod == other.lod;
        }
    };
    static Content content_of(const int* node_start, const int* model, const int* lod, int place) {
        int state = 0;
        while (node_start[state] != place)
            ++state;
        return Content{place + 1, model[state], lod[state]};
    }
    // What a thread keeps: a header, then of each object the roots of the subtrees in its slots, then records.
    struct Memory {
        Content* whose;             // whose axes and subtrees of A these are
        int* floors;                // levels of the subtrees' roots
        float *axes, *of_a, *of_b;  // unit directions, then scaled: three rows and a shift
        int slots, *roots;
        Record* records;
    };
    static Memory find_memory(float* data, int words, int thread) {
        const unsigned long long start = (unsigned long long)(data + (wp::int64)words * thread);
        float* base = (float*)((start + 63) & ~63ull);
        const int slots = (words - 16 - SLAB_HEADER) / (2 + 32 * SUBTREE_RECORDS);
        return Memory{(Content*)base,
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

        // The records of two siblings; null if their subtree takes the place of another one while items wait.
        __attribute__((always_inline)) const Record* find(const void* near, unsigned int half, int slots,
                                                          bool wait) const {
            const unsigned int node = half & 0x7fffffff;
            const int below = level_of(node) - floor;
            const unsigned int root = node >> below;
            const unsigned int slot = root & (slots - 1);
            Record* subtree = records + (wp::int64)SUBTREE_RECORDS * slot;
            if (__builtin_expect(roots[slot] != (int)root, 0)) {
                if (roots[slot] != 0 && wait)
                    return nullptr;
                roots[slot] = (int)root;
                fill(*this, near, root, subtree);
            }
            return subtree + (((1 << below) | (node & ((1 << below) - 1))) & ~1);
        }
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
};
