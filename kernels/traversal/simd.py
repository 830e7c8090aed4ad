"""The traversal on the CPU in vector instructions, and atomics that are.

`descend` compares four pairs of boxes at a time, as `visit_item` does one by one, and `screen_waiting` 16 pairs of
faces, as `screen_triangles` does one: the same numbers in the same order, so that every device finds and counts the
same. Items wait for one another in no way, so the processor works on several at once.
"""

import warp as wp

from warp_abtree.kernels.arrays import ModelPool, StatePool
from warp_abtree.kernels.poses import PairPose

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Items that are taken at once, and brought into the cache together: as many as find room.
ITEMS_AT_ONCE = 64
STACK_ROOM = 1024
# One at a time, depth first, leaves three items a level, 31 levels deep; a visit writes over four more, and divisions
# round.
ROOM_FOR_ONE = 3 * 31 + 8

three_numbers = wp.types.vector(length=3, dtype=wp.int64)

# Which of the four pairs of boxes are in use, four bits for each choice: of two siblings the first (1), the second (2)
# or both (3), in A and in B.
ROWS, COLUMNS = (0, 3, 12, 15), (0, 5, 10, 15)
PAIRS_USED = sum((ROWS[a] & COLUMNS[b]) << 4 * (4 * a + b) for a in range(4) for b in range(4))


def every_other(first):
    """Return the indices of a shuffle of two times 16 numbers that takes each second one."""
    return ", ".join(str(first + 2 * i) for i in range(16))


def in_groups(*first):
    """Return the indices of a shuffle of two times 16 numbers that does the same in each group of four."""
    return ", ".join(str(i + 4 * group) for group in range(4) for i in first)


@wp.func_native(f"""
    wp::vec_t<3, wp::int64> result;
#if defined(__CUDA_ARCH__)
    __trap();  // warps have a visit of their own
#else
    // Groups of four numbers: x, y, z and one that is not in use.
    typedef float groups __attribute__((vector_size(64)));
    typedef float loose __attribute__((vector_size(64), aligned(16)));
    typedef int bits __attribute__((vector_size(64)));
    typedef float eight __attribute__((vector_size(32)));
    typedef int ints __attribute__((vector_size(32)));
    typedef wp::int64 longs __attribute__((vector_size(32)));
    typedef wp::int64 loose_longs __attribute__((vector_size(32), aligned(8)));
    typedef bool flags __attribute__((ext_vector_type(16)));
    typedef bool eight_flags __attribute__((ext_vector_type(8)));
    const groups none = {{}};
    const auto& r = pose.rotation32.data;
    const auto& there = pose.translation32;
    const auto& back = pose.back32;
    // For both children of A, then for both children of B.
    groups axes[3];
    for (int k = 0; k < 3; ++k)
        axes[k] = groups{{r[k][0], r[k][1], r[k][2], 0.0f, r[k][0], r[k][1], r[k][2], 0.0f,
                          r[0][k], r[1][k], r[2][k], 0.0f, r[0][k], r[1][k], r[2][k], 0.0f}};
    const groups turned[3] = {{__builtin_elementwise_abs(axes[0]), __builtin_elementwise_abs(axes[1]),
                               __builtin_elementwise_abs(axes[2])}};
    const float home[3] = {{back[0] + back[0], back[1] + back[1], back[2] + back[2]}};
    const float forth[3] = {{there[0] + there[0], there[1] + there[1], there[2] + there[2]}};
    const groups shift = {{home[0], home[1], home[2], 0.0f, home[0], home[1], home[2], 0.0f,
                           forth[0], forth[1], forth[2], 0.0f, forth[0], forth[1], forth[2], 0.0f}};
    const float w = pose.margin + pose.margin;
    const groups wide = {{w, w, w, w, w, w, w, w, w, w, w, w, w, w, w, w}};
    // The boxes of A twice each, those of B in turn: four pairs.
    auto of_a = [](const groups& v) {{
        return __builtin_shufflevector(v, v, 0, 1, 2, 3, 0, 1, 2, 3, 4, 5, 6, 7, 4, 5, 6, 7);
    }};
    auto of_b = [](const groups& v) {{
        return __builtin_shufflevector(v, v, 8, 9, 10, 11, 12, 13, 14, 15, 8, 9, 10, 11, 12, 13, 14, 15);
    }};
    struct Taken {{ const char *a, *b; unsigned int used; }};
    const char* tree_a = (const char*)states.node_box.data + 32 * (wp::int64)pose.node_a;
    const char* tree_b = (const char*)states.node_box.data + 32 * (wp::int64)pose.node_b;
    wp::int64* items = stack.data;
    wp::int64* found = faces.data;
    wp::int64 compared = 0;
    int end = top, waiting = 0;
    // Siblings lie side by side, so an item says which two, by half the first one's index times 4, and which of them.
    auto take = [&](wp::int64 item) {{
        const unsigned int x = (unsigned int)(item >> 32), y = (unsigned int)item;
        const Taken taken = {{tree_a + 16 * (wp::int64)(x & -4), tree_b + 16 * (wp::int64)(y & -4),
                              (unsigned int)({PAIRS_USED}ull >> (((x & 3) << 4) | ((y & 3) << 2))) & 15}};
        __builtin_prefetch(taken.a);
        __builtin_prefetch(taken.b);
        return taken;
    }};
    auto visit = [&](const Taken& taken) {{
        const groups a = *(const loose*)taken.a, b = *(const loose*)taken.b;
        groups low = __builtin_shufflevector(a, b, 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27);
        groups high = __builtin_shufflevector(a, b, 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31);
        low = __builtin_shufflevector(low, none, 0, 1, 2, 16, 4, 5, 6, 16, 8, 9, 10, 16, 12, 13, 14, 16);
        high = __builtin_shufflevector(high, none, 0, 1, 2, 16, 4, 5, 6, 16, 8, 9, 10, 16, 12, 13, 14, 16);
        const groups sum = high + low, size = high - low;
        const groups x = __builtin_shufflevector(sum, sum, {in_groups(0, 0, 0, 0)});
        const groups y = __builtin_shufflevector(sum, sum, {in_groups(1, 1, 1, 1)});
        const groups z = __builtin_shufflevector(sum, sum, {in_groups(2, 2, 2, 2)});
        const groups p = __builtin_shufflevector(size, size, {in_groups(0, 0, 0, 0)});
        const groups q = __builtin_shufflevector(size, size, {in_groups(1, 1, 1, 1)});
        const groups s = __builtin_shufflevector(size, size, {in_groups(2, 2, 2, 2)});
        groups sum_there = __builtin_elementwise_fma(axes[2], z, shift);
        sum_there = __builtin_elementwise_fma(axes[1], y, sum_there);
        sum_there = __builtin_elementwise_fma(axes[0], x, sum_there);
        groups size_there = __builtin_elementwise_fma(turned[2], s, wide);
        size_there = __builtin_elementwise_fma(turned[1], q, size_there);
        size_there = __builtin_elementwise_fma(turned[0], p, size_there);
        const bits hit =
            (__builtin_elementwise_abs(of_a(sum) - of_b(sum_there)) <= of_a(size) + of_b(size_there)) &
            (__builtin_elementwise_abs(of_a(sum_there) - of_b(sum)) <= of_a(size_there) + of_b(size));
        unsigned int m = __builtin_bit_cast(unsigned short, __builtin_convertvector(hit, flags)) | 0x8888;
        m &= m >> 1;
        m &= m >> 2;
        // Bits 0, 4, 8 and 12 side by side.
        const unsigned int mask = ((m & 0x1111) * 0x1248 >> 12) & taken.used;
        // What follows, as in `next_item`: of A for the four pairs, then of B.
        const bits whole_a = (bits)a, whole_b = (bits)b;
        const ints skip = __builtin_shufflevector(whole_a, whole_b, 3, 3, 11, 11, 19, 27, 19, 27);
        const ints face = __builtin_shufflevector(whole_a, whole_b, 7, 7, 15, 15, 23, 31, 23, 31);
        const ints other = __builtin_shufflevector(face, face, 4, 5, 6, 7, 0, 1, 2, 3);
        const eight span = (eight)face, other_span = (eight)other;
        const ints inner = (face | other) < 0, down = (face < 0) & (span + span <= other_span);
        const ints stay = ((skip + skip) & -4) + (skip & 1) + 1;
        const ints next = inner ? (down ? 4 * skip + 3 : stay) : face;
        const longs pairs = (longs)__builtin_shufflevector(next, next, 4, 0, 5, 1, 6, 2, 7, 3);
        const unsigned int go =
            mask & __builtin_bit_cast(unsigned char, __builtin_convertvector(inner, eight_flags));
        const unsigned int test = mask & ~go;
        compared += __builtin_popcount(taken.used);
#if defined(__AVX512VL__)
        *(loose_longs*)(items + end) = __builtin_ia32_compressdi256_mask(pairs, longs{{}}, go);
        *(loose_longs*)(found + waiting) = __builtin_ia32_compressdi256_mask(pairs, longs{{}}, test);
        end += __builtin_popcount(go);
        waiting += __builtin_popcount(test);
#else
        // Without branches, which could not be predicted; what is not in use is written over.
        #pragma clang loop unroll(full)
        for (int k = 0; k < 4; ++k) {{
            items[end] = found[waiting] = pairs[k];
            end += (go >> k) & 1;
            waiting += (test >> k) & 1;
        }}
#endif
    }};
    while (end > 0 && waiting < ready) {{
        const int room = ({STACK_ROOM - ROOM_FOR_ONE} - end) / 3, fits = room > 1 ? room : 1;
        const int wanted = at_once < fits ? at_once : fits, count = wanted < end ? wanted : end;
        end -= count;
        Taken taken[{ITEMS_AT_ONCE}];
        for (int i = 0; i < count; ++i)
            taken[i] = take(items[end + i]);
        for (int i = 0; i < count; ++i)
            visit(taken[i]);
    }}
    result[0] = end;
    result[1] = waiting;
    result[2] = compared;
#endif
    return result;
""")
def descend(
    states: StatePool,
    pose: PairPose,
    at_once: wp.int32,
    ready: wp.int32,
    top: wp.int32,
    stack: wp.array(dtype=wp.int64),
    faces: wp.array(dtype=wp.int64),
) -> three_numbers:
    """Visit items from the top of a stack until there are none, or so many pairs of faces wait as are asked for.

    Returns the items left on the stack, the pairs of faces that wait, and the pairs of boxes compared.
    """
    ...


@wp.func
def single_node(node: wp.int32):
    """Return what an item of `descend` says of one node."""
    return 4 * (node >> 1) + (node & 1) + 1


@wp.func_native(f"""
    wp::vec_t<3, wp::int64> result;
#if defined(__CUDA_ARCH__)
    __trap();  // a thread tests a pair
#else
    {{
    #pragma clang fp contract(off)
    // A number of each of 16 pairs of faces.
    typedef float lanes __attribute__((vector_size(64)));
    typedef int bits __attribute__((vector_size(64)));
    typedef bool flags __attribute__((ext_vector_type(16)));
    typedef float four __attribute__((vector_size(16)));
    typedef float eight __attribute__((vector_size(32)));
    typedef int loose __attribute__((vector_size(64), aligned(4)));
    typedef unsigned int counts __attribute__((vector_size(64)));
    typedef wp::int64 longs __attribute__((vector_size(64)));
    typedef unsigned int sixteen[16];
    struct Point {{ lanes x, y, z; }};
    const auto& r = pose.rotation32.data;
    const auto& t = pose.translation32;
    const float scale = (float)pose.scale;
    const void* near = models.vertex_near.data;
    const void* corners = states.face_corner.data;
    wp::int64* list = faces.data;
    wp::int64* rest = left_open.data;
    auto every = [](float v) {{ return lanes{{v, v, v, v, v, v, v, v, v, v, v, v, v, v, v, v}}; }};
    auto absolute = [](const lanes& v) {{ return __builtin_elementwise_abs(v); }};
    auto fuse = [](const lanes& a, const lanes& b, const lanes& c) {{ return __builtin_elementwise_fma(a, b, c); }};
    auto sum_sizes = [&](const Point& v) {{ return (absolute(v.x) + absolute(v.y)) + absolute(v.z); }};
    auto minus = [](const Point& a, const Point& b) {{ return Point{{a.x - b.x, a.y - b.y, a.z - b.z}}; }};
    auto cross = [&](const Point& u, const Point& v) {{
        return Point{{fuse(u.y, v.z, -(u.z * v.y)), fuse(u.z, v.x, -(u.x * v.z)), fuse(u.x, v.y, -(u.y * v.x))}};
    }};
    auto dot = [&](const Point& u, const Point& v) {{ return fuse(u.x, v.x, fuse(u.y, v.y, u.z * v.z)); }};
    auto bound_error = [&](const lanes& u, const lanes& v, const lanes& w) {{
        const lanes p = u + 2.0f * error, q = v + 2.0f * error, s = w + 2.0f * error;
        return error * (p * q + s * (p + q)) + unit * (p * q * s);
    }};
    auto choose = [](const bits& which, const Point& a, const Point& b) {{
        return Point{{which ? a.x : b.x, which ? a.y : b.y, which ? a.z : b.z}};
    }};
    auto to_mask = [](const bits& which) {{
        return (unsigned int)__builtin_bit_cast(unsigned short, __builtin_convertvector(which, flags));
    }};
    auto widen = [](unsigned int mask) {{
        return -__builtin_convertvector(__builtin_bit_cast(flags, (unsigned short)mask), bits);
    }};
    // Rows of four numbers, each where so many pairs of numbers end.
    auto gather = [](const void* table, const sixteen& start) {{
        auto at = [&](int k) {{ return *(const four*)((const double*)table + start[k]); }};
        lanes row[4];
        for (int k = 0; k < 4; ++k) {{
            const eight p = __builtin_shufflevector(at(k), at(k + 4), 0, 1, 2, 3, 4, 5, 6, 7);
            const eight q = __builtin_shufflevector(at(k + 8), at(k + 12), 0, 1, 2, 3, 4, 5, 6, 7);
            row[k] = __builtin_shufflevector(p, q, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
        }}
        const lanes low_01 = __builtin_shufflevector(row[0], row[1], {in_groups(0, 16, 1, 17)});
        const lanes low_23 = __builtin_shufflevector(row[2], row[3], {in_groups(0, 16, 1, 17)});
        const lanes high_01 = __builtin_shufflevector(row[0], row[1], {in_groups(2, 18, 3, 19)});
        const lanes high_23 = __builtin_shufflevector(row[2], row[3], {in_groups(2, 18, 3, 19)});
        return Point{{__builtin_shufflevector(low_01, low_23, {in_groups(0, 1, 16, 17)}),
                      __builtin_shufflevector(low_01, low_23, {in_groups(2, 3, 18, 19)}),
                      __builtin_shufflevector(high_01, high_23, {in_groups(0, 1, 16, 17)})}};
    }};
    auto near_a = [&](const sixteen& corner) {{
        const Point p = gather(near, corner);
        return Point{{p.x * scale, p.y * scale, p.z * scale}};
    }};
    auto near_b = [&](const sixteen& corner) {{
        const Point p = gather(near, corner);
        lanes x[3];
        for (int i = 0; i < 3; ++i) {{
            x[i] = fuse(every(r[i][2]), p.z, every(t[i]));
            x[i] = fuse(every(r[i][0]), p.x, fuse(every(r[i][1]), p.y, x[i]));
        }}
        return Point{{x[0] * scale, x[1] * scale, x[2] * scale}};
    }};
    // Of 16 times three signs those that are 1 and those that are -1, a bit each; where they lie on one side, and where
    // one is UNSURE or all are 0.
    struct Sides {{ unsigned int above[3], below[3], one_sided, unsure; }};
    auto sides_of_plane = [&](const Point& a, const Point& b, const Point& c, const Point (&d)[3]) {{
        const Point u = minus(b, a), v = minus(c, a);
        const Point w[3] = {{minus(a, d[0]), minus(a, d[1]), minus(a, d[2])}};
        const Point normal = cross(u, v);
        const lanes size[3] = {{sum_sizes(w[0]), sum_sizes(w[1]), sum_sizes(w[2])}};
        const lanes more = size[1] > size[2] ? size[1] : size[2];
        const lanes bound = bound_error(sum_sizes(u), sum_sizes(v), size[0] > more ? size[0] : more);
        Sides s;
        unsigned int none[3];
        for (int i = 0; i < 3; ++i) {{
            const lanes value = dot(w[i], normal);
            s.above[i] = to_mask(value > bound);
            s.below[i] = to_mask(value < -bound);
            none[i] = ~(s.above[i] | s.below[i]);
        }}
        s.one_sided = (s.above[0] & s.above[1] & s.above[2]) | (s.below[0] & s.below[1] & s.below[2]);
        s.unsure = (none[0] | none[1] | none[2]) & (~to_mask(bound == 0.0f) | (none[0] & none[1] & none[2]));
        return s;
    }};
    // As `find_alone`, and the corners turned so that this one comes first.
    auto turn = [&](const Sides& s, const Point (&c)[3], bits& back, Point& p, Point& q, Point& last) {{
        const unsigned int pair_above = s.above[0] & s.above[1], odd_above = s.above[0] ^ s.above[1];
        const unsigned int pair_below = s.below[0] & s.below[1], odd_below = s.below[0] ^ s.below[1];
        const unsigned int positive = (odd_above ^ s.above[2]) & ~(pair_above & s.above[2]);
        const unsigned int negative = (odd_below ^ s.below[2]) & ~(pair_below & s.below[2]) & ~positive;
        const unsigned int zero = ~(positive | negative);
        auto is_kind = [&](int i) {{
            return widen((positive & s.above[i]) | (negative & s.below[i]) | (zero & ~(s.above[i] | s.below[i])));
        }};
        const bits first = is_kind(0), second = is_kind(1);
        back = widen(negative | (zero & (pair_above | (odd_above & s.above[2]))));
        p = choose(first, c[0], choose(second, c[1], c[2]));
        q = choose(first, c[1], choose(second, c[2], c[0]));
        last = choose(first, c[2], choose(second, c[0], c[1]));
    }};
    struct Side {{ unsigned int above, unsure; }};
    auto side_of_plane = [&](const Point& a, const Point& b, const Point& c, const Point& d) {{
        const Point u = minus(a, d), v = minus(b, d), w = minus(c, d);
        const lanes value = dot(u, cross(v, w)), bound = bound_error(sum_sizes(u), sum_sizes(v), sum_sizes(w));
        const unsigned int above = to_mask(value > bound);
        return Side{{above, ~(above | to_mask(value < -bound) | to_mask(bound == 0.0f))}};
    }};
    int met = 0, open = 0, done = 0;
    if (error == __builtin_inff()) {{
        for (; open < waiting; ++open)
            rest[open] = list[open];
        done = waiting;
    }}
    while (done < waiting && (done == 0 || met == 0 || !first_ends)) {{
        const int count = waiting - done < 16 ? waiting - done : 16;
        const wp::int64* items = list + done;
        const longs lane = {{0, 1, 2, 3, 4, 5, 6, 7}}, some = longs{{}} + items[0];
        const bits low = (bits)(lane < count ? (longs)*(const loose*)items : some);
        const bits high = (bits)(lane + 8 < count ? (longs)*(const loose*)(items + 8) : some);
        // Rows of two faces, then of six corners.
        alignas(64) sixteen face[2], corner[6];
        *(counts*)face[0] = 2 * (counts)(pose.corner_a + __builtin_shufflevector(low, high, {every_other(1)}));
        *(counts*)face[1] = 2 * (counts)(pose.corner_b + __builtin_shufflevector(low, high, {every_other(0)}));
        for (int i = 0; i < 2; ++i) {{
            const Point c = gather(corners, face[i]);
            *(counts*)corner[3 * i] = 2 * (counts)c.x;
            *(counts*)corner[3 * i + 1] = 2 * (counts)c.y;
            *(counts*)corner[3 * i + 2] = 2 * (counts)c.z;
        }}
        auto append = [&](wp::int64* to, unsigned int which) {{
#if defined(__AVX512VL__)
            const longs first = __builtin_ia32_compressdi512_mask((longs)low, longs{{}}, which);
            const longs second = __builtin_ia32_compressdi512_mask((longs)high, longs{{}}, which >> 8);
            *(loose*)to = (loose)first;
            *(loose*)(to + __builtin_popcount(which & 255)) = (loose)second;
#else
            for (int n = 0; which != 0; which &= which - 1)
                to[n++] = items[__builtin_ctz(which)];
#endif
        }};
        done += count;
        const Point a[3] = {{near_a(corner[0]), near_a(corner[1]), near_a(corner[2])}};
        const Point b[3] = {{near_b(corner[3]), near_b(corner[4]), near_b(corner[5])}};
        const Sides sides_a = sides_of_plane(b[0], b[1], b[2], a), sides_b = sides_of_plane(a[0], a[1], a[2], b);
        const unsigned int left = ~(sides_a.one_sided | sides_b.one_sided) & ((1u << count) - 1);
        const unsigned int unsure = sides_a.unsure | sides_b.unsure;
        // Of a mesh laid on itself, or nearly so, as a rule all.
        if ((left & ~unsure) == 0) {{
            append(rest + open, left);
            open += __builtin_popcount(left);
            continue;
        }}
        bits back_a, back_b;
        Point p1, q1, r1, p2, q2, r2;
        turn(sides_a, a, back_a, p1, q1, r1);
        turn(sides_b, b, back_b, p2, q2, r2);
        const Side s = side_of_plane(p1, choose(back_b, r1, q1), p2, choose(back_a, r2, q2));
        const Side e = side_of_plane(p1, choose(back_b, q1, r1), choose(back_a, q2, r2), p2);
        const unsigned int apart = s.above | e.above, opens = left & (unsure | (~apart & (s.unsure | e.unsure)));
        const unsigned int meet = left & ~opens & ~apart;
        if (opens != 0) {{
            append(rest + open, opens);
            open += __builtin_popcount(opens);
        }}
        // Last: those that meet take the place of pairs that were looked at, perhaps of these.
        append(list + met, meet);
        met += __builtin_popcount(meet);
    }}
    result[0] = met;
    result[1] = open;
    result[2] = done;
    }}
#endif
    return result;
""")
def screen_waiting(
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    error: wp.float32,
    unit: wp.float32,
    first_ends: bool,
    waiting: wp.int32,
    faces: wp.array(dtype=wp.int64),
    left_open: wp.array(dtype=wp.int64),
) -> three_numbers:
    """Test pairs of faces as `screen_triangles`, 16 at a time, perhaps until the first that meet.

    Lists have room for 16 more.

    Returns how many met, which stand in front of the list then, how many are left open, and how many were tested.
    """
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return atomicAdd(total.data, count);
#else
    return __atomic_fetch_add(total.data, count, __ATOMIC_RELAXED);
#endif
""")
def take_slots(total: wp.array(dtype=wp.int32), count: wp.int32) -> wp.int32:
    """Count more into total[0] and return what it was; on the CPU, Warp's own atomics race with other threads."""
    ...
