// The faces about a merge as groups of 8, and their distances to the corners of polygons.
#pragma once
#include "builtin.h"
#include "build/faces64.h"

struct NearFaces {
    typedef FaceLanes::lanes lanes;
    alignas(64) double place[NEAR_ROOM / 8][9][8];
    FaceLanes group[NEAR_ROOM / 8];
    int face[NEAR_ROOM];
    int count, groups;
    // The forest before the merge or after, its positions, the two nodes of the merge and the one that it makes.
    const int* node_of;
    const double* pos;
    int first_node, second_node, merged_node;

    bool is_merged(int node) const { return node == first_node || node == second_node; }
    // Whether a face has three corners after the merge.
    bool is_live(int f) const {
        const int* node = node_of + 3 * f;
        return node[0] >= 0 && is_merged(node[0]) + is_merged(node[1]) + is_merged(node[2]) < 2;
    }
    int find(int f) const {
        int i = 0;
        while (i < count && face[i] != f)
            ++i;
        return i < count ? i : -1;
    }
    void add(int f) {
        for (int k = 0; k < 3; ++k) {
            const int node = node_of[3 * f + k];
            const double* from = pos + 3 * (wp::int64)(is_merged(node) ? merged_node : node);
            for (int x = 0; x < 3; ++x)
                place[count >> 3][3 * k + x][count & 7] = from[x];
        }
        face[count++] = f;
    }
    // Points of x, y and z from a row on, 8 each.
    static FaceLanes::Point points(const double (&rows)[9][8], int row) {
        auto at = [&](int i) { return *(const lanes*)rows[row + i]; };
        return FaceLanes::Point{at(0), at(1), at(2)};
    }
    void load_groups(int from) {
        groups = (count + 7) / 8;
        for (int g = from; g < groups; ++g)
            group[g].load(points(place[g], 0), points(place[g], 3), points(place[g], 6));
    }
    // Not inlined, as `cut_polygon`.
    __attribute__((noinline)) void measure(const Corner& p, double* row) const {
        const FaceLanes::Point q = {p.x - lanes{}, p.y - lanes{}, p.z - lanes{}};
        for (int g = 0; g < groups; ++g)
            *(lanes*)(row + 8 * g) = group[g].distance_sq(q);
    }
    // Distances of 8 faces; infinite where there is no face.
    lanes those_of(const lanes& found, int g) const {
        const lanes place_in = {0, 1, 2, 3, 4, 5, 6, 7};
        return place_in < double(count - 8 * g) ? found : lanes{} + __builtin_inf();
    }
    static int find_lane(const lanes& found, double value) { return __builtin_ctz(Float64::to_mask(found == value)); }
    // The least of all lanes.
    static double least_of(lanes v) {
        v = FaceLanes::lesser(__builtin_shufflevector(v, v, 4, 5, 6, 7, 0, 1, 2, 3), v);
        v = FaceLanes::lesser(__builtin_shufflevector(v, v, 2, 3, 0, 1, 6, 7, 4, 5), v);
        v = FaceLanes::lesser(__builtin_shufflevector(v, v, 1, 0, 3, 2, 5, 4, 7, 6), v);
        return v[0];
    }
    // As `point_nearest_face`.
    int nearest(const double* row, double& least) const {
        int best = -1;
        least = __builtin_inf();
        for (int g = 0; g < groups; ++g) {
            const lanes found = those_of(*(const lanes*)(row + 8 * g), g);
            const double here = least_of(found);
            if (here < least) {
                least = here;
                best = 8 * g + find_lane(found, here);
            }
        }
        return best;
    }
    // As `nearest_candidate`: the first face within the limit, else the one with the least bound.
    int cover(const Polygon& p, double limit, double& bound) const {
        int best = -1;
        bound = __builtin_inf();
        for (int g = 0; g < groups && bound > limit; ++g) {
            lanes worst = {};
            for (int k = 0; k < p.count; ++k)
                worst = FaceLanes::greater(worst, *(const lanes*)(p.corner[k].distance + 8 * g));
            worst = those_of(worst, g);
            const unsigned int within = Float64::to_mask(worst <= limit);
            const double here = within ? worst[__builtin_ctz(within)] : least_of(worst);
            if (here < bound) {
                bound = here;
                best = 8 * g + (within ? __builtin_ctz(within) : find_lane(worst, here));
            }
        }
        return best;
    }
    // The largest distance of any corner from its nearest face.
    double reach(const Polygon& p) const {
        double most = 0.0, here;
        for (int k = 0; k < p.count; ++k) {
            nearest(p.corner[k].distance, here);
            most = here > most ? here : most;
        }
        return most;
    }
};
