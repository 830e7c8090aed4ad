"""The threads of a warp at work on one stack in shared memory: a block is a warp, on the CPU one thread.

All its threads must reach `warp_stack`, `warp_sync`, `push_items`, `keep_value`, `push_crossing`, `keep_item`,
`warp_any`, `reserve_slot`, `count_flags` and `add_warp_sum` together.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

four_items = wp.types.vector(length=4, dtype=wp.int64)

WARP_SIZE = 32
STACK_LENGTH = 512  # node pairs, a power of two
# Fewer face pairs than there are threads wait while a visit adds four a thread at most.
CANDIDATE_LENGTH = 160
# Fewer than there are threads wait while each adds one at most.
CROSSING_LENGTH = 64
CROSSING_START = STACK_LENGTH + CANDIDATE_LENGTH


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return 32;
#else
    return 1;
#endif
""")
def warp_size() -> wp.int32: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return threadIdx.x;
#else
    return 0;
#endif
""")
def warp_lane() -> wp.int32: ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    __shared__ long long items[{CROSSING_START} + {CROSSING_LENGTH} * 3 / 2];
    // Through another thread, so that the address is held and not computed again at every use.
    return __shfl_sync(0xffffffffu, (unsigned int)__cvta_generic_to_shared(items), 0);
#else
    static long long items[{CROSSING_START} + {CROSSING_LENGTH} * 3 / 2];
    return (wp::uint64)items;
#endif
""")
def warp_stack() -> wp.uint64:
    """Return where this warp's items lie, an address in shared memory on CUDA.

    Its stack, its candidates, those that no plane parts, and the signs of these, half an item each.
    """
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
""")
def warp_sync(): ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    long long item;
    asm volatile("ld.shared.b64 %0, [%1];" : "=l"(item) : "r"((unsigned int)items + 8 * i) : "memory");
    return item;
#else
    return ((const long long*)items)[i];
#endif
""")
def read_item(items: wp.uint64, i: wp.int32) -> wp.int64: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    asm volatile("st.shared.b64 [%0], %1;" :: "r"((unsigned int)items + 8 * i), "l"(item) : "memory");
#else
    ((long long*)items)[i] = item;
#endif
""")
def write_item(items: wp.uint64, i: wp.int32, item: wp.int64): ...


@wp.func_native("""
    return ((long long)x << 32) | (unsigned int)y;
""")
def pack_item(x: wp.int32, y: wp.int32) -> wp.int64: ...


@wp.func_native("""
    return (int)(item >> 32);
""")
def item_first(item: wp.int64) -> wp.int32: ...


@wp.func_native("""
    return (int)item;
""")
def item_second(item: wp.int64) -> wp.int32: ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    const unsigned int mine = (steps[0] + steps[1]) + (steps[2] + steps[3]);
    unsigned int sum = mine;
    // What came from a thread is added, nothing where there is none.
    #pragma unroll
    for (int step = 1; step < 32; step <<= 1)
        asm volatile("{{ .reg .pred from; .reg .b32 other;"
                     " shfl.sync.up.b32 other|from, %0, %1, 0, 0xffffffff; @from add.u32 %0, %0, other; }}"
                     : "+r"(sum) : "r"(step));
    const unsigned int total = __shfl_sync(0xffffffffu, sum, 31);
    // Bytes from the start: on the stack in the low half, among the face pairs in the high half.
    unsigned int place = ((end & {STACK_LENGTH - 1}) | ({STACK_LENGTH} + end_waiting) << 16) * 8 + (sum - mine) * 8;
    #pragma unroll
    for (int k = 0; k < 4; ++k) {{
        const unsigned int at = steps[k] > 1 ? place >> 16 : place & {8 * STACK_LENGTH - 1};
        asm volatile("{{ .reg .pred used; setp.ne.u32 used, %0, 0; @used st.shared.v2.b32 [%1], {{%2, %3}}; }}"
                     :: "r"(steps[k]), "r"((unsigned int)items + at), "r"((int)children[k]),
                        "r"((int)(children[k] >> 32)) : "memory");
        place += 8 * steps[k];
    }}
#else
    long long* stack = (long long*)items;
    int total = 0;
    for (int k = 0; k < 4; ++k) {{
        if (steps[k] > 1)
            stack[{STACK_LENGTH} + end_waiting + (total >> 16)] = children[k];
        else if (steps[k] == 1)
            stack[(end + total) & {STACK_LENGTH - 1}] = children[k];
        total += steps[k];
    }}
#endif
    return ((long long)(end_waiting + (total >> 16)) << 32) | (unsigned int)(end + (total & 0xffff));
""")
def push_items(
    items: wp.uint64, end: wp.int32, end_waiting: wp.int32, steps: wp.vec4i, children: four_items
) -> wp.int64:
    """Append the children with an ITEM_STEP to the stack, those with a FACE_STEP to the face pairs; return both ends.

    The ends come packed, that of the face pairs first.
    """
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __shfl_sync(0xffffffffu, x, 0);
#else
    return x;
#endif
""")
def keep_value(x: wp.int32) -> wp.int32:
    """Return a number that is the same in all threads, so that it is held and not computed again where it is used."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    const unsigned int votes = __ballot_sync(0xffffffffu, flag);
    const unsigned int at = end + __popc(votes & ((1u << threadIdx.x) - 1u)), start = items;
    asm volatile("{{ .reg .pred used; setp.ne.s32 used, %0, 0;"
                 " @used st.shared.b64 [%1], %2; @used st.shared.b32 [%3], %4; }}"
                 :: "r"((int)flag), "r"(start + 8 * ({CROSSING_START} + at)), "l"(item),
                    "r"(start + 8 * {CROSSING_START + CROSSING_LENGTH} + 4 * at), "r"(signs) : "memory");
    return end + __popc(votes);
#else
    if (flag) {{
        ((long long*)items)[{CROSSING_START} + end] = item;
        ((int*)items)[2 * {CROSSING_START + CROSSING_LENGTH} + end] = signs;
    }}
    return end + flag;
#endif
""")
def push_crossing(items: wp.uint64, end: wp.int32, flag: bool, item: wp.int64, signs: wp.int32) -> wp.int32:
    """Append the face pairs whose flag is set, with their signs, to those that no plane parts; return the new end."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    int signs;
    asm volatile("ld.shared.b32 %0, [%1];"
                 : "=r"(signs)
                 : "r"((unsigned int)items + 8 * {CROSSING_START + CROSSING_LENGTH} + 4 * i) : "memory");
    return signs;
#else
    return ((const int*)items)[2 * {CROSSING_START + CROSSING_LENGTH} + i];
#endif
""")
def read_signs(items: wp.uint64, i: wp.int32) -> wp.int32:
    """Return the signs of the i-th face pair that no plane parts."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    __shared__ int4 items[{CROSSING_LENGTH}];
    return __cvta_generic_to_shared(items);
#else
    static int items[{CROSSING_LENGTH} * 4];
    return (wp::uint64)items;
#endif
""")
def warp_kept() -> wp.uint64:
    """Return where this warp keeps face pairs with their signs, an address in shared memory on CUDA."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const unsigned int votes = __ballot_sync(0xffffffffu, flag);
    const unsigned int at = (unsigned int)kept + 16 * (end + __popc(votes & ((1u << threadIdx.x) - 1u)));
    if (flag)
        asm volatile("st.shared.v4.b32 [%0], {%1, %2, %3, %4};"
                     :: "r"(at), "r"(item[0]), "r"(item[1]), "r"(item[2]), "r"(signs) : "memory");
    return end + __popc(votes);
#else
    int* to = (int*)kept + 4 * end;
    for (int k = 0; flag && k < 4; ++k)
        to[k] = k < 3 ? item[k] : signs;
    return end + flag;
#endif
""")
def keep_item(kept: wp.uint64, end: wp.int32, flag: bool, item: wp.vec3i, signs: wp.int32) -> wp.int32:
    """Append the face pairs whose flag is set, with their signs, to those that are kept; return the new end."""
    ...


@wp.func_native("""
    wp::vec_t<4, wp::int32> x;
#if defined(__CUDA_ARCH__)
    asm volatile("ld.shared.v4.b32 {%0, %1, %2, %3}, [%4];"
                 : "=r"(x[0]), "=r"(x[1]), "=r"(x[2]), "=r"(x[3]) : "r"((unsigned int)kept + 16 * i) : "memory");
#else
    for (int k = 0; k < 4; ++k)
        x[k] = ((const int*)kept)[4 * i + k];
#endif
    return x;
""")
def read_kept(kept: wp.uint64, i: wp.int32) -> wp.vec4i:
    """Return the i-th face pair that is kept, and its signs."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffffu, flag);
#else
    return flag;
#endif
""")
def warp_any(flag: bool) -> bool: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    return __builtin_ctz(bits);
#endif
""")
def lowest_bit(bits: wp.int32) -> wp.int32: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    unsigned int votes = __ballot_sync(0xffffffffu, flag);
    if (votes == 0)
        return 0;
    int lane = threadIdx.x;
    int leader = __ffs(votes) - 1;
    int start = 0;
    if (lane == leader)
        start = atomicAdd(total.data, __popc(votes));
    start = __shfl_sync(0xffffffffu, start, leader);
    return start + __popc(votes & ((1u << lane) - 1u));
#else
    int start = total.data[0];
    if (flag)
        total.data[0] = start + 1;
    return start;
#endif
""")
def reserve_slot(total: wp.array(dtype=wp.int32), flag: bool) -> wp.int32:
    """Count the set flags into total[0] with one atomic a warp; return the slot of each thread whose flag is set."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    long long sum = x;
    for (int step = 16; step > 0; step >>= 1)
        sum += __shfl_down_sync(0xffffffffu, sum, step);
    if (threadIdx.x == 0 && sum != 0)
        atomicAdd((unsigned long long*)totals.data + i, (unsigned long long)sum);
#else
    totals.data[i] += x;
#endif
""")
def add_warp_sum(totals: wp.array(dtype=wp.int64), i: wp.int32, x: wp.int32):
    """Add a value of every thread to totals[i] with one atomic a warp."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    if (!__any_sync(0xffffffffu, flag))
        return;
    unsigned int same = __match_any_sync(0xffffffffu, flag ? i : -1);
    if (flag && threadIdx.x + 1 == __ffs(same))
        atomicAdd((unsigned long long*)totals.data + i, (unsigned long long)__popc(same));
#else
    if (flag)
        totals.data[i] += 1;
#endif
""")
def count_flags(totals: wp.array(dtype=wp.int64), i: wp.int32, flag: bool):
    """Count the set flags into totals[i], i >= 0 of each thread, with one atomic for those that share it."""
    ...
