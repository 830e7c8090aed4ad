"""The threads of a warp at work on one stack in shared memory: a block is a warp, on the CPU one thread.

All its threads must reach `warp_sync`, `push_items`, `warp_any`, `reserve_slot`, `count_flags` and `add_warp_sum`
together.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

four_items = wp.types.vector(length=4, dtype=wp.int64)

WARP_SIZE = 32
STACK_LENGTH = 512  # node pairs, a power of two
# Fewer face pairs than there are threads wait while a visit adds four a thread at most.
CANDIDATE_LENGTH = 160


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
    __shared__ long long items[{STACK_LENGTH + CANDIDATE_LENGTH + WARP_SIZE}];
    return (wp::uint64)items;
#else
    static long long items[{STACK_LENGTH + CANDIDATE_LENGTH + 1}];
    return (wp::uint64)items;
#endif
""")
def warp_stack() -> wp.uint64:
    """Return the address of this warp's items: its stack, then its candidates."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
""")
def warp_sync(): ...


@wp.func_native("""
    return ((const long long*)items)[i];
""")
def read_item(items: wp.uint64, i: wp.int32) -> wp.int64: ...


@wp.func_native("""
    ((long long*)items)[i] = item;
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
    long long* stack = (long long*)items;
    int stacked = end, waiting = end_waiting, all = mask, unused = {STACK_LENGTH + CANDIDATE_LENGTH};
#if defined(__CUDA_ARCH__)
    unused += threadIdx.x;
    // Bits 0 to 3 count in the low half, bits 4 to 7 in the high half.
    unsigned int mine = __popc(mask & 15) | (__popc(mask & 240) << 16), sum = mine;
    for (int step = 1; step < 32; step <<= 1) {{
        unsigned int other = __shfl_up_sync(0xffffffffu, sum, step);
        if (threadIdx.x >= step)
            sum += other;
    }}
    unsigned int total = __shfl_sync(0xffffffffu, sum, 31);
    stacked += (sum - mine) & 0xffff;
    waiting += (sum - mine) >> 16;
#else
    unsigned int total = __builtin_popcount(mask & 15) | (__builtin_popcount(mask & 240) << 16);
#endif
    #pragma unroll
    for (int k = 0; k < 4; ++k) {{
        const bool down = all & (1 << k), face = all & (16 << k);
        // What is not in use goes where nobody reads: a store without a branch.
        int at = face ? {STACK_LENGTH} + waiting : unused;
        at = down ? stacked & {STACK_LENGTH - 1} : at;
        stacked += down;
        waiting += face;
        stack[at] = children[k];
    }}
    return ((long long)(end_waiting + (total >> 16)) << 32) | (unsigned int)(end + (total & 0xffff));
""")
def push_items(
    items: wp.uint64, end: wp.int32, end_waiting: wp.int32, mask: wp.int32, children: four_items
) -> wp.int64:
    """Append the children of bits 0 to 3 to the stack, those of bits 4 to 7 to the face pairs; return both new ends.

    The ends come packed, that of the face pairs first.
    """
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
