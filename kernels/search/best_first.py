"""Best-first branch and bound over pairs of nodes, by a warp or a thread: one loop, four functions of a policy.

Node pairs wait on a stack, each with a bound, the best that an item emits on top; leaf pairs and open pairs wait in
lists until there is one for each lane, or until nothing else is left:

    refresh     what is known by now, before every turn
    expand      node pairs, from the top of the stack: emits node pairs and leaf pairs
    leaf        leaf pairs, by tests that drop most: adds open pairs
    open        open pairs, by dear tests

Nothing is dropped that may still be the best, so what is found does not depend on the order.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import warp as wp

from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.lanes import next_place, warp_any, warp_lane, warp_size, warp_sync
from warp_abtree.kernels.search.item import FACES, NODES, Emitted
from warp_abtree.kernels.search.load_balance import (
    DEPTH_FIRST_ROOM,
    count_idle,
    count_to_pop,
    donate_items,
    load_tickets,
)
from warp_abtree.kernels.search.nearest_stack import SearchMemory, put_nearer_last, put_nearest_last
from warp_abtree.kernels.search.warp_stack import read_item

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class SearchLists:
    """Lists of a best-first search, and how many of each go together."""

    items: wp.uint64  # their address
    room: wp.int32  # node pairs that the stack takes
    head: wp.int32  # node pairs that were taken from the stack's other end
    end: wp.int32  # node pairs, with these
    waiting: wp.int32  # leaf pairs
    opened: wp.int32  # open pairs
    at_once: wp.int32  # node pairs that are expanded together at most
    leaf_ready: wp.int32  # leaf pairs that are tested before nothing else is left
    open_ready: wp.int32  # open pairs that are tested before anything else


@wp.struct
class Entry:
    """What a lane has taken from a list."""

    item: wp.int64  # a pair of nodes or of faces
    bound: wp.float32  # of it
    slot: wp.int32  # of its object pair, where several are searched together
    at: wp.int32  # its place in memory
    count: wp.int32  # entries that all lanes have taken
    live: bool  # False in a lane that has none, and looks at another's


@wp.func
def start_lists(items: wp.uint64, room: wp.int32):
    """Return empty lists at an address."""
    lists = SearchLists()
    lists.items = items
    lists.room = room
    lists.at_once = warp_size()
    lists.leaf_ready = warp_size()
    lists.open_ready = warp_size()
    return lists


class BestFirstPolicy(NamedTuple):
    """What a best-first search asks.

    Attributes:
        memory: Where its lists are.
        given: Struct of what it reads, and what it shares with other warps.
        state: Struct of what a lane knows.
        refresh: (given, state, lists), None where the state has it all.
        expand: (trees, given, state, entry) -> `Emitted`.
        leaf, open: (trees, given, state, lists, entry).
        turns: Whether a turn tests leaf pairs or open pairs, both by `leaf`, which asks `in_open` of an entry; else
            first the ones and then the others.
        donates: Node pairs that are given away at least, by `work` of what is given; 0 where none are.
        shift: log2 of how many an expansion emits.
    """

    memory: SearchMemory
    given: Any
    state: Any
    refresh: Callable | None
    expand: Callable
    leaf: Callable
    open: Callable
    turns: bool = False
    donates: int = 0
    shift: int = 2


@wp.func
def place_of_lane(count: wp.int32):
    """Return this lane's place among so many entries; lanes without one look at the last."""
    return wp.min(warp_lane(), count - 1)


@functools.cache
def list_functions(memory: SearchMemory, shift: int):
    """Return the functions that take an entry a lane, and that append what an item emits, two or four."""
    read_bound, read_slot, write_entry = memory.read_bound, memory.read_slot, memory.write_entry
    leaf_start, mask = memory.stack_length, memory.mask

    @wp.func
    def take_entry(lists: SearchLists, at: wp.int32, count: wp.int32):
        """Return the entry at a place, of so many that all lanes take."""
        entry = Entry()
        entry.item = read_item(lists.items, at)
        entry.bound = read_bound(lists.items, at)
        entry.slot = read_slot(lists.items, at)
        entry.at = at
        entry.count = count
        entry.live = warp_lane() < count
        warp_sync()
        return entry

    @wp.func
    def push_emitted(lists: wp.ref[SearchLists], emitted: Emitted, slot: wp.int32):
        """Append node pairs to the stack, the best of each lane last, and leaf pairs to theirs."""
        kinds, items, bounds = emitted.kinds, emitted.items, emitted.bounds
        if wp.static(shift == 1):
            put_nearer_last(kinds, items, bounds)
        else:
            put_nearest_last(kinds, items, bounds)
        for k in range(wp.static(1 << shift)):
            node, face = kinds[k] == NODES, kinds[k] == FACES
            place = next_place(lists.end, node) & wp.static(mask)
            leaf_place = wp.static(leaf_start) + next_place(lists.waiting, face)
            if node or face:
                write_entry(lists.items, wp.where(node, place, leaf_place), items[k], bounds[k], slot)
        warp_sync()

    return take_entry, push_emitted


@functools.cache
def best_first(policy: BestFirstPolicy):
    """Return the function that searches what lies on the stack, less what is donated."""
    given_type, state_type = policy.given, policy.state
    refresh, expand, leaf, open_pairs = policy.refresh, policy.expand, policy.leaf, policy.open
    turns, donates, shift = policy.turns, policy.donates, policy.shift
    leaf_start, open_start, mask = policy.memory.stack_length, policy.memory.open_start, policy.memory.mask
    take_entry, push_emitted = list_functions(policy.memory, shift)

    @wp.func
    def search_best_first(trees: Trees, given: given_type, state: wp.ref[state_type], lists: wp.ref[SearchLists]):
        while lists.end > lists.head or lists.waiting > 0 or lists.opened > 0:
            tickets = wp.int64(0)
            if wp.static(donates > 0):
                tickets = load_tickets(given.work.counter)
            if wp.static(refresh is not None):
                refresh(given, state, lists)
            size = lists.end - lists.head
            if size > 0 and lists.waiting < warp_size() and lists.opened < lists.open_ready:
                popped = count_to_pop(lists.room - DEPTH_FIRST_ROOM - size, wp.static(shift), size)
                popped = wp.min(popped, lists.at_once)
                lists.end -= popped
                entry = take_entry(lists, (lists.end + place_of_lane(popped)) & wp.static(mask), popped)
                emitted = expand(trees, given, state, entry)
                if warp_any(emitted.tests > 0):
                    push_emitted(lists, emitted, entry.slot)
            if wp.static(turns):
                in_open = lists.opened >= lists.open_ready or lists.waiting == 0
                most = wp.where(in_open, lists.opened, lists.waiting)
                if most >= warp_size() or (lists.end == lists.head and most > 0):
                    popped = wp.min(most, warp_size())
                    lists.opened -= wp.where(in_open, popped, 0)
                    lists.waiting -= wp.where(in_open, 0, popped)
                    at = wp.where(in_open, open_start + lists.opened, leaf_start + lists.waiting)
                    entry = take_entry(lists, at + place_of_lane(popped), popped)
                    leaf(trees, given, state, lists, entry)
                    warp_sync()
            else:
                if lists.waiting >= lists.leaf_ready or (lists.waiting > 0 and lists.end == lists.head):
                    popped = wp.min(lists.waiting, warp_size())
                    lists.waiting -= popped
                    entry = take_entry(lists, leaf_start + lists.waiting + place_of_lane(popped), popped)
                    leaf(trees, given, state, lists, entry)
                    warp_sync()
                nothing_else = lists.end == lists.head and lists.waiting == 0
                if lists.opened >= lists.open_ready or (lists.opened > 0 and nothing_else):
                    popped = wp.min(lists.opened, warp_size())
                    lists.opened -= popped
                    entry = take_entry(lists, open_start + lists.opened + place_of_lane(popped), popped)
                    open_pairs(trees, given, state, lists, entry)
            if wp.static(donates > 0):
                idle = count_idle(tickets)
                if idle > 0 and lists.end - lists.head >= wp.static(2 * donates):
                    lists.head = donate_items(
                        wp.static(donates), state.pair, idle, lists.items, lists.head, lists.end, given.work
                    )

    return search_best_first
