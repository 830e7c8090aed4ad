"""The float64 stage on the CPU in vector instructions: what float32 leaves open, 8 pairs of faces at a time.

`filter_waiting` finds the signs of `intersect_triangles` for FILTER by the same operations in the same order, so that
every device counts the same. Where nothing but the order of two edges is open, which is nearly always so on meshes
laid on one another, it goes on to double words, as `resolve_orient3d` does.
"""

import warp as wp

from warp_abtree.kernels.double_word import BOUND_DOUBLE
from warp_abtree.kernels.pools import ModelPool, StatePool
from warp_abtree.kernels.pose import COORDINATE_MIN, PairPose
from warp_abtree.kernels.predicates import BOUND_3D

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Of pairs that the first six signs leave, so many wait for two more, among them room for 16 that are not in use.
KEPT_ROOM = 256

four_numbers = wp.types.vector(length=4, dtype=wp.int64)


@wp.func_native(f"""
    wp::vec_t<4, wp::int64> result;
#if defined(__CUDA_ARCH__)
    __trap();  // a thread tests a pair
#else
    {{
    #pragma clang fp contract(off)
    // A number of each of 8 pairs of faces.
    typedef double lanes __attribute__((vector_size(64)));
    typedef wp::int64 bits __attribute__((vector_size(64)));
    typedef wp::int64 loose_longs __attribute__((vector_size(64), aligned(8)));
    typedef int row_of_four __attribute__((vector_size(16)));
    typedef int ints __attribute__((vector_size(32)));
    typedef int loose_ints __attribute__((vector_size(32), aligned(4)));
    typedef bool flags __attribute__((ext_vector_type(8)));
    typedef double two __attribute__((vector_size(16), aligned(8)));
    typedef double four __attribute__((vector_size(32)));
    struct Point {{ lanes x, y, z; }};
    struct Double {{ lanes high, low; }};
    struct Sign {{ lanes value, size; }};
    // Of 8 signs those that are 1, -1 and UNSURE, a bit each.
    struct Sides {{ unsigned int above, below, open; }};
    const auto& r = pose.rotation.data;
    const auto& t = pose.translation;
    const double* position = (const double*)models.vertex_pos.data;
    const row_of_four* corners = (const row_of_four*)states.face_corner.data;
    wp::int64* rest = left_open.data;
    wp::int64* hits = faces.data;
    auto absolute = [](const lanes& v) {{ return __builtin_elementwise_abs(v); }};
    auto fuse = [](const lanes& a, const lanes& b, const lanes& c) {{ return __builtin_elementwise_fma(a, b, c); }};
    auto minus = [](const Point& a, const Point& b) {{ return Point{{a.x - b.x, a.y - b.y, a.z - b.z}}; }};
    auto sizes = [&](const Point& a) {{ return Point{{absolute(a.x), absolute(a.y), absolute(a.z)}}; }};
    auto same = [](const Point& a, const Point& b) {{ return (a.x == b.x) & (a.y == b.y) & (a.z == b.z); }};
    auto choose = [](const bits& which, const Point& a, const Point& b) {{
        return Point{{which ? a.x : b.x, which ? a.y : b.y, which ? a.z : b.z}};
    }};
    auto to_mask = [](const bits& which) {{
        return (unsigned int)__builtin_bit_cast(unsigned char, __builtin_convertvector(which, flags));
    }};
    auto widen = [](unsigned int mask) {{
        return -__builtin_convertvector(__builtin_bit_cast(flags, (unsigned char)mask), ints);
    }};
    auto gather = [&](const int* vertex) {{
        const double* p[8];
        two xy[8];
        for (int k = 0; k < 8; ++k) {{
            p[k] = position + 3 * (wp::int64)vertex[k];
            xy[k] = *(const two*)p[k];
        }}
        lanes row[2];
        for (int k = 0; k < 2; ++k) {{
            const four low = __builtin_shufflevector(xy[k], xy[k + 2], 0, 1, 2, 3);
            const four high = __builtin_shufflevector(xy[k + 4], xy[k + 6], 0, 1, 2, 3);
            row[k] = __builtin_shufflevector(low, high, 0, 1, 2, 3, 4, 5, 6, 7);
        }}
        return Point{{__builtin_shufflevector(row[0], row[1], 0, 8, 2, 10, 4, 12, 6, 14),
                      __builtin_shufflevector(row[0], row[1], 1, 9, 3, 11, 5, 13, 7, 15),
                      lanes{{p[0][2], p[1][2], p[2][2], p[3][2], p[4][2], p[5][2], p[6][2], p[7][2]}}}};
    }};
    // As `pose_point`.
    auto gather_posed = [&](const int* vertex) {{
        const Point p = gather(vertex);
        lanes x[3];
        for (int i = 0; i < 3; ++i) {{
            const lanes y = ((r[i][0] * p.x + r[i][1] * p.y) + r[i][2] * p.z) + t[i];
            x[i] = absolute(y) < {COORDINATE_MIN.value.hex()} ? lanes{{}} : y;
        }}
        return Point{{x[0], x[1], x[2]}};
    }};
    // As `filter_orient3d`, of differences and their magnitudes.
    auto determinant = [&](const Point& u, const Point& v, const Point& w,
                           const Point& u_size, const Point& v_size, const Point& w_size) {{
        const lanes p = v.z * w.y, q = w.z * u.y, s = u.z * v.y;
        const lanes x = fuse(v.y, w.z, -p), x_size = fuse(v_size.y, w_size.z, absolute(p));
        const lanes y = fuse(w.y, u.z, -q), y_size = fuse(w_size.y, u_size.z, absolute(q));
        const lanes z = fuse(u.y, v.z, -s), z_size = fuse(u_size.y, v_size.z, absolute(s));
        return Sign{{fuse(w.x, z, fuse(v.x, y, u.x * x)),
                     fuse(w_size.x, z_size, fuse(v_size.x, y_size, u_size.x * x_size))}};
    }};
    auto orient = [&](const Point& a, const Point& b, const Point& c, const Point& d) {{
        const Point u = minus(a, d), v = minus(b, d), w = minus(c, d);
        return determinant(u, v, w, sizes(u), sizes(v), sizes(w));
    }};
    auto filtered = [&](const lanes& value, const lanes& bound) {{
        const unsigned int above = to_mask(value > bound), below = to_mask(value < -bound);
        const unsigned int open = 255 & ~(above | below);
        return Sides{{above, below, open == 0 ? 0 : open & ~to_mask(bound == 0.0)}};
    }};
    // Double words, as in their module.
    auto add_fast = [](const lanes& a, const lanes& b) {{
        const lanes x = a + b;
        return Double{{x, b - (x - a)}};
    }};
    auto two_sum = [](const lanes& a, const lanes& b) {{
        const lanes x = a + b, part = x - a;
        return Double{{x, (a - (x - part)) + (b - part)}};
    }};
    auto multiply = [&](const Double& a, const Double& b) {{
        const lanes high = a.high * b.high, low = fuse(a.high, b.high, -high);
        return add_fast(high, low + fuse(a.low, b.high, a.high * b.low));
    }};
    auto add = [&](const Double& a, const Double& b) {{
        const Double high = two_sum(a.high, b.high), low = two_sum(a.low, b.low);
        const Double part = add_fast(high.high, high.low + low.high);
        return add_fast(part.high, low.low + part.low);
    }};
    auto minor = [&](const Double& a, const Double& b, const Double& c, const Double& d) {{
        return add(multiply(a, b), multiply(Double{{-c.high, -c.low}}, d));
    }};
    auto double_orient = [&](const Point& a, const Point& b, const Point& c, const Point& d) {{
        const Double u0 = two_sum(a.x, -d.x), u1 = two_sum(a.y, -d.y), u2 = two_sum(a.z, -d.z);
        const Double v0 = two_sum(b.x, -d.x), v1 = two_sum(b.y, -d.y), v2 = two_sum(b.z, -d.z);
        const Double w0 = two_sum(c.x, -d.x), w1 = two_sum(c.y, -d.y), w2 = two_sum(c.z, -d.z);
        const Double x = multiply(u0, minor(v1, w2, v2, w1)), y = multiply(v0, minor(w1, u2, w2, u1));
        return add(add(x, y), multiply(w0, minor(u1, v2, u2, v1))).high;
    }};
    int open = 0;
    wp::int64 resolved = 0;
    // Pairs of which each lies on both sides of the other, their corners in the order of `turn_triangles`: those that
    // two more signs decide.
    int turned[6][{KEPT_ROOM}];
    wp::int64 crossing[{KEPT_ROOM}];
    auto order_ends = [&](int first, int count) {{
        const Point p1 = gather(turned[0] + first), q1 = gather(turned[1] + first), r1 = gather(turned[2] + first);
        const Point p2 = gather_posed(turned[3] + first);
        const Point q2 = gather_posed(turned[4] + first), r2 = gather_posed(turned[5] + first);
        const Sign start = orient(p1, q1, p2, q2), end = orient(p1, r1, r2, p2);
        Sides s = filtered(start.value, {BOUND_3D.value.hex()} * start.size);
        Sides e = filtered(end.value, {BOUND_3D.value.hex()} * end.size);
        if (s.open | e.open) {{
            // As `orient_edges`.
            s.open &= ~to_mask(same(p1, p2) | same(q1, p2));
            e.open &= ~to_mask(same(p1, r2) | same(r1, r2));
        }}
        const unsigned int all = (1u << count) - 1;
        const unsigned int hard = all & ~(s.above | e.above) & (s.open | e.open);
        if (hard) {{
            // One of both, as a rule the only one.
            const bits one = __builtin_convertvector(widen(s.open), bits);
            const lanes value = double_orient(p1, choose(one, q1, r1), choose(one, p2, r2), choose(one, q2, p2));
            const Sides sure = filtered(value, {BOUND_DOUBLE.value.hex()} * (one ? start.size : end.size));
            const unsigned int of_end = ~s.open;
            e.above |= hard & of_end & sure.above;
            e.open &= ~(hard & of_end & ~sure.open);
            s.above |= hard & ~of_end & sure.above;
            s.open &= of_end | ~hard | sure.open;
        }}
        const unsigned int apart = s.above | e.above;
        unsigned int left = all & ~apart & (s.open | e.open);
        unsigned int found = all & ~apart & ~left;
        resolved += __builtin_popcount(hard & ~left);
        for (; found != 0; found &= found - 1)
            hits[met++] = crossing[first + __builtin_ctz(found)];
        for (; left != 0; left &= left - 1)
            rest[open++] = crossing[first + __builtin_ctz(left)];
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
    auto turn = [&](const Alone& alone, unsigned int back, const ints* c, ints* turned_c) {{
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
    // The next group is looked up while one is worked on.
    struct Group {{ bits item; ints corner[6]; }};
    Group groups[2];
    auto transpose = [](const row_of_four (&c)[8], ints* corner) {{
        ints row[4];
        for (int k = 0; k < 4; ++k)
            row[k] = __builtin_shufflevector(c[k], c[k + 4], 0, 1, 2, 3, 4, 5, 6, 7);
        const ints low_01 = __builtin_shufflevector(row[0], row[1], 0, 8, 1, 9, 4, 12, 5, 13);
        const ints low_23 = __builtin_shufflevector(row[2], row[3], 0, 8, 1, 9, 4, 12, 5, 13);
        const ints high_01 = __builtin_shufflevector(row[0], row[1], 2, 10, 3, 11, 6, 14, 7, 15);
        const ints high_23 = __builtin_shufflevector(row[2], row[3], 2, 10, 3, 11, 6, 14, 7, 15);
        corner[0] = __builtin_shufflevector(low_01, low_23, 0, 1, 8, 9, 4, 5, 12, 13);
        corner[1] = __builtin_shufflevector(low_01, low_23, 2, 3, 10, 11, 6, 7, 14, 15);
        corner[2] = __builtin_shufflevector(high_01, high_23, 0, 1, 8, 9, 4, 5, 12, 13);
    }};
    auto load = [&](Group& group, int first) {{
        const wp::int64* items = rest + first;
        wp::int64 last[8];
        if (first + 8 > waiting) {{
            for (int k = 0; k < 8; ++k)
                last[k] = items[first + k < waiting ? k : 0];
            items = last;
        }}
        group.item = *(const loose_longs*)items;
        row_of_four a[8], b[8];
        for (int k = 0; k < 8; ++k) {{
            const wp::int64 item = items[k];
            a[k] = corners[pose.corner_a + (int)(item >> 32)];
            b[k] = corners[pose.corner_b + (int)item];
        }}
        transpose(a, group.corner);
        transpose(b, group.corner + 3);
    }};
    const int before = met;
    int done = 0, kept = 0, which = 0;
    if (waiting > 0)
        load(groups[0], 0);
    while (done < waiting && (met == before || !first_ends)) {{
        const int count = waiting - done < 8 ? waiting - done : 8;
        const Group& group = groups[which];
        done += count;
        which ^= 1;
        if (done < waiting)
            load(groups[which], done);
        // From each corner of A to each of B: the other way round, every rounding is the same.
        Point d[3][3], d_size[3][3];
        {{
            const int* corner = (const int*)group.corner;
            const Point a[3] = {{gather(corner), gather(corner + 8), gather(corner + 16)}};
            const Point b[3] = {{gather_posed(corner + 24), gather_posed(corner + 32), gather_posed(corner + 40)}};
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) {{
                    d[i][j] = minus(b[j], a[i]);
                    d_size[i][j] = sizes(d[i][j]);
                }}
        }}
        Sides side_a[3], side_b[3];
        #pragma clang loop unroll(full)
        for (int i = 0; i < 3; ++i) {{
            const Sign of_a = determinant(d[i][0], d[i][1], d[i][2], d_size[i][0], d_size[i][1], d_size[i][2]);
            const Sign of_b = determinant(d[0][i], d[1][i], d[2][i], d_size[0][i], d_size[1][i], d_size[2][i]);
            side_a[i] = filtered(of_a.value, {BOUND_3D.value.hex()} * of_a.size);
            side_b[i] = filtered(-of_b.value, {BOUND_3D.value.hex()} * of_b.size);
        }}
        unsigned int left = ((1u << count) - 1) & ~(one_sided(side_a) | one_sided(side_b));
        unsigned int unsure = has_all_zero(side_a) | has_all_zero(side_b);
        for (int i = 0; i < 3; ++i)
            unsure |= side_a[i].open | side_b[i].open;
        for (unsigned int m = left & unsure; m != 0; m &= m - 1)
            rest[open++] = group.item[__builtin_ctz(m)];
        left &= ~unsure;
        const Alone alone_a = find_alone(side_a), alone_b = find_alone(side_b);
        ints order[6];
        turn(alone_a, alone_b.back, group.corner, order);
        turn(alone_b, alone_a.back, group.corner + 3, order + 3);
#if defined(__AVX512VL__)
        for (int i = 0; i < 6; ++i)
            *(loose_ints*)(turned[i] + kept) = __builtin_ia32_compresssi256_mask(order[i], ints{{}}, left);
        *(loose_longs*)(crossing + kept) = __builtin_ia32_compressdi512_mask(group.item, bits{{}}, left);
        kept += __builtin_popcount(left);
#else
        for (; left != 0; left &= left - 1) {{
            const int k = __builtin_ctz(left);
            for (int i = 0; i < 6; ++i)
                turned[i][kept] = order[i][k];
            crossing[kept++] = group.item[k];
        }}
#endif
        if (first_ends || done == waiting || kept > {KEPT_ROOM - 16}) {{
            for (int i = 0; i < 6; ++i)
                *(loose_ints*)(turned[i] + kept) = ints{{}};
            for (int i = 0; i < kept; i += 8)
                order_ends(i, kept - i < 8 ? kept - i : 8);
            kept = 0;
        }}
    }}
    result[0] = met;
    result[1] = open;
    result[2] = done;
    result[3] = resolved;
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
) -> four_numbers:
    """Test pairs of faces in float64, 8 at a time, perhaps until the first that meet, and add those to a list.

    Returns how many have met then, how many are left open, which stand in front of their list then, how many were
    tested, and how many of these float64 left open and double words decided.
    """
    ...
