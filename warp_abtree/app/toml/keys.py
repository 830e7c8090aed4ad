"""Keys of scene files: what a value may be, and tables that name the file and the key where something is wrong."""

import math
from typing import NoReturn

import numpy as np

_MISSING = object()


class SceneError(ValueError):
    """What is wrong with a scene file, with the file and the key, in one line."""


# Values: each check returns the value as it is used, or raises ValueError with what it should be.


def number(low=-math.inf, high=math.inf, open_low=False):
    def check(value):
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ValueError("not a finite number")
        if not low <= value <= high or (open_low and value == low):
            raise ValueError(f"{value} is not {'above' if open_low else 'from'} {low:g} to {high:g}")
        return float(value)

    return check


def whole(low, high=2**31 - 1):
    def check(value):
        if isinstance(value, bool) or not isinstance(value, int):
            raise ValueError("not a whole number")
        if not low <= value <= high:
            raise ValueError(f"{value} is outside {low} .. {high}")
        return value

    return check


def object_count(value):
    """Return a number of objects that was asked for beside the file, or None.

    Raises:
        ValueError: It is no whole number from 1.
    """
    value = int(value) if isinstance(value, np.integer) else value
    try:
        return None if value is None else whole(1)(value)
    except ValueError as error:
        raise ValueError(f"objects {value!r}: {error}") from None


def vector(length, check=None):
    check = check or number()

    def check_vector(value):
        if not isinstance(value, list) or len(value) != length:
            raise ValueError(f"not a list of {length} numbers")
        return [check(entry) for entry in value]

    return check_vector


def direction(value):
    value = np.array(vector(3)(value))
    if not value.any():
        raise ValueError("a direction of no length")
    value /= np.abs(value).max()  # no square over- or underflows
    return value / np.linalg.norm(value)


def kind(wanted, name):
    def check(value):
        if not isinstance(value, wanted):
            raise ValueError(f"not {name}")
        return value

    return check


text, truth, table = kind(str, "a text"), kind(bool, "true or false"), kind(dict, "a table")


def one_or_list(check):
    def check_list(value):
        if value == []:
            raise ValueError("an empty list")
        return [check(entry) for entry in (value if isinstance(value, list) else [value])]

    return check_list


def choice(*names):
    def check(value):
        if value not in names:
            raise ValueError(f"{value!r} is none of {', '.join(names)}")
        return value

    return check


def lod(value):
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError('not a LOD: a part of the faces such as 0.25, a whole number, "finest" or "coarsest"')
    return value


LENGTH, PART, SECTIONS = number(0.0, open_low=True), number(0.0, 1.0, open_low=True), whole(3, 10_000)
ORIGIN = [0.0, 0.0, 0.0]


class Keys:
    """A table whose keys are taken one by one; what is left over is refused."""

    def __init__(self, path, where, values):
        self.path, self.where = path, where
        if not isinstance(values, dict):
            raise SceneError(f"{path}: {where}: not a table")
        self.values = dict(values)

    def at(self, key):
        return ".".join(part for part in (self.where, key) if part) or "the file"

    def fail(self, key, message) -> NoReturn:
        """Raise SceneError about a key, or about the table itself where key is None."""
        raise SceneError(f"{self.path}: {self.at(key)}: {message}") from None

    def take(self, key, check, default=_MISSING):
        if key not in self.values:
            if default is _MISSING:
                self.fail(None, f"the key {key!r} is missing")
            return default
        try:
            return check(self.values.pop(key))
        except (ValueError, OverflowError) as error:
            self.fail(key, error)

    def table(self, key):
        """Return the table under a key, or None."""
        return Keys(self.path, self.at(key), self.values.pop(key)) if key in self.values else None

    def tables(self, key):
        rows = self.values.pop(key, [])
        if not isinstance(rows, list):
            self.fail(key, f"not a list of tables; write [[{key}]]")
        return [Keys(self.path, f"{self.at(key)}[{i}]", row) for i, row in enumerate(rows)]

    def end(self):
        if self.values:
            self.fail(sorted(self.values)[0], "unknown key")
