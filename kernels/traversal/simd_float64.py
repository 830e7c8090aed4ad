"""The float64 stage on the CPU in vector instructions: what float32 leaves open, 8 pairs of faces at a time.

`filter_waiting` finds the signs of `filter_triangles` by the same operations in the same order, so that
every device counts the same.
"""

import warp as wp

from warp_abtree.kernels.arithmetic.predicates import BOUND_3D
from warp_abtree.kernels.arrays import ModelPool, StatePool
from warp_abtree.kernels.poses import COORDINATE_MIN, PairPose

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Of pairs that the first six signs leave, so many wait for two more, among them room for 16 that are not in use.
KEPT_ROOM = 256

three_numbers = wp.types.vector(length=3, dtype=wp.int64)


@wp.func_native(f"""
    wp::vec_t<3, wp::int64> result;
#if defined(__CUDA_ARCH__)
    __trap();  // a thread tests a pair
#else
    {{
    #pragma clang fp contract(off)
    // A number of each of 8 pairs of faces.
    typedef double lanes __attribute__((vector_size(64)));
    typedef wp::int64 bits __attribute__((vector_size(64)));
    typedef wp::int64 loose_longs __attribute__((vector_size(64), aligned(8)));
    typedef int ints __attribute__((vector_size(32)));
    typedef int loose_ints __attribute__((vector_size(32), aligned(4)));
    typedef bool flags __attribute__((ext_vector_type(8)));
    typedef double four __attribute__((vector_size(32), aligned(8)));
    typedef int four_ints __attribute__((vector_size(16)));
    typedef unsigned int counts __attribute__((vector_size(32)));
    struct Point {{ lanes x, y, z; }};
    struct Sign {{ lanes value, size; }};
    // Of 8 signs those that are 1, -1 and UNSURE, a bit each.
    struct Sides {{ unsigned int above, below, open; }};
    const auto& r = pose.rotation.data;
    const auto& t = pose.translation;
    const double* position = (const double*)models.vertex_pos.data;
    wp::int64* rest = left_open.data;
    const double* corners = (const double*)states.face_corner.data;
    wp::int64* hits = faces.data;
    auto absolute = [](const lanes& v) {{ return __builtin_elementwise_abs(v); }};
    auto fuse = [](const lanes& a, const lanes& b, const lanes& c) {{ return __builtin_elementwise_fma(a, b, c); }};
    auto minus = [](const Point& a, const Point& b) {{ return Point{{a.x - b.x, a.y - b.y, a.z - b.z}}; }};
    auto sizes = [&](const Point& a) {{ return Point{{absolute(a.x), absolute(a.y), absolute(a.z)}}; }};
    auto choose = [](const bits& which, const Point& a, const Point& b) {{
        return Point{{which ? a.x : b.x, which ? a.y : b.y, which ? a.z : b.z}};
    }};
    auto to_mask = [](const bits& which) {{
        return (unsigned int)__builtin_bit_cast(unsigned char, __builtin_convertvector(which, flags));
    }};
    auto widen = [](unsigned int mask) {{
        return -__builtin_convertvector(__builtin_bit_cast(flags, (unsigned char)mask), ints);
    }};
    // Points, each where so many numbers end.
    auto gather = [&](const int* start) {{
        auto at = [&](int k) {{ return *(const four*)(position + (unsigned int)start[k]); }};
        lanes row[4];
        for (int k = 0; k < 4; ++k) {{
            const int i = k < 2 ? k : k + 2;
            row[k] = __builtin_shufflevector(at(i), at(i + 2), 0, 1, 2, 3, 4, 5, 6, 7);
        }}
        const lanes low_01 = __builtin_shufflevector(row[0], row[1], 0, 8, 2, 10, 4, 12, 6, 14);
        const lanes low_23 = __builtin_shufflevector(row[2], row[3], 0, 8, 2, 10, 4, 12, 6, 14);
        const lanes high_01 = __builtin_shufflevector(row[0], row[1], 1, 9, 3, 11, 5, 13, 7, 15);
        const lanes high_23 = __builtin_shufflevector(row[2], row[3], 1, 9, 3, 11, 5, 13, 7, 15);
        return Point{{__builtin_shufflevector(low_01, low_23, 0, 1, 4, 5, 8, 9, 12, 13),
                      __builtin_shufflevector(high_01, high_23, 0, 1, 4, 5, 8, 9, 12, 13),
                      __builtin_shufflevector(low_01, low_23, 2, 3, 6, 7, 10, 11, 14, 15)}};
    }};
    // As `pose_point`.
    auto gather_posed = [&](const int* start) {{
        const Point p = gather(start);
        lanes x[3];
        for (int i = 0; i < 3; ++i) {{
            const lanes y = ((r[i][0] * p.x + r[i][1] * p.y) + r[i][2] * p.z) + t[i];
            x[i] = absolute(y) < {COORDINATE_MIN.value.hex()} ? lanes{{}} : y;
        }}
        return Point{{x[0], x[1], x[2]}};
    }};
    // As `filter_rows`, of differences and their magnitudes.
    auto determinant = [&](const Point& u, const Point& v, const Point& w,
                           const Point& u_size, const Point& v_size, const Point& w_size) {{
        const lanes p = v.z * w.y, q = w.z * u.y, s = u.z * v.y;
        const lanes x = fuse(v.y, w.z, -p), x_size = fuse(v_size.y, w_size.z, absolute(p));
        const lanes y = fuse(w.y, u.z, -q), y_size = fuse(w_size.y, u_size.z, absolute(q));
        const lanes z = fuse(u.y, v.z, -s), z_size = fuse(u_size.y, v_size.z, absolute(s));
        return Sign{{fuse(w.x, z, fuse(v.x, y, u.x * x)),
                     fuse(w_size.x, z_size, fuse(v_size.x, y_size, u_size.x * x_size))}};
    }};
    auto sized_determinant = [&](const Point& u, const Point& v, const Point& w) {{
        return determinant(u, v, w, sizes(u), sizes(v), sizes(w));
    }};
    auto sum_sizes = [&](const Point& v) {{ return (absolute(v.x) + absolute(v.y)) + absolute(v.z); }};
    // As `filter_edges`, of the differences of ends.
    auto orient_edges = [&](const Point& ac, const Point& ad, const Point& bc, const Point& bd, const Point& cd) {{
        const bits across = sum_sizes(ad) * sum_sizes(bc) < sum_sizes(ac) * sum_sizes(bd);
        return sized_determinant(choose(across, ad, ac), choose(across, bc, bd), cd);
    }};
    auto filtered = [&](const lanes& value, const lanes& bound) {{
        const unsigned int above = to_mask(value > bound), below = to_mask(value < -bound);
        const unsigned int open = 255 & ~(above | below);
        return Sides{{above, below, open & ~to_mask(bound == 0.0)}};
    }};
    typedef int ids[{KEPT_ROOM}];
    int open = 0, kept = 0;
    // Put what a mask names on a list, of which eight places are written over. No branch depends on a single pair of
    // faces: it could not be predicted, and what follows it would wait for the longest chain of operations.
    auto append = [](wp::int64* list, const bits& item, unsigned int which) {{
#if defined(__AVX512VL__)
        *(loose_longs*)list = __builtin_ia32_compressdi512_mask(item, bits{{}}, which);
#else
        for (int n = 0; which != 0; which &= which - 1)
            list[n++] = item[__builtin_ctz(which)];
#endif
    }};
    auto append_ints = [](int* list, const ints& item, unsigned int which) {{
#if defined(__AVX512VL__)
        *(loose_ints*)list = __builtin_ia32_compresssi256_mask(item, ints{{}}, which);
#else
        for (int n = 0; which != 0; which &= which - 1)
            list[n++] = item[__builtin_ctz(which)];
#endif
    }};
    auto look_up = [](const int* list) {{ return (ints)*(const loose_ints*)list; }};
    // Pairs of which each lies on both sides of the other, their corners in the order of `turn_triangles`: those that
    // two more signs decide.
    ids turned[6];
    wp::int64 crossing[{KEPT_ROOM}];
    auto order_ends = [&](int first, int count) {{
        const Point p1 = gather(turned[0] + first), q1 = gather(turned[1] + first), r1 = gather(turned[2] + first);
        const Point p2 = gather_posed(turned[3] + first);
        const Point q2 = gather_posed(turned[4] + first), r2 = gather_posed(turned[5] + first);
        const bits item = *(const loose_longs*)(crossing + first);
        const Point p1p2 = minus(p1, p2);
        const Sign start = orient_edges(p1p2, minus(p1, q2), minus(q1, p2), minus(q1, q2), minus(p2, q2));
        const Sign end = orient_edges(minus(p1, r2), p1p2, minus(r1, r2), minus(r1, p2), minus(r2, p2));
        const Sides s = filtered(start.value, {BOUND_3D.value.hex()} * start.size);
        const Sides e = filtered(end.value, {BOUND_3D.value.hex()} * end.size);
        const unsigned int left = ((1u << count) - 1) & ~(s.above | e.above);
        unsigned int hard = left & (s.open | e.open);
        append(hits + met, item, left & ~hard);
        met += __builtin_popcount(left & ~hard);
        for (; __builtin_expect(hard != 0, 0); hard &= hard - 1)
            rest[open++] = crossing[first + __builtin_ctz(hard)];  // `append` could write over what is not read yet
    }};
    // Behind the end of the list stand corners that there are.
    auto order_kept = [&]() {{
        for (int i = 0; i < 6; ++i)
            *(loose_ints*)(turned[i] + kept) = ints{{}};
        for (int i = 0; i < kept; i += 8)
            order_ends(i, kept - i < 8 ? kept - i : 8);
        kept = 0;
    }};
    // As `find_alone`, of 8 triangles: those whose first corner is alone, whose second is, and whose lone corner lies
    // on the negative side.
    struct Alone {{ unsigned int first, second, back; }};
    auto find_alone = [](const Sides (&s)[3]) {{
        const unsigned int pair_above = s[0].above & s[1].above, pair_below = s[0].below & s[1].below;
        const unsigned int odd_above = s[0].above ^ s[1].above, odd_below = s[0].below ^ s[1].below;
        const unsigned int positive = (odd_above ^ s[2].above) & ~(pair_above & s[2].above);
        const unsigned int negative = (odd_below ^ s[2].below) & ~(pair_below & s[2].below) & ~positive;
        const unsigned int zero = ~(positive | negative);
        auto is_kind = [&](const Sides& side) {{
            return (positive & side.above) | (negative & side.below) | (zero & ~(side.above | side.below));
        }};
        const unsigned int two_above = pair_above | (odd_above & s[2].above);
        return Alone{{is_kind(s[0]), is_kind(s[1]), negative | (zero & two_above)}};
    }};
    // The same where none of the corners touches.
    auto find_lone = [](const Sides (&s)[3]) {{
        const unsigned int odd = s[0].above ^ s[1].above, other = s[1].above ^ s[2].above;
        return Alone{{odd & ~other, odd & other, (s[0].above & s[1].above) | (odd & s[2].above)}};
    }};
    auto has_sides = [](const Sides (&s)[3]) {{
        return (s[0].above | s[0].below) & (s[1].above | s[1].below) & (s[2].above | s[2].below);
    }};
    auto turn = [&](const Alone& alone, unsigned int back, const ids* start, int at, ints* turned_c) {{
        const ints c[3] = {{look_up(start[0] + at), look_up(start[1] + at), look_up(start[2] + at)}};
        const ints first = widen(alone.first), second = widen(alone.second), turns_back = widen(back);
        turned_c[0] = first ? c[0] : second ? c[1] : c[2];
        const ints q = first ? c[1] : second ? c[2] : c[0], r = first ? c[2] : second ? c[0] : c[1];
        turned_c[1] = turns_back ? r : q;
        turned_c[2] = turns_back ? q : r;
    }};
    auto one_sided = [](const Sides (&s)[3]) {{
        return (s[0].above & s[1].above & s[2].above) | (s[0].below & s[1].below & s[2].below);
    }};
    auto has_all_zero = [](const Sides (&s)[3]) {{
        unsigned int any = 0;
        for (int i = 0; i < 3; ++i)
            any |= s[i].above | s[i].below | s[i].open;
        return ~any;
    }};
    // Where the corners' numbers start, of A and of B, of the pairs of faces from one on.
    ids start[6];
    auto find_corners = [&](int first, int count) {{
        const bits some = bits{{}} + rest[first];
        for (int i = 0; i < count; i += 8) {{
            const bits lane = {{0, 1, 2, 3, 4, 5, 6, 7}};
            const bits item = lane < count - i ? (bits)*(const loose_longs*)(rest + first + i) : some;
            const counts face[2] = {{2 * (counts)(pose.corner_a + __builtin_convertvector(item >> 32, ints)),
                                     2 * (counts)(pose.corner_b + __builtin_convertvector(item, ints))}};
            for (int k = 0; k < 2; ++k) {{
                auto at = [&](int j) {{ return *(const four_ints*)(corners + face[k][j]); }};
                ints row[4];
                for (int j = 0; j < 4; ++j)
                    row[j] = __builtin_shufflevector(at(j), at(j + 4), 0, 1, 2, 3, 4, 5, 6, 7);
                const ints low_01 = __builtin_shufflevector(row[0], row[1], 0, 8, 1, 9, 4, 12, 5, 13);
                const ints low_23 = __builtin_shufflevector(row[2], row[3], 0, 8, 1, 9, 4, 12, 5, 13);
                const ints high_01 = __builtin_shufflevector(row[0], row[1], 2, 10, 3, 11, 6, 14, 7, 15);
                const ints high_23 = __builtin_shufflevector(row[2], row[3], 2, 10, 3, 11, 6, 14, 7, 15);
                const ints x = __builtin_shufflevector(low_01, low_23, 0, 1, 8, 9, 4, 5, 12, 13);
                const ints y = __builtin_shufflevector(low_01, low_23, 2, 3, 10, 11, 6, 7, 14, 15);
                const ints z = __builtin_shufflevector(high_01, high_23, 0, 1, 8, 9, 4, 5, 12, 13);
                *(loose_ints*)(start[3 * k] + i) = 4 * x;
                *(loose_ints*)(start[3 * k + 1] + i) = 4 * y;
                *(loose_ints*)(start[3 * k + 2] + i) = 4 * z;
            }}
        }}
    }};
    const int before = met, at_once = first_ends ? 8 : {KEPT_ROOM};
    int done = 0;
    while (done < waiting && (met == before || !first_ends)) {{
        const int count = waiting - done < 8 ? waiting - done : 8;
        const int at = done % at_once;
        if (at == 0)
            find_corners(done, waiting - done < at_once ? waiting - done : at_once);
        const bits item = *(const loose_longs*)(rest + done);
        done += count;
        // From each corner of A to each of B: the other way round, every rounding is the same.
        Point d[3][3], d_size[3][3];
        {{
            const Point a[3] = {{gather(start[0] + at), gather(start[1] + at), gather(start[2] + at)}};
            const Point b[3] = {{gather_posed(start[3] + at), gather_posed(start[4] + at),
                                 gather_posed(start[5] + at)}};
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) {{
                    d[i][j] = minus(b[j], a[i]);
                    d_size[i][j] = sizes(d[i][j]);
                }}
        }}
        Sides side_a[3], side_b[3];
        lanes bound[6];
        #pragma clang loop unroll(full)
        for (int i = 0; i < 3; ++i) {{
            const Sign of_a = determinant(d[i][0], d[i][1], d[i][2], d_size[i][0], d_size[i][1], d_size[i][2]);
            const Sign of_b = determinant(d[0][i], d[1][i], d[2][i], d_size[0][i], d_size[1][i], d_size[2][i]);
            bound[i] = {BOUND_3D.value.hex()} * of_a.size;
            bound[i + 3] = {BOUND_3D.value.hex()} * of_b.size;
            side_a[i] = Sides{{to_mask(of_a.value > bound[i]), to_mask(of_a.value < -bound[i]), 0}};
            side_b[i] = Sides{{to_mask(of_b.value < -bound[i + 3]), to_mask(of_b.value > bound[i + 3]), 0}};
        }}
        unsigned int left = ((1u << count) - 1) & ~(one_sided(side_a) | one_sided(side_b));
        Alone alone_a = find_lone(side_a), alone_b = find_lone(side_b);
        // Else no sign that counts is open or 0.
        if (__builtin_expect((left & ~(has_sides(side_a) & has_sides(side_b))) != 0, 0)) {{
            for (int i = 0; i < 3; ++i) {{
                side_a[i].open = ~(side_a[i].above | side_a[i].below | to_mask(bound[i] == 0.0));
                side_b[i].open = ~(side_b[i].above | side_b[i].below | to_mask(bound[i + 3] == 0.0));
            }}
            unsigned int unsure = has_all_zero(side_a) | has_all_zero(side_b);
            for (int i = 0; i < 3; ++i)
                unsure |= side_a[i].open | side_b[i].open;
            unsure &= left;
            left &= ~unsure;
            unsigned int joined = 0;
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j)
                    joined |= to_mask((d_size[i][j].x + d_size[i][j].y) + d_size[i][j].z == 0.0);
            joined &= unsure;
            unsure &= ~joined;
            append(hits + met, item, joined);
            met += __builtin_popcount(joined);
            append(rest + open, item, unsure);
            open += __builtin_popcount(unsure);
            alone_a = find_alone(side_a);
            alone_b = find_alone(side_b);
        }}
        ints order[6];
        turn(alone_a, alone_b.back, start, at, order);
        turn(alone_b, alone_a.back, start + 3, at, order + 3);
        for (int i = 0; i < 6; ++i)
            append_ints(turned[i] + kept, order[i], left);
        append(crossing + kept, item, left);
        kept += __builtin_popcount(left);
        const bool last = first_ends || done == waiting;
        if (last || kept > {KEPT_ROOM - 16})
            order_kept();
    }}
    result[0] = met;
    result[1] = open;
    result[2] = done;
    }}
#endif
    return result;
""")
def filter_waiting(
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    first_ends: bool,
    met: wp.int32,
    waiting: wp.int32,
    left_open: wp.array(dtype=wp.int64),
    faces: wp.array(dtype=wp.int64),
) -> three_numbers:
    """Test pairs of faces in float64, 8 at a time, perhaps until the first that meet, and add those to a list.

    Lists are not the same one, and have room for 8 more.

    Returns how many have met then, how many are left open, which stand in front of their list then, and how many were
    tested.
    """
    ...
