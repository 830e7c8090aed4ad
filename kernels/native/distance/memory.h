// Memory of a CPU thread that searches for the nearest faces.
#pragma once
#include "builtin.h"
#include "base/sizes.h"

struct NearestMemory {
    struct Header {
        float upper;                          // that the nearest distance is not over, scaled
        int found;                            // whether there are faces at most that far: only then a tolerance counts
        int diving;                           // whether the nearest node pair goes first, until faces are measured
        int level;                            // how far bounds may be that do not wait for later
        int top, later, waiting, open_count;  // entries of the lists
        int node_tests, face_tests;
    };
    Header* header;
    float *bound, *later_bound, *open_bound;
    wp::int64 *item, *later, *open, *face;  // the stack, what waits, faces for float64, faces for float32

    static NearestMemory find(float* data, int thread) {
        char* p = (char*)data + 4ll * NEAREST_WORDS * thread;
        NearestMemory m;
        m.header = (Header*)p;
        p += 64;
        auto longs = [&](int count) { return (wp::int64*)((p += 8 * count) - 8 * count); };
        auto floats = [&](int count) { return (float*)((p += 4 * count) - 4 * count); };
        m.item = longs(CPU_STACK_LENGTH);
        m.later = longs(LATER_LENGTH);
        m.open = longs(OPEN_LENGTH);
        m.face = longs(NEAREST_FACES);
        m.bound = floats(CPU_STACK_LENGTH);
        m.later_bound = floats(LATER_LENGTH);
        m.open_bound = floats(OPEN_LENGTH);
        return m;
    }
    // Under which a pair of faces matters, as `cut_of`.
    static float cut_of(float upper, const wp::vec4& terms) {
        const float part = terms[1] * upper - terms[2], more = part > terms[0] ? part : terms[0];
        const float off = more - terms[3] * upper;
        return off > 0.0f ? upper - off : upper;
    }
    // Drop faces for float64 that are too far by now.
    void keep_open() const {
        int kept = 0;
        for (int i = 0; i < header->open_count; ++i)
            if (open_bound[i] <= header->upper) {
                open[kept] = open[i];
                open_bound[kept++] = open_bound[i];
            }
        header->open_count = kept;
    }
    // Of the entries of the stack from one on, the nearest comes last, so that it is taken first.
    void put_nearest_last(int first, int end) const {
        for (int k = first; k < end - 1; ++k)
            if (bound[k] < bound[end - 1]) {
                const wp::int64 other = item[k];
                const float other_bound = bound[k];
                item[k] = item[end - 1];
                bound[k] = bound[end - 1];
                item[end - 1] = other;
                bound[end - 1] = other_bound;
            }
    }
    // What waited for later, of which much is too far by now; on the stack as much as leaves it room.
    void take_later(float soon, float limit, int& top, int& count) const {
        int kept = 0;
        for (int i = 0; i < count; ++i) {
            const float here = later_bound[i];
            const wp::int64 pair = later[i];
            if (here <= soon && top < CPU_STACK_LENGTH / 2) {
                item[top] = pair;
                bound[top++] = here;
            } else if (here <= limit) {
                later[kept] = pair;
                later_bound[kept++] = here;
            }
        }
        count = kept;
    }
};
