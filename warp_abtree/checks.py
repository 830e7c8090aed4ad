"""Checks of what a caller hands in: one clear error that names what and where, before anything is changed."""

import numpy as np


def to_numpy(values, what: str) -> np.ndarray:
    """Return an array of any framework, or a sequence, as a NumPy array of real numbers.

    Raises:
        ValueError: It is no array of numbers.
    """
    if hasattr(values, "numpy") and not isinstance(values, np.ndarray):
        values = values.numpy()
    try:
        array = np.asarray(values)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{what}: no array of numbers ({error})") from None
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{what}: type {array.dtype} holds no real numbers")
    return array


def first_line(error) -> str:
    """Return the first line of an error's text, or its type where it has none."""
    return next(iter(str(error).splitlines()), "") or type(error).__name__


def whole_number(value, what: str, low: int, high: int) -> int:
    """Return a whole number from low to high as int.

    Raises:
        ValueError: It is none, or outside.
    """
    number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    if not number or value != value or value in (float("inf"), float("-inf")) or int(value) != value:
        raise ValueError(f"{what} {value!r} is not a whole number")
    if not low <= value <= high:
        raise ValueError(f"{what} {value} is outside {low} .. {high}")
    return int(value)
