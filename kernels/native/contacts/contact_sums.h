// Sums over the contacts of an object pair on the CPU: 8 contacts at a time, each sum in the order of
// `contacts.summary`.
#pragma once
#include "builtin.h"
#include "contacts/contact64.h"

template <class Contacts>
void simd_sum_lengths(const Contacts& contacts, wp::vec_t<2, wp::int32> ends, wp::float64& total, wp::float64& number) {
#pragma clang fp contract(off)
    wp::float64 all[2] = {};
    typedef Contact64 C;
    C::lanes length, crossed;
    double sum[2] = {};
    for (int i = ends[0]; i < ends[1]; i += 8) {
        const int count = ends[1] - i < 8 ? ends[1] - i : 8;
        C::load_crossed(contacts.separation.data, contacts.separation.shape[0] != 0, i, count, crossed);
        length = crossed * C::measure_length(Float64::minus(C::load((const double*)(contacts.p1.data + i), count),
                                                            C::load((const double*)(contacts.p0.data + i), count)));
        for (int k = 0; k < count; ++k) {
            sum[0] += length[k];
            sum[1] += crossed[k];
        }
        if ((i + count - ends[0]) % CHUNK == 0 || i + count == ends[1])
            for (int c = 0; c < 2; ++c) {
                all[c] += sum[c];
                sum[c] = 0.0;
            }
    }
    total = all[0];
    number = all[1];
}

template <class Contacts>
void simd_sum_means(const Contacts& contacts, wp::vec_t<2, wp::int32> ends, wp::float64 total, wp::float64 number,
                    wp::vec_t<3, wp::float64>& middle, wp::vec_t<3, wp::float64>& normal) {
#pragma clang fp contract(off)
    wp::float64 all[6] = {};
    typedef Contact64 C;
    typedef C::Point Point;
    const wp::vec_t<3, wp::float64> first = contacts.p0.data[ends[0]];
    const Point origin = {C::lanes{} + first[0], C::lanes{} + first[1], C::lanes{} + first[2]};
    double sum[6] = {};
    for (int i = ends[0]; i < ends[1]; i += 8) {
        const int count = ends[1] - i < 8 ? ends[1] - i : 8;
        C::lanes crossed;
        C::load_crossed(contacts.separation.data, contacts.separation.shape[0] != 0, i, count, crossed);
        const Point p0 = C::load((const double*)(contacts.p0.data + i), count);
        const Point p1 = C::load((const double*)(contacts.p1.data + i), count);
        const Point n = C::load((const double*)(contacts.normal.data + i), count);
        C::lanes weight = C::lanes{} + 1.0 / number;
        if (total != 0.0)
            weight = C::measure_length(Float64::minus(p1, p0)) / total;
        weight = crossed == 0.0 ? C::lanes{} : weight;
        const Point a = Float64::minus(p0, origin), b = Float64::minus(p1, origin);
        const C::lanes x[6] = {weight * (0.5 * a.x + 0.5 * b.x),
                               weight * (0.5 * a.y + 0.5 * b.y),
                               weight * (0.5 * a.z + 0.5 * b.z),
                               weight * n.x,
                               weight * n.y,
                               weight * n.z};
        for (int k = 0; k < count; ++k)
            for (int c = 0; c < 6; ++c)
                sum[c] += x[c][k];
        if ((i + count - ends[0]) % CHUNK == 0 || i + count == ends[1])
            for (int c = 0; c < 6; ++c) {
                all[c] += sum[c];
                sum[c] = 0.0;
            }
    }
    middle = wp::vec_t<3, wp::float64>(all[0], all[1], all[2]);
    normal = wp::vec_t<3, wp::float64>(all[3], all[4], all[5]);
}
