"""Checks of what a caller hands in: one clear error that names what and where, before anything is changed."""

import os
from textwrap import shorten

import numpy as np
import warp as wp

from warp_abtree.checks.upload import view_memory

SHOWN_LENGTH = 100  # of what was given, in a message

# Process in which the library first looked for a device, and so started Warp.
_started_in: int | None = None


def check_device(device, what: str | None = None):
    """Refuse a device that cannot be used in this process, or where a graph is being captured.

    Raises RuntimeError for a GPU in a process forked from one that had started Warp; and while a graph is captured, if
    `what` is a call that no graph can capture, as it waits for the device or allocates; None is a launch.
    """
    global _started_in
    if _started_in is None:
        _started_in = os.getpid()
    if device.is_cuda and os.getpid() != _started_in:
        raise RuntimeError(
            f"{device} cannot be used in a process forked after Warp started: CUDA does not survive a fork; "
            "start workers by spawn, as multiprocessing.get_context('spawn') does"
        )
    if what is not None and device.is_capturing:
        raise RuntimeError(f"{what} cannot be captured in a graph; call it before the capture begins")


def wrap_array(values, what="array"):
    """Return an array of any framework as a Warp array on the same memory.

    Args:
        values: Warp, PyTorch, JAX, CuPy or NumPy array, or anything else that speaks DLPack or has
            `__cuda_array_interface__`. A tensor that requires gradients is taken without them.

    Raises:
        ValueError: It is none, or its memory cannot be shared.
    """
    if isinstance(values, wp.array):
        return values
    try:
        if isinstance(values, np.ndarray):
            # In place of DLPack, which NumPy refuses for arrays that are read-only.
            return wp.array(values, dtype=wp.dtype_from_numpy(values.dtype), device="cpu", copy=False)
        if getattr(values, "requires_grad", False):
            values = values.detach()
        if hasattr(values, "__dlpack__"):
            return wp.from_dlpack(values)
        if hasattr(values, "__cuda_array_interface__"):
            return _wrap_cuda_array(values)
    except (RuntimeError, TypeError, BufferError, ValueError, KeyError) as error:
        raise ValueError(f"{what}: its memory cannot be shared ({first_line(error)})") from None
    raise ValueError(f"{what}: a {type(values).__name__} is no array that can share its memory")


def _wrap_cuda_array(values):
    """Wrap what has `__cuda_array_interface__` but no DLPack, such as an array of Numba, on the current GPU."""
    described, device = values.__cuda_array_interface__, wp.get_cuda_device()
    if described.get("stream") is not None:
        wp.synchronize_device(device)
    dtype, address = wp.dtype_from_numpy(np.dtype(described["typestr"])), described["data"][0]
    return view_memory(address, dtype, described["shape"], device, values, described.get("strides"))


def is_device_array(values) -> bool:
    """Return whether an array of some framework lies on a GPU."""
    if isinstance(values, wp.array):
        return values.device is not None and values.device.is_cuda
    if isinstance(values, np.ndarray):
        return False
    if hasattr(values, "__cuda_array_interface__"):  # of a tensor on the CPU that raises AttributeError
        return True
    return hasattr(values, "__dlpack_device__") and int(values.__dlpack_device__()[0]) != 1  # kDLCPU


def to_numpy(values, what: str) -> np.ndarray:
    """Return an array of any framework, or a sequence, as a NumPy array of real numbers; raise ValueError for another.

    What lies on a GPU is copied. (synchronization point)
    """
    try:
        if isinstance(values, list | tuple | np.ndarray):
            pass
        elif isinstance(values, wp.array) or is_device_array(values):
            values = wrap_array(values, what).numpy()
        elif hasattr(values, "numpy"):
            values = (values.detach() if getattr(values, "requires_grad", False) else values).numpy()
        elif hasattr(values, "__dlpack__"):
            values = np.from_dlpack(values)
        array = np.asarray(values)
    except (ValueError, TypeError, BufferError, RuntimeError) as error:
        raise ValueError(f"{what}: no array of numbers ({first_line(error)})") from None
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{what}: type {array.dtype} holds no real numbers")
    return array


def first_line(error) -> str:
    """Return the first line of an error's text, or its type where it has none."""
    return next(iter(str(error).splitlines()), "") or type(error).__name__


def whole_number(value, what: str, low: int, high: int) -> int:
    """Return a whole number from low to high as int; raise ValueError for another value."""
    number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    if not number or value != value or value in (float("inf"), float("-inf")) or int(value) != value:
        raise ValueError(f"{what} {value!r} is not a whole number")
    if not low <= value <= high:
        raise ValueError(f"{what} {value} is outside {low} .. {high}")
    return int(value)


def finite_array(values, what: str, shape: tuple) -> np.ndarray:
    """Return finite numbers of a shape as float64; raise ValueError for another shape or number."""
    array = to_numpy(values, what).astype(np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        wanted = "a finite number" if shape == () else f"{' by '.join(map(str, shape))} finite numbers"
        raise ValueError(f"{what}: {shorten(repr(values), SHOWN_LENGTH)} is not {wanted}")
    return array


def positive(value, what: str) -> float:
    """Return a finite number above 0 as float; raise ValueError for another value."""
    number = float(finite_array(value, what, ()))
    if not number > 0:
        raise ValueError(f"{what} {value!r} is not above 0")
    return number


def flag(value, what: str) -> bool:
    """Return a bool as such; raise ValueError for another value."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{what} {value!r} is neither True nor False")
    return bool(value)


def broadcast_rows(values, what: str, shape: tuple, is_finite=True, unread=()) -> np.ndarray:
    """Return finite numbers, or any if told, as float64 broadcast to a shape, a copy; raise ValueError for others.

    Rows of `unread` are 0, whatever was given.
    """
    values = to_numpy(values, what).astype(np.float64)
    try:
        rows = np.broadcast_to(values, shape).copy()
    except ValueError:
        raise ValueError(f"{what}: shape {values.shape} does not stretch to {shape}") from None
    rows[list(unread)] = 0.0
    if is_finite and not np.isfinite(rows).all():
        raise ValueError(f"{what}: a number is not finite")
    return rows
