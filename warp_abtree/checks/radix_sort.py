"""Radix sort of numbers on a device, with the errors that Warp's reports nowhere but in its log."""

import ctypes
from functools import cache
from pathlib import Path

import warp as wp

SORT_ATTEMPTS = 4  # on a busy GPU one of some thousand sorts fails


def radix_sort(keys: wp.array, values: wp.array, count: int, bits: int):
    """Sort the first numbers of an array by so many low bits, and values with them, in place. Launches only.

    `keys` and `values` have 2 count entries or more; what lies behind the first count is scratch. Raises RuntimeError
    where Warp did not sort them several times.
    """
    for _ in range(SORT_ATTEMPTS):
        ctypes.memset(_error_address(), 0, 1)
        with wp.ScopedDevice(keys.device):
            wp.utils.radix_sort_pairs(keys, values, count, end_bit=bits)
        error = ctypes.string_at(_error_address()).decode(errors="replace")
        if not error:
            return
    raise RuntimeError(f"{count} numbers on {keys.device} were not sorted: {error}")


@cache
def _error_address() -> int:
    """Return where Warp's library keeps its last error, a string that no later success clears."""
    library = ctypes.CDLL(str(next(Path(wp.__file__).parent.glob("bin/*warp.*"))))
    return ctypes.CFUNCTYPE(ctypes.c_void_p)(("wp_get_error_string", library))()
