"""Memory that results pass through: device memory to pack them in, and the host's that they are brought to."""

import os

import numpy as np
import warp as wp

from warp_abtree.checks.upload import view_memory

# Blocks that a reader lends at a time: the result of a loop's last round lives until the next one takes its name.
LENT_MAX = 2
# Bytes that a pool keeps page-locked, a fraction of the machine's memory at most, and the least block.
PINNED_MAX, PINNED_FRACTION, BLOCK_LEAST = 2**32, 1 / 8, 2**16
# What is larger is page-locked from the second time on: for a single result that takes longer than it saves.
PINNED_AT_ONCE = 2**20
# Bytes of device memory in which rows are packed, as often as it takes.
PACKED_AT_ONCE = 2**26


def first_rows(array: wp.array, count: int) -> wp.array:
    """Return the first rows of an array, which Warp does not slice to none."""
    return array[:count] if count else wp.empty((0, *array.shape[1:]), dtype=array.dtype, device=array.device)


def _host_memory() -> int:
    """Return the bytes of the machine's memory, or a guess."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):  # not on every system
        return 2**33


class _Block:
    """Host memory with views of it that are made once."""

    def __init__(self, size: int, pinned: bool):
        self.words = wp.empty((size + 7) // 8, dtype=wp.int64, device="cpu", pinned=pinned)
        self._views = {wp.int64: self.words}

    def __len__(self):
        return 8 * len(self.words)

    def view(self, dtype) -> wp.array:
        """Return as many entries of a type as there is room for."""
        if dtype not in self._views:
            count = len(self) // wp.types.type_size_in_bytes(dtype)
            self._views[dtype] = view_memory(self.words.ptr, dtype, (count,), owner=self.words)
        return self._views[dtype]


class _Lease:
    """Part of a block as NumPy's array interface; when no array is on it any more, the block goes back."""

    def __init__(self, pool: "HostPool", block: _Block, size: int):
        self._pool, self.block = pool, block
        data = (block.words.ptr, False)
        self.__array_interface__ = {"shape": (size,), "typestr": "|u1", "data": data, "version": 3}

    def __del__(self):
        self._pool.take_back(self.block)


def _start_of(memory: np.ndarray, dtype, count: int) -> wp.array:
    """Return a Warp array on the start of host memory, as `HostPool` lends it or a part of that."""
    if isinstance(memory.base, _Lease):
        return memory.base.block.view(dtype)
    return view_memory(memory.ctypes.data, dtype, (count,))


class HostPool:
    """Blocks of host memory, page-locked for a GPU, that a device copies into; used again without arrays on them."""

    def __init__(self, device):
        self._pinned = device.is_cuda
        self._free: list[_Block] = []
        self._made = 0  # blocks, lent ones among them
        self._block_most = min(PINNED_MAX, int(PINNED_FRACTION * _host_memory())) // LENT_MAX
        self._is_used_again = False

    def take(self, size: int) -> np.ndarray:
        """Return memory, uint8 (size,): of a block, or of its own where more than two are in use or too large."""
        if size == 0:
            return np.empty(0, np.uint8)
        fitting = [block for block in self._free if len(block) >= size]
        if fitting:
            block = min(fitting, key=len)
            self._free.remove(block)
            return np.asarray(_Lease(self, block, size))
        lent = self._made - len(self._free)
        first = size > PINNED_AT_ONCE and not self._is_used_again
        self._is_used_again = self._is_used_again or first
        if first or size > self._block_most or lent >= LENT_MAX:
            return np.empty(size, np.uint8)
        if self._made >= LENT_MAX:
            self._free.pop()
            self._made -= 1
        # A quarter more than is asked, so that results that differ a little find room.
        block = _Block(max(BLOCK_LEAST, min(size + size // 4, self._block_most)), self._pinned)
        self._made += 1
        return np.asarray(_Lease(self, block, size))

    def take_back(self, block: _Block):
        """Let a block be lent again; from any thread."""
        self._free.append(block)


class Staging:
    """Device memory that results are packed in, which grows, and the host memory that they are brought to.

    Attributes:
        words, rows: Packed entries of pairs, and sorted hits, device int64 and vec3i.
        pair_pool, row_pool: `HostPool` for whatever has an entry a pair, and for the rest.
    """

    def __init__(self, device):
        self.device = device
        self.pair_pool, self.row_pool = HostPool(device), HostPool(device)
        self.no_flags = wp.empty(0, dtype=wp.int32, device=device)
        self.words = self._packed = self.rows = self.order = self.key = self.start = self.no_flags

    def room(self, name: str, count: int, dtype) -> wp.array:
        """Return the array of a name, at least so long."""
        array = getattr(self, name)
        if len(array) < count or array is self.no_flags:
            array = wp.empty(count + count // 4, dtype=dtype, device=self.device)
            setattr(self, name, array)
        return array

    def send_words(self, words: wp.array, count: int) -> np.ndarray:
        """Bring words over, int64 (count,). Does not wait."""
        memory = self.pair_pool.take(8 * count)
        wp.copy(_start_of(memory, wp.int64, count), words, count=count)
        return memory.view(np.int64)

    def fetch_words(self, words: wp.array, count: int) -> np.ndarray:
        """Bring words over, int64 (count,). Waits for the device."""
        memory = self.send_words(words, count)
        self.wait()
        return memory

    def send_rows(self, memory: np.ndarray, rows: wp.array, count: int):
        """Bring rows over as they are, to the start of host memory; returns what is behind them. Does not wait."""
        size = 12 * count
        if count:
            wp.copy(_start_of(memory, wp.vec3i, count), rows, count=count)
        return memory[:size].view(np.int32).reshape(-1, 3), memory[size:]

    def send_records(self, memory: np.ndarray, dtype: np.dtype, count: int, pack):
        """Bring records over, to the start of host memory; returns what is behind them. Does not wait.

        `pack(first, count, bytes)` launches what writes some of the records to device memory.
        """
        size = dtype.itemsize
        at_once = max(1, min(count, PACKED_AT_ONCE // size))
        packed = self.room("_packed", at_once * size, wp.uint8)
        for first in range(0, count, at_once):
            some = min(at_once, count - first)
            pack(first, some, packed)
            target = view_memory(memory.ctypes.data + first * size, wp.uint8, (some * size,))
            wp.copy(target, packed, count=some * size)
        return memory[: count * size].view(dtype), memory[count * size :]

    def wait(self):
        """Wait for all copies."""
        if self.device.is_cuda:
            wp.synchronize_stream(self.device.stream)
