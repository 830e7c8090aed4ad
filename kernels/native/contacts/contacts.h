// Contacts of the CPU: those of 8 face pairs at a time, as `find_contact_kernel` one by one.
#pragma once
#include "builtin.h"
#include "contacts/near64.h"

// Finds contacts of up to 8 face pairs at a time.
template <class PairPose, class Contacts>
struct ContactFinder {
    typedef Contact64 C;
    typedef Float64 F;
    typedef F::bits bits;
    typedef F::lanes lanes;
    typedef F::Point Point;
    const PairPose& pose;
    const Contacts& contacts;
    const wp::mat33d& rotation;
    const wp::vec3d& position;
    const ContactFaces<PairPose> faces;
    bool proven, with_gap, back;
    wp::vec3d* target[5];

    void store(const int* hit, int count, const Point (&found)[5]) const {
        if (count == 8 && hit[7] - hit[0] == 7) {
            for (int i = 0; i < 5; ++i)
                C::store((double*)(target[i] + hit[0]), found[i]);
        } else {
            for (int i = 0; i < 5; ++i) {
                double numbers[24];
                C::store(numbers, found[i]);
                for (int k = 0; k < count; ++k)
                    for (int c = 0; c < 3; ++c)
                        target[i][hit[k]][c] = numbers[3 * k + c];
            }
        }
        for (int k = 0; k < count; ++k)
            contacts.coplanar.data[hit[k]] = 0;
    }
    // Those of faces that are apart; what it is not sure of keeps its mark.
    void find_near(const int* hit, int count) const {
        Point a[3], b[3], of_b[3];
        faces.load(hit, count, a, b);
        for (int i = 0; i < 3; ++i)
            of_b[i] = F::minus(b[i], a[0]);
        const Gap64::Scaled t = Near64::scale(a, of_b);
        Near64 near;
        near.search(t);
        bits open = near.square <= CLOSEST;
        const Point own_a = C::filter_normal(false, a[0], a[1], a[2], open);
        const Point own_b = C::filter_normal(false, b[0], b[1], b[2], open);
        const Point end_a = C::pose(rotation.data, position, Near64::sum(near.of_a, a));
        const Point end_b = C::pose(rotation.data, position, Near64::sum(near.of_b, b));
        const Point normal_a = C::unit_vector(C::turn(rotation.data, own_a));
        const Point normal_b = C::unit_vector(C::turn(rotation.data, own_b));
        const Point normal = C::unit_vector(C::turn(rotation.data, near.find_way(t)));
        store(hit, count,
              {back ? end_b : end_a, back ? end_a : end_b, back ? normal_b : normal_a, back ? normal_a : normal_b,
               back ? C::negate(normal) : normal});
        const lanes separation = open ? lanes{} : C::root(near.square) * t.size;
        for (int k = 0; k < count; ++k)
            contacts.separation.data[hit[k]] = separation[k] > LEAST_SEPARATION ? separation[k] : LEAST_SEPARATION;
    }
    // So many face pairs, perhaps with double words; returns those that it is not sure of, a bit each.
    unsigned int find(bool extends, bool again, const int* hit, int count) const {
        Point a[3], b[3], d[3][3];
        faces.load(hit, count, a, b);
        // From each corner of A to each of B: the other way round, every rounding is the same.
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                d[i][j] = F::minus(b[j], a[i]);
        if (with_gap && !again) {
            const Gap64::Scaled t = Near64::scale(a, d[0]);
            const lanes depth = Gap64(t).depth() * t.size;
            for (int k = 0; k < count; ++k)
                contacts.separation.data[hit[k]] = -(depth[k] < LEAST_SEPARATION ? LEAST_SEPARATION : depth[k]);
        }
        bits open = {};
        const Point own_a = C::filter_normal(extends, a[0], a[1], a[2], open);
        const Point own_b = C::filter_normal(extends, b[0], b[1], b[2], open);
        lanes u[3], v[3];
        for (int i = 0; i < 3; ++i) {
            u[i] = C::filter_volume(extends, b, a[i], d[i][0], d[i][1], d[i][2], open);
            v[i] = C::filter_volume(extends, a, b[i], C::negate(d[0][i]), C::negate(d[1][i]), C::negate(d[2][i]), open);
        }
        Point p0, p1;
        const bits back_to_front = C::find_ends(proven, a, b, u, v, p0, p1, open);
        p0 = C::pose(rotation.data, position, p0);
        p1 = C::pose(rotation.data, position, p1);
        const Point normal_a = C::unit_vector(C::turn(rotation.data, own_a));
        const Point normal_b = C::unit_vector(C::turn(rotation.data, own_b));
        const Point normal = C::blend_normals(normal_a, normal_b);
        // Segments run the other way for one of two orders of the lone corners' sides, and of the objects.
        const bits turned = back_to_front ^ (bits{} - (wp::int64)back);
        store(hit, count,
              {F::choose(turned, p1, p0), F::choose(turned, p0, p1), back ? normal_b : normal_a,
               back ? normal_a : normal_b, back ? C::negate(normal) : normal});
        return F::to_mask(open) & ((1u << count) - 1);
    }
};

template <class ModelPool, class StatePool, class PairPose, class Contacts>
wp::int32 simd_contacts(const ModelPool& models, const StatePool& states, const PairPose& pose, wp::mat33d rotation,
                        wp::vec3d position, bool proven, wp::vec3i span, wp::array_t<wp::int32> place,
                        const Contacts& contacts) {
#pragma clang fp contract(off)
    const bool with_gap = contacts.separation.shape[0] != 0;
    const ContactFinder<PairPose, Contacts> finder = {
        pose,
        contacts,
        rotation,
        position,
        {pose, contacts.face.data, (const double*)models.vertex_pos.data, states.face_corner.data},
        proven,
        with_gap,
        pose.swapped != 0,
        {contacts.p0.data, contacts.p1.data, contacts.normal_a.data, contacts.normal_b.data, contacts.normal.data}};
    // First without double words, then with them those that need them, side by side: on the list, which they leave.
    // With them at once where most do, as of what touches, which one of eight vectors tells.
    int* list = place.data + span[2];
    int from = span[0], count = 0, apart = 0, left = 0, vectors = 0, hit[8], near[8];
    bool extends = false;
    for (; from < span[1]; ++from) {
        if (!with_gap || contacts.separation.data[from] < 0.0)
            hit[count++] = from;
        else
            near[apart++] = from;
        if (apart == 8 || (apart > 0 && from + 1 == span[1])) {
            finder.find_near(near, apart);
            apart = 0;
        }
        if (count == 8 || (count > 0 && from + 1 == span[1])) {
            const bool tells = vectors++ % 8 == 0;
            unsigned int open = finder.find(extends && !tells, false, hit, count);
            if (tells)
                extends = 2 * __builtin_popcount(open) > count;
            for (; open != 0; open &= open - 1)
                list[left++] = hit[__builtin_ctz(open)];
            count = 0;
        }
    }
    wp::int32 result = span[2];
    for (int i = 0; i < left; i += 8) {
        count = left - i < 8 ? left - i : 8;
        for (int k = 0; k < count; ++k)
            hit[k] = list[i + k];
        for (unsigned int open = finder.find(true, true, hit, count); open != 0; open &= open - 1)
            place.data[result++] = hit[__builtin_ctz(open)];
    }
    return result;
}
