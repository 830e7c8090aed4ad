"""Results of queries on the host."""

from typing import Any

import numpy as np

from warp_abtree.kernels.contact.manifold import POINTS
from warp_abtree.query.request import CapacityError

COUNTERS = ("node_tests", "triangle_tests", "float64_tests", "exact_tests")
# Vectors of a contact.
VECTORS = ("p0", "p1", "normal_a", "normal_b", "normal")
# Rows whose sorting takes longer than packing each into one number, which sorts 20 times as fast.
ROWS_TO_PACK = 1000
POINTS_MAX = int(POINTS)


def sort_rows(rows: np.ndarray) -> np.ndarray:
    """Return rows of three int32 that are not negative, (k, 3), sorted by the first, the second and the third."""
    packs = len(rows) >= ROWS_TO_PACK
    widths = [int(column.max()).bit_length() for column in rows.T] if packs else []
    if not packs or sum(widths) > 63:
        return rows[np.lexsort((rows[:, 2], rows[:, 1], rows[:, 0]))]
    key = rows[:, 0].astype(np.int64)
    for column in (1, 2):
        key <<= widths[column]
        key |= rows[:, column]
    key.sort()
    found = np.empty_like(rows)
    for column in (2, 1):
        np.bitwise_and(key, (1 << widths[column]) - 1, out=found[:, column], casting="unsafe")
        key >>= widths[column]
    found[:, 0] = key
    return found


def contact_dtypes(dtype=np.float64):
    """Return the types of `Result.contacts` and `Result.pair_contacts`, real numbers of a type inside.

    Raises:
        ValueError: The type is neither float32 nor float64.
    """
    try:
        real = np.dtype(dtype)
    except TypeError:
        real = None
    if real not in (np.float32, np.float64):
        raise ValueError(f"contact_dtype {dtype!r} is neither float32 nor float64")
    indices = [("pair", np.int32), ("faces", np.int32, (2,))]
    vectors = [(name, real, (3,)) for name in VECTORS]
    means = [("point", real, (3,)), ("normal", real, (3,)), ("depth", real)]
    return np.dtype([*indices, *vectors, ("coplanar", bool)]), np.dtype([("count", np.int64), *means])


class Result:
    """What a query found, on the host.

    Attributes:
        pairs: Object pairs queried, int32 (p, 2).
        any: Whether each pair intersects, bool (p,).
        count: Intersecting face pairs of each, int64 (p,); None for output "any".
        faces: (pair, face of the pair's first object, face of its second), int32 (k, 3), sorted; None unless output
            is "faces" or "contacts".
        contacts, pair_contacts: Structured arrays (k,) and (p,), see `warp_abtree.query.contacts`; None unless
            output is "contacts".
        apart: Whether each pair is proved farther apart than `within`, bool (p,); None without within.
        points: Contact points of a `ManifoldQuery`: a dictionary of pair, place in `pairs`, int (k,); point and normal,
            float64 (k, 3), and depth, (k,), as `ManifoldQuery.manifolds`; None from other queries.
        node_tests, triangle_tests, float64_tests, exact_tests: Work done for each pair, int64 (p,): pairs of boxes,
            pairs of faces, those of them that float32 left uncertain, and of these those that took exact arithmetic.

    Args:
        query: The `Query` whose launch this is read from. Waits for the device.
        pairs: Those of the launch that there was room for.
        pair_demand: How many there were.
    """

    node_tests: np.ndarray
    triangle_tests: np.ndarray
    float64_tests: np.ndarray
    exact_tests: np.ndarray

    def __init__(self, query, pairs, pair_demand):
        hits, near, p = query.hits, query.near, len(pairs)
        self.pairs = pairs
        self._pair_demand, self._pair_room = pair_demand, len(query.pairs)
        self._hit_demand, self._hit_room = 0, len(hits.face)
        self._uncertain_room = len(hits.uncertain)
        self.any = hits.any_hit.numpy()[:p] != 0
        # Any: who asked for them knows that they are not None.
        self.apart: Any = None if near is None else near.any_hit.numpy()[:p] == 0
        # On the CPU numpy() shares the memory that the next launch writes.
        for name in COUNTERS:
            setattr(self, name, getattr(hits, name).numpy()[:p].copy())
        count: Any = hits.count.numpy()[:p].copy() if query.output != "any" else None
        self.count = count
        self.faces: Any = None
        self.contacts: Any = None
        self.pair_contacts: Any = None
        self.points: Any = None
        if query.output == "faces":
            self._hit_demand = int(count.sum())
            self._read_hits(query)

    def _read_hits(self, query):
        """Read what there is an entry a hit of."""
        faces = query.hits.face.numpy()[: min(self._hit_demand, self._hit_room)].reshape(-1, 3)
        self.faces = sort_rows(faces)

    def check(self):
        """Raise where anything was lost.

        Raises:
            CapacityError: A buffer overflowed; the message names the demand.
        """
        demands = [
            ("pairs", "object pairs of the broad phase", self._pair_demand, self._pair_room),
            ("uncertain", "face pairs that need more than float32", self._uncertain_demand(), self._uncertain_room),
            ("hits", "intersecting face pairs", self._hit_demand, self._hit_room),
        ]
        for name, what, demand, room in demands:
            if demand > room:
                raise CapacityError(
                    f"{demand} {what}, the query has room for {room}: make it with capacity=Buffers({name}={demand})"
                )

    def _uncertain_demand(self) -> int:
        return int(self.float64_tests.sum()) if self._uncertain_room else 0


class ContactResult(Result):
    """What a `ContactQuery` found: faces, contacts and their summaries as `Result` describes them."""

    def _read_hits(self, query):
        rows, pairs = min(self._hit_demand, self._hit_room), len(self.pairs)
        face_type, pair_type = contact_dtypes(query.contact_dtype)
        self.contacts, self.pair_contacts = np.zeros(rows, face_type), np.zeros(pairs, pair_type)
        self.faces = np.empty((0, 3), np.int32)
        self.pair_contacts["count"] = self.count
        with np.errstate(over="ignore"):
            if pairs:
                for name in ("point", "normal", "depth"):
                    self.pair_contacts[name] = getattr(query.pair_contacts, name)[:pairs].numpy()
            if rows:
                self.faces = query.faces[:rows].numpy().copy()
                for name in (*VECTORS, "coplanar"):
                    self.contacts[name] = getattr(query.contacts, name)[:rows].numpy()
        self.contacts["pair"], self.contacts["faces"] = self.faces[:, 0], self.faces[:, 1:]


class ManifoldResult(Result):
    """What a `ManifoldQuery` found: as `Result` of output "count", and the points, unless they stay on the device."""

    def __init__(self, query, pairs, pair_demand, with_points=True):
        self._with_points = with_points
        super().__init__(query, pairs, pair_demand)

    def _read_hits(self, query):
        if not self._with_points:
            return
        count = query.manifolds.count.numpy()[: len(self.pairs)]
        used = np.arange(POINTS_MAX) < count[:, None]
        self.points = {"pair": np.repeat(np.arange(len(self.pairs)), count)}
        for name in ("point", "normal", "depth"):
            self.points[name] = getattr(query.manifolds, name).numpy()[: len(self.pairs)][used]
