"""What the CPU does in its own way: `visit_item` in vector instructions, and atomics that are.

A visit computes the same numbers in the same order, three axes at a time. Two items at a time: neither waits for the
other, so the processor works on both.
"""

import warp as wp

from warp_abtree.kernels.pools import StatePool
from warp_abtree.kernels.pose import PairPose

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Eight items, the mask of those in use, and the pairs compared.
ten_numbers = wp.types.vector(length=10, dtype=wp.int64)


@wp.func_native("""
    wp::vec_t<10, wp::int64> result;
#if defined(__CUDA_ARCH__)
    __trap();  // warps have a visit of their own
#else
    typedef float lanes __attribute__((vector_size(16)));
    typedef int bits __attribute__((vector_size(16)));
    struct Branch { lanes sum, size, turned_sum, turned_size; float span; int skip, down, face; };
    const lanes zero = {0.0f, 0.0f, 0.0f, 0.0f};
    const auto& r = rotation.data;
    const lanes rows[3] = {{r[0][0], r[0][1], r[0][2], 0.0f}, {r[1][0], r[1][1], r[1][2], 0.0f},
                           {r[2][0], r[2][1], r[2][2], 0.0f}};
    const lanes columns[3] = {{r[0][0], r[1][0], r[2][0], 0.0f}, {r[0][1], r[1][1], r[2][1], 0.0f},
                              {r[0][2], r[1][2], r[2][2], 0.0f}};
    const lanes forth = {translation[0] + translation[0], translation[1] + translation[1],
                         translation[2] + translation[2], 0.0f};
    const lanes home = {back[0] + back[0], back[1] + back[1], back[2] + back[2], 0.0f};
    const float widening = margin + margin;
    const lanes wide = {widening, widening, widening, widening};
    auto load = [&](wp::int64 at, const lanes (&axes)[3], const lanes& shift) {
        const lanes* record = (const lanes*)((const float*)boxes.data + 8 * at);
        const lanes low = record[0], high = record[1];
        const lanes lower = __builtin_shufflevector(low, zero, 0, 1, 2, 4);
        const lanes upper = __builtin_shufflevector(high, zero, 0, 1, 2, 4);
        Branch b;
        b.sum = upper + lower;
        b.size = upper - lower;
        const lanes x = __builtin_shufflevector(b.sum, b.sum, 0, 0, 0, 0);
        const lanes y = __builtin_shufflevector(b.sum, b.sum, 1, 1, 1, 1);
        const lanes z = __builtin_shufflevector(b.sum, b.sum, 2, 2, 2, 2);
        const lanes u = __builtin_shufflevector(b.size, b.size, 0, 0, 0, 0);
        const lanes v = __builtin_shufflevector(b.size, b.size, 1, 1, 1, 1);
        const lanes w = __builtin_shufflevector(b.size, b.size, 2, 2, 2, 2);
        b.turned_sum = __builtin_elementwise_fma(axes[2], z, shift);
        b.turned_sum = __builtin_elementwise_fma(axes[1], y, b.turned_sum);
        b.turned_sum = __builtin_elementwise_fma(axes[0], x, b.turned_sum);
        b.turned_size = __builtin_elementwise_abs(axes[2]) * w;
        b.turned_size = __builtin_elementwise_fma(__builtin_elementwise_abs(axes[1]), v, b.turned_size);
        b.turned_size = __builtin_elementwise_fma(__builtin_elementwise_abs(axes[0]), u, b.turned_size);
        b.span = high[3];
        b.skip = ((bits)low)[3];
        b.face = ((bits)high)[3];
        b.down = b.face >= 0 ? b.skip : -b.skip;
        return b;
    };
    wp::int64 mask = 0, compared = 0;
    // What stands above the top of a stack may be no item.
    const wp::int64 taken[2] = {first, count > 1 ? second : first};
    #pragma clang loop unroll(full)
    for (int i = 0; i < 2; ++i) {
        const int x = (int)(taken[i] >> 32), y = (int)taken[i], two_a = x < 0, two_b = y < 0;
        const wp::int64 at_a = (wp::int64)node_a + (x < 0 ? -2 * x : x);
        const wp::int64 at_b = (wp::int64)node_b + (y < 0 ? -2 * y : y);
        const Branch a[2] = {load(at_a, rows, home), load(at_a + two_a, rows, home)};
        const Branch b[2] = {load(at_b, columns, forth), load(at_b + two_b, columns, forth)};
        const int used = i < count ? 257 * (1 + 2 * two_b + 4 * two_a + 8 * two_a * two_b) : 0;
        int found = 0;
        #pragma clang loop unroll(full)
        for (int k = 0; k < 4; ++k) {
            const Branch &p = a[k >> 1], &q = b[k & 1];
            const bits hit = (__builtin_elementwise_abs(p.sum - q.turned_sum) <= p.size + wide + q.turned_size)
                           & (__builtin_elementwise_abs(p.turned_sum - q.sum) <= p.turned_size + wide + q.size);
            const bool leaves = (p.face | q.face) >= 0;
            const int u = leaves ? p.face : p.span + p.span <= q.span ? p.down : p.skip;
            const int v = leaves ? q.face : q.span + q.span <= p.span ? q.down : q.skip;
            found |= (hit[0] & hit[1] & hit[2]) & (leaves ? 256 << k : 1 << k);
            result[4 * i + k] = ((wp::int64)u << 32) | (unsigned int)v;
        }
        mask |= (wp::int64)(found & used) << (4 * i);
        compared += i < count ? (1 + two_a) * (1 + two_b) : 0;
    }
    result[8] = mask;
    result[9] = compared;
#endif
    return result;
""")
def visit_two(
    boxes: wp.array(dtype=wp.vec4),
    node_a: wp.int32,
    node_b: wp.int32,
    rotation: wp.mat33,
    translation: wp.vec3,
    back: wp.vec3,
    margin: wp.float32,
    first: wp.int64,
    second: wp.int64,
    count: wp.int32,
) -> ten_numbers:
    """Compare what one or two items name; return what follows of both, a mask, and the pairs compared.

    Bits 0 to 7 of the mask stand for items to visit, bits 8 to 15 for pairs of faces to test.
    """
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return atomicAdd(total.data, 1);
#else
    return __atomic_fetch_add(total.data, 1, __ATOMIC_RELAXED);
#endif
""")
def take_slot(total: wp.array(dtype=wp.int32)) -> wp.int32:
    """Count one more into total[0] and return what it was; on the CPU, Warp's own atomics race with other threads."""
    ...


@wp.func
def visit_items(states: StatePool, pose: PairPose, first: wp.int64, second: wp.int64, count: wp.int32):
    """Compare what one or two items name, as `visit_two` returns it."""
    return visit_two(
        states.node_box,
        pose.node_a,
        pose.node_b,
        pose.rotation32,
        pose.translation32,
        pose.back32,
        pose.margin,
        first,
        second,
        count,
    )
