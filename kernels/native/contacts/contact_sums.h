// Sums over the contacts of an object pair on the CPU: 8 contacts at a time, each sum in the order of
// `contacts.summary`.
#pragma once
#include "builtin.h"
#include "contacts/contact64.h"

// Add up numbers of contacts, one after the other, chunk by chunk. `find` makes those of so many contacts from one on.
template <int COUNT, class Find>
void add_by_chunks(wp::vec_t<2, wp::int32> ends, double (&all)[COUNT], const Find& find) {
#pragma clang fp contract(off)
    double sum[COUNT] = {};
    Contact64::lanes x[COUNT];
    for (int i = ends[0]; i < ends[1]; i += 8) {
        const int count = ends[1] - i < 8 ? ends[1] - i : 8;
        find(i, count, x);
        for (int k = 0; k < count; ++k)
            for (int c = 0; c < COUNT; ++c)
                sum[c] += x[c][k];
        if ((i + count - ends[0]) % CHUNK == 0 || i + count == ends[1])
            for (int c = 0; c < COUNT; ++c) {
                all[c] += sum[c];
                sum[c] = 0.0;
            }
    }
}

template <class Contacts>
void simd_sum_lengths(const Contacts& contacts, wp::vec_t<2, wp::int32> ends, wp::float64& total, wp::float64& number) {
    typedef Contact64 C;
    double all[2] = {};
    add_by_chunks(ends, all, [&](int i, int count, C::lanes(&x)[2]) {
#pragma clang fp contract(off)
        C::load_crossed(contacts.separation.data, contacts.separation.shape[0] != 0, i, count, x[1]);
        x[0] = x[1] * C::measure_length(Float64::minus(C::load((const double*)(contacts.p1.data + i), count),
                                                       C::load((const double*)(contacts.p0.data + i), count)));
    });
    total = all[0];
    number = all[1];
}

template <class Contacts>
void simd_sum_means(const Contacts& contacts, wp::vec_t<2, wp::int32> ends, wp::float64 total, wp::float64 number,
                    wp::vec_t<3, wp::float64>& middle, wp::vec_t<3, wp::float64>& normal) {
    typedef Contact64 C;
    typedef C::Point Point;
    const wp::vec_t<3, wp::float64> first = contacts.p0.data[ends[0]];
    const Point origin = {C::lanes{} + first[0], C::lanes{} + first[1], C::lanes{} + first[2]};
    double all[6] = {};
    add_by_chunks(ends, all, [&](int i, int count, C::lanes(&x)[6]) {
#pragma clang fp contract(off)
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
        x[0] = weight * (0.5 * a.x + 0.5 * b.x);
        x[1] = weight * (0.5 * a.y + 0.5 * b.y);
        x[2] = weight * (0.5 * a.z + 0.5 * b.z);
        x[3] = weight * n.x;
        x[4] = weight * n.y;
        x[5] = weight * n.z;
    });
    middle = wp::vec_t<3, wp::float64>(all[0], all[1], all[2]);
    normal = wp::vec_t<3, wp::float64>(all[3], all[4], all[5]);
}
