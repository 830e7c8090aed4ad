// Two faces whose corners move straight, taken apart into what may meet first: corners and faces, edges and edges.
#pragma once
#include "builtin.h"
#include "exact/moving_features.h"

struct MovingFaces {
    const double (*starts)[6];  // corners of A's face and of B's: coordinates, and what is left of them
    const double (*ends)[6];
    const double* away;  // null, or from where B's face comes to its start instead
    bool same[6];        // a corner as the next of its face
    double place_error;  // that coordinates err by at any time
    int pair;            // of what is chosen
    MovingFeatures features;

    CUDA_CALLABLE MovingFaces(const double (*starts)[6], const double (*ends)[6], double error)
        : starts(starts), ends(ends), away(nullptr) {
        double size = 0.0;
        for (int k = 0; k < 6; ++k) {
            const int next = k % 3 == 2 ? k - 2 : k + 1;
            same[k] = true;
            for (int i = 0; i < 6; ++i) {
                size = DoubleWord::larger(size, DoubleWord::larger(fabs(starts[k][i]), fabs(ends[k][i])));
                same[k] = same[k] && starts[k][i] == starts[next][i] && ends[k][i] == ends[next][i];
            }
        }
        place_error = 3.0 * error + 0x1p-101 * size;  // 2^5 u^2
    }
    CUDA_CALLABLE Point place(int corner, const DoubleWord& t) const {
        Point at;
        for (int i = 0; i < 3; ++i) {
            const DoubleWord start = {starts[corner][i], starts[corner][3 + i]};
            const DoubleWord end = {ends[corner][i], ends[corner][3 + i]}, one = {1.0, 0.0};
            if (away == nullptr)
                at.x[i] = start + (end - start) * t;
            else
                at.x[i] = corner < 3 ? start : start + DoubleWord{away[i], 0.0} * (one - t);
        }
        return at;
    }
    // Choose corner i of either face and the other face, or edges i and j; return whether others do not stand for them.
    CUDA_CALLABLE bool choose(int chosen) {
        pair = chosen;
        features.edges = pair >= 6;
        if (features.edges) {
            // Of a face that is one corner, its first edge stands for it.
            const int i = (pair - 6) / 3, j = 3 + (pair - 6) % 3;
            return !(same[i] && i != 0) && !(same[j] && j != 3);
        }
        // What meets a face without area meets an edge of it.
        const int face = pair < 3 ? 3 : 0;
        return !same[face] && !same[face + 1] && !same[face + 2];
    }
    CUDA_CALLABLE int corner_of(int k) const {
        if (!features.edges)
            return k == 0 ? pair : (pair < 3 ? 2 : -1) + k;
        const int i = (pair - 6) / 3, j = (pair - 6) % 3;
        return k == 0 ? i : k == 1 ? (i + 1) % 3 : k == 2 ? 3 + j : 3 + (j + 1) % 3;
    }
    // Return whether what is chosen stays apart, by so much more than coordinates err.
    CUDA_CALLABLE bool stay_apart(const DoubleWord& from, const DoubleWord& to, double more) {
        const Point a = place(corner_of(0), from), b = place(corner_of(0), to);
#pragma unroll 1
        for (int k = 0; k < 3; ++k) {
            features.first[k] = place(corner_of(k + 1), from) - a;
            features.last[k] = place(corner_of(k + 1), to) - b;
        }
        features.measure(place_error * more);
        return features.stay_apart();
    }
    // Return until when all stay apart, no later than a limit; where that is sooner, why: 1 for contact, or what is as
    // near as it, 2 for tries.
    CUDA_CALLABLE double apart_until(double start, double limit, int& reason) {
        const double shortest = 0x1p-90;
        const int tries_max = 512;
        double until = limit;
        reason = 0;
#pragma unroll 1
        for (int chosen = 0; chosen < 15; ++chosen) {
            if (!choose(chosen))
                continue;
            DoubleWord t = {start, 0.0};
            double step = 1.0 - start;
            // Steps do not depend on the limit, so neither does where they end.
            for (int tries = 0; t.is_below(until) && step >= shortest && tries < tries_max; ++tries) {
                DoubleWord next = t + DoubleWord{step, 0.0};
                if (next.high >= 1.0)
                    next = {1.0, 0.0};
                if (stay_apart(t, next, 1.0)) {
                    t = next;
                    const double rest = (1.0 - t.high) - t.low;
                    step = 4.0 * step < rest ? 4.0 * step : rest;
                } else {
                    step *= 0.125;
                }
            }
            if (t.is_below(until)) {
                until = t.low < 0.0 ? t.high * (1.0 - 0x1p-52) : t.high;
                reason = step < shortest || !stay_apart(t, t, 1024.0) ? 1 : 2;
            }
        }
        return until;
    }
};
