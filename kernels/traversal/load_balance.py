"""Warps that share work: whoever has none left waits, and whoever has much gives it some.

Units of work are numbered. A warp takes the next one until there are no more, then a ticket, and waits at the mailbox
of that number. A warp at work looks how many tickets have not been served, and serves the next few with the oldest
items of its stack. The last unit or share to end sends home all that wait.

Nothing is lost and nobody waits in vain. Warps that have looked at the same time may serve tickets that nobody has
taken yet, SHARES_AT_ONCE each at most, since whoever looks then sees none to serve. Each of these is taken in the
end: a warp at work ends and takes the next ticket, and goes on with what it finds there. Tickets that share a mailbox
are told apart by their number. Whoever finds the mailbox of its ticket full waits for a warp that runs: as there are
more mailboxes than tickets served ahead, the ticket that it is full for has been taken. So a launch may have any
number of warps.
"""

import warp as wp

from warp_abtree.kernels.generation import LaunchRecord

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# A power of two, more than SHARES_AT_ONCE for each warp that a device runs at a time.
MAILBOX_COUNT = 8192
SHARES_AT_ONCE = wp.constant(3)
MAILBOX_ITEMS = 32
COUNTER_COUNT = 4

# More than there are units of any launch: as the number of units taken, it leaves none.
NO_UNIT = wp.constant(2**30)


@wp.struct
class Work:
    """Counters and mailboxes of one launch.

    counter: tickets served, tickets taken, units and shares not ended, units taken. flag: 0 empty, the ticket + 1
    that it is full for, or -1 when all is done, shape [mailbox]. owner: (object pair, number of items), shape
    [mailbox]. item: shape [mailbox * 32]. record: what the launch was given; not an argument of its own, which would
    take time in every launch.
    """

    counter: wp.array(dtype=wp.int32)
    flag: wp.array(dtype=wp.int32)
    owner: wp.array(dtype=wp.vec2i)
    item: wp.array(dtype=wp.int64)
    record: LaunchRecord


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    int unit = 0;
    if (threadIdx.x == 0)
        unit = atomicAdd(counter.data + 3, 1);
    return __shfl_sync(0xffffffffu, unit, 0);
#else
    return __atomic_fetch_add(counter.data + 3, 1, __ATOMIC_RELAXED);
#endif
""")
def take_unit(counter: wp.array(dtype=wp.int32)) -> wp.int32:
    """Return the number of a unit of work that no other warp has; from the number of units on there is none."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    // One load of both, past the first-level cache.
    return *(const volatile long long*)counter.data;
#else
    return 0;
#endif
""")
def load_tickets(counter: wp.array(dtype=wp.int32)) -> wp.int64:
    """Return the tickets taken and, in the low half, those served, to be subtracted when they have arrived."""
    ...


@wp.func_native("""
    const int hungry = (int)(tickets >> 32) - (int)tickets;
#if defined(__CUDA_ARCH__)
    // Threads that were not together read at different times; what follows needs the same number in all.
    return __shfl_sync(0xffffffffu, hungry, 0);
#else
    return hungry;
#endif
""")
def count_hungry(tickets: wp.int64) -> wp.int32:
    """Return about how many warps wait for a share."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    int box = -1;
    if (threadIdx.x == 0) {{
        int ticket = atomicAdd(counter.data + 1, 1);
        const volatile int* mine = (const volatile int*)(flag.data + (ticket & {MAILBOX_COUNT - 1}));
        __threadfence();
        // Whoever ends the last unit sends home those who have tickets by then.
        if (*(const volatile int*)(counter.data + 2) != 0) {{
            int got = *mine;
            while (got != ticket + 1 && got != -1) {{
                __nanosleep(100);
                got = *mine;
            }}
            if (got != -1)
                box = ticket & {MAILBOX_COUNT - 1};
        }}
        __threadfence();
    }}
    __syncwarp();
    return __shfl_sync(0xffffffffu, box, 0);
#else
    return -1;
#endif
""")
def await_share(counter: wp.array(dtype=wp.int32), flag: wp.array(dtype=wp.int32)) -> wp.int32:
    """Wait for a share; return its mailbox, or -1 when all work is done."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncwarp();
    if (threadIdx.x == 0) {
        __threadfence();
        *(volatile int*)(flag.data + box) = 0;
    }
#endif
""")
def empty_mailbox(flag: wp.array(dtype=wp.int32), box: wp.int32): ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    int ticket = 0;
    if (threadIdx.x == 0) {{
        atomicAdd(counter.data + 2, 1);
        ticket = atomicAdd(counter.data, 1);
        while (*(const volatile int*)(flag.data + (ticket & {MAILBOX_COUNT - 1})) != 0)
            __nanosleep(100);
        __threadfence();
    }}
    __syncwarp();
    return __shfl_sync(0xffffffffu, ticket, 0);
#else
    return 0;
#endif
""")
def open_mailbox(counter: wp.array(dtype=wp.int32), flag: wp.array(dtype=wp.int32)) -> wp.int32:
    """Return the next ticket to serve, its mailbox empty."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    __threadfence();
    __syncwarp();
    if (threadIdx.x == 0)
        *(volatile int*)(flag.data + (ticket & {MAILBOX_COUNT - 1})) = ticket + 1;
#endif
""")
def close_mailbox(flag: wp.array(dtype=wp.int32), ticket: wp.int32):
    """Hand over what this warp has put into the mailbox of a ticket."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    int left = 1;
    if (threadIdx.x == 0) {{
        __threadfence();  // a mailbox that this warp has emptied, before the last one fills it with -1
        left = atomicSub(counter.data + 2, 1) - 1;
        __threadfence();
    }}
    __syncwarp();
    if (__shfl_sync(0xffffffffu, left, 0) != 0)
        return;
    for (int i = threadIdx.x; i < {MAILBOX_COUNT // 4}; i += 32)
        ((int4*)flag.data)[i] = make_int4(-1, -1, -1, -1);
#else
    counter.data[2] -= 1;
#endif
""")
def end_unit(counter: wp.array(dtype=wp.int32), flag: wp.array(dtype=wp.int32)):
    """End a unit or a share; the last one sends home all who wait."""
    ...


@wp.func
def part_count(parts_max: wp.int32, count: wp.int32):
    """Return how many units an object pair is at first; more of them cost more, since each starts at the roots."""
    return wp.max(1, wp.int32(wp.float32(parts_max) / wp.sqrt(wp.float32(wp.max(count, 1)))))
