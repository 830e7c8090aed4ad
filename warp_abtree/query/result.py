"""Results of queries."""

import csv
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from warp_abtree.checks.atomic_write import atomic_write
from warp_abtree.checks.device_memory import DeviceMemory
from warp_abtree.query.request import CapacityError

COUNTERS = ("node_tests", "triangle_tests", "float64_tests", "exact_tests")
# What a `DistanceQuery` has beside points.
DISTANCES = ("distance", "bracket", "point_faces")
# What a `FirstContactQuery` has.
TIMES = ("time", "clear", "undecided")
# What a result may have for its pairs; None where it was not asked for.
RESULT_ARRAYS = ("pairs", "any", "apart", "faces", "contacts", "pair_contacts", "points", *DISTANCES, *TIMES)
# Vectors of a contact.
VECTORS = ("p0", "p1", "normal_a", "normal_b", "normal")


def contact_dtypes(dtype=np.float64, with_gap=False):
    """Return the types of `Result.contacts` and `Result.pair_contacts`, real numbers of a type inside.

    Raises ValueError for another type than float32 and float64.
    """
    try:
        real = np.dtype(dtype)
    except TypeError:
        real = None
    if real not in (np.float32, np.float64):
        raise ValueError(f"contact_dtype {dtype!r} is neither float32 nor float64")
    return _record_types(real, with_gap)


@cache
def _record_types(real, with_gap):
    indices = [("pair", np.int32), ("faces", np.int32, (2,))]
    vectors: list = [(name, real, (3,)) for name in VECTORS]
    if with_gap:
        vectors.append(("separation", real))
    means = [("point", real, (3,)), ("normal", real, (3,))]
    return np.dtype([*indices, *vectors, ("coplanar", bool)]), np.dtype([("count", np.int64), *means])


class Totals(NamedTuple):
    """What a launch needed of each list, and what became of it."""

    launched: int  # see `LaunchRecord.launched`
    pairs: int
    hits: int
    uncertain: int


@dataclass(eq=False)
class Answers:
    """Arrays of a `Result`. Any: who asked for them knows that they are not None."""

    pairs: Any = None
    any: Any = None
    apart: Any = None
    count: Any = None
    faces: Any = None
    contacts: Any = None
    pair_contacts: Any = None
    points: Any = None
    distance: Any = None
    bracket: Any = None
    point_faces: Any = None
    time: Any = None
    clear: Any = None
    undecided: Any = None
    node_tests: Any = None
    triangle_tests: Any = None
    float64_tests: Any = None
    exact_tests: Any = None


@dataclass(eq=False, kw_only=True)
class Found(Answers):
    """What a launch found: the arrays of a `Result`, which are its own, on the host or on the device."""

    totals: Totals
    gradient: Any = None


class Result(DeviceMemory, Answers):
    """What a query found: NumPy arrays, or Warp arrays of the query's device where `device=True` was asked.

    Its length is the number of pairs; it has no truth value, `bool(result)` raises TypeError.

    Whatever the query does later, the arrays stay as they are. Those on the host are read in one piece, counters of
    tests among them, from a GPU into page-locked memory that is used again when no array of the result is left.

    On the device types are those that give the same NumPy array by `numpy()`: bool for any and apart, int64 for count
    and tests, vec2i for pairs and point_faces, vec3i for faces, vec2d and matrices of 2 rows for bracket, points and
    gradient of distances. Contacts and summaries are dictionaries of one array a field, points of manifolds one of
    count, point, normal and depth as `ManifoldQuery.manifolds`.

    Attributes:
        pairs: Object pairs queried, int32 (p, 2).
        any: Whether each pair intersects, bool (p,).
        count: Intersecting face pairs of each, with a gap those nearer than that too, except from a `ManifoldQuery`,
            int64 (p,); None for "any".
        faces: (pair, face of the pair's first object, face of its second), int32 (k, 3), sorted; None unless output
            is "faces" or "contacts".
        contacts, pair_contacts: Structured arrays (k,) and (p,), see `query.stages.contacts`; None unless
            output is "contacts".
        apart: Whether each pair is proved farther apart than `within`, bool (p,); None without within.
        points: Contact points of a `ManifoldQuery`: a dictionary of pair, place in `pairs`, int (k,); point and normal,
            float64 (k, 3), and depth, (k,), as `ManifoldQuery.manifolds`. Of a `DistanceQuery` the nearest point of
            each object [world units], float64 (p, 2, 3). None from other queries.
        distance, bracket, point_faces: Least distance of each pair [world units], float64 (p,), proven lower and upper
            bound of it, (p, 2), and the faces that the nearest points lie on, int32 (p, 2), see
            `query.stages.distance`; None unless output is "distance".
        time, clear, undecided: Time of first contact of each pair, float64 (p,) in [0, 1], never late and 1 where it is
            proved clear of contact, bool (p,); where undecided, bool (p,), contact may be as much later as there is
            time. See `query.stages.motion`; None from other queries.
        node_tests, triangle_tests, float64_tests, exact_tests: Work done for each pair, int64 (p,): pairs of boxes,
            pairs of faces, those of them that float32 left uncertain, and of these those that took exact arithmetic. On
            the CPU a pair may take fewer of them after others of the same first object.

    Args:
        found: What was read.
        room: What there was room for, (pairs, hits, uncertain face pairs).
        output: That of the query.
        names: Of the objects, or none.
    """

    def __init__(self, found: Found, room: tuple, output: str, names=()):
        held = dict(vars(found))
        self._totals, self._gradient = held.pop("totals"), held.pop("gradient")
        vars(self).update(held)
        if output == "any":
            self.count = None
        self._room, self._names = room, names

    def __repr__(self):
        held = [name for name in (*RESULT_ARRAYS[1:], "count") if getattr(self, name) is not None]
        held += ["gradient"] if self._gradient is not None else []
        return f"Result(pairs={len(self.pairs)}, {', '.join(held)})"

    @property
    def gradient(self) -> Any:
        """Derivatives of the distance, float64 (p, 2, 6), None unless output is "distance". May wait for the device.

        With respect to translation and rotation vector, about its origin, of the first object and of the second, see
        `query.stages.distance`. Of a result on the host it stays on a GPU until it is first read.
        """
        if self._gradient is not None and isinstance(self.pairs, np.ndarray):
            self._gradient = _to_host(self._gradient)
        return self._gradient

    def __len__(self):
        """Return the number of pairs."""
        return len(self.pairs)

    def __bool__(self):
        """Refuse a truth value: it would say nothing of what was found."""
        raise TypeError("a Result is neither true nor false; ask result.any.any(), result.clear.all() or len(result)")

    def __reduce_ex__(self, protocol):
        """Pickle or copy what lies on the host; refuse arrays on the device."""
        on_host = isinstance(self.pairs, np.ndarray)
        if on_host:
            _ = self.gradient
        return object.__reduce_ex__(self, protocol) if on_host else super().__reduce_ex__(protocol)

    def __getstate__(self):
        """Return what a pickle holds: names of the objects of its pairs alone."""
        return {**vars(self), "_names": {i: self._name(i) for i in np.unique(self.pairs).tolist()}}

    def check(self):
        """Raise where anything was lost.

        Raises:
            CapacityError: A buffer overflowed; the message names the demand.
        """
        totals, (pairs, hits, uncertain) = self._totals, self._room
        for name, what, demand, room in (
            ("pairs", "object pairs of the broad phase", totals.pairs, pairs),
            ("uncertain", "face pairs that need more than float32", totals.uncertain, uncertain),
            ("hits", "face pairs or witnesses of contact points", totals.hits, hits),
        ):
            if demand > room:
                raise CapacityError(
                    f"{demand} {what}, the query has room for {room}: call run(), which makes room, or make it with "
                    f"capacity=Buffers({name}={demand})"
                )

    def rows(self) -> list[dict[str, Any]]:
        """Return a dict a pair: names of its objects, "first" and "second", and its answers. Waits for the device.

        Answers are Python's numbers and lists, by the names of the result's arrays and of `pair_contacts`; gradients,
        and what has an entry a face pair or contact point, are left out.
        """
        columns = {name: values.tolist() for name, values in self._pair_arrays()}
        return [dict(zip(columns, row)) for row in zip(*columns.values())]

    def _pair_arrays(self):
        """Yield names and arrays of what has an entry a pair, on the host."""
        for name, objects in zip(("first", "second"), _to_host(self.pairs).T):
            yield name, np.array([self._name(i) for i in objects.tolist()], object)
        for name in ("any", "count", "apart", *DISTANCES, "points", *TIMES):
            values = getattr(self, name)
            if values is not None and not isinstance(values, dict):  # of contact points, which no pair has one of
                yield name, _to_host(values)
        summary = self.pair_contacts
        if summary is not None:
            names = summary if isinstance(summary, dict) else summary.dtype.names
            yield from ((name, _to_host(summary[name])) for name in names if name != "count")

    def _name(self, i: int) -> str:
        try:
            return self._names[i]
        except LookupError:
            return f"object {i}"

    def to_csv(self, path):
        """Write `rows` as a table: vectors in columns of their own, as point_x, bracket_0. Waits for the device.

        Raises:
            OSError: The file cannot be written; one that stood there stays.
        """
        columns = {}
        for name, values in self._pair_arrays():
            for place in np.ndindex(values.shape[1:]):
                ends = ("xyz"[k] if size == 3 else str(k) for k, size in zip(place, values.shape[1:]))
                columns["_".join((name, *ends))] = values[:, *place].tolist()
        with atomic_write(path, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(columns)
            writer.writerows(zip(*columns.values()))


def _to_host(values) -> np.ndarray:
    return values if isinstance(values, np.ndarray) else values.numpy()
