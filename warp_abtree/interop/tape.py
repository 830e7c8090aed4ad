"""Distances of object pairs as a differentiable function of all poses, for `wp.Tape`."""

from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import check_device, wrap_array
from warp_abtree.checks.upload import struct_of
from warp_abtree.kernels.io.pose_gradients import ObjectPairs, gradient_adder
from warp_abtree.query.stages.distance import DistanceQuery
from warp_abtree.query.staging import first_rows
from warp_abtree.state.poses import ANY_NORM, IDENTITY_POSE, place_rows, view_rows

# Of each query the pairs that it was given, and where each object stands in them.
_pairs_of: WeakKeyDictionary = WeakKeyDictionary()


def pose_rows(poses, query: DistanceQuery) -> wp.array:
    """Return poses of all objects as rows of 7 or 16 numbers on the query's device, without a copy.

    Raises ValueError for another type, shape, number or device, or memory with gaps.
    """
    array = wrap_array(poses, "poses")
    if array.device != query.device:
        raise ValueError(f"poses: on {array.device}, the query is on {query.device}")
    rows, count = view_rows(array), len(query.batch.objects.state)
    if rows is None or not array.is_contiguous:
        kind = getattr(array.dtype, "__name__", array.dtype)
        raise ValueError(f"poses: shape {array.shape} of {kind} is no contiguous (n, 7) or (n, 4, 4) of floats")
    if len(rows) != count:
        raise ValueError(f"poses: {len(rows)} given for {count} objects")
    return rows


class PosedDistances:
    """Distances of a query's pairs at poses of all objects, which stay there, and what the gradients need.

    Waits for the device. Raises as `pair_distance` of `warp_abtree.interop.torch`; no object has moved then. Rows of
    poses are those of `pose_rows`, and have to stay; quaternions may have any norm but 0. On the device are `distance`,
    float64 (p,), and `gradient`, as `Result.gradient`.
    """

    def __init__(self, query: DistanceQuery, rows: wp.array):
        if query.batch.removed:  # whose poses are not read
            rows = wp.clone(rows, requires_grad=False)
            for i in query.batch.removed:
                rows[i : i + 1].assign(np.eye(4).reshape(1, 16) if rows.shape[1] == 16 else [IDENTITY_POSE])
        place_rows(rows, query.batch.objects.pool, ANY_NORM)
        query.grow()
        count, found = len(query.given), query.distances
        self.rows, self._pairs = rows, find_object_pairs(query)
        self.distance, self.gradient = (wp.clone(first_rows(a, count)) for a in (found.distance, found.gradient))

    def add_gradient(self, weight: wp.array, rows: wp.array):
        """Add the gradient of a loss by the poses to rows like those given; weight is the loss's by the distances.

        Sums are taken in float64 and in the order of the pairs. Launches only.
        """
        kernel = gradient_adder(rows.dtype, rows.shape[1])
        inputs = [self._pairs, weight, self.gradient, self.rows, rows]
        wp.launch(kernel, len(rows), inputs, device=rows.device, record_tape=False)


def check_query(query: Any):
    """Raise where a query cannot give `PosedDistances`, as `pair_distance` of `warp_abtree.interop.torch`."""
    if not isinstance(query, DistanceQuery):
        raise TypeError(f"query: a DistanceQuery is expected, not a {type(query).__name__}")
    check_device(query.device, "pair_distance (PoseInput and DistanceQuery.launch can)")
    query.check_scene()
    if query.given is None:
        raise ValueError("query: its pairs come from the broad phase; make it with pairs, such as scene.broad_phase()")


def find_object_pairs(query: DistanceQuery) -> ObjectPairs:
    """Return the pairs that each object of a query is in, made anew where it was given others."""
    given, found = _pairs_of.get(query, (None, None))
    if given is not query.given:
        objects = query.given.ravel()
        entry = np.argsort(objects, kind="stable")
        start = np.searchsorted(objects[entry], np.arange(len(query.batch.objects.state) + 1))
        found = struct_of(ObjectPairs, query.device, entry=entry, start=start)
        _pairs_of[query] = query.given, found
    return found


def record_pair_distance(tape: wp.Tape, query: DistanceQuery, poses: wp.array) -> wp.array:
    """Place all objects, launch a query, and record it on a tape. Waits for the device.

    Args:
        tape: Whose `backward` adds the gradient to `poses.grad`, on the device.
        query: `DistanceQuery` that was given its pairs; signed, if depths are to count.
        poses: With a gradient, of all objects: (n, 7) with quaternions of any norm but 0, or (n, 4, 4), float32 or
            float64, or Warp's transforms or matrices (n,).

    Returns:
        Distances, float64 (p,), with a gradient, as that of `interop.torch.pair_distance`.

    Raises:
        TypeError, ValueError, RuntimeError: As `interop.torch.pair_distance`; no tape; or poses without a gradient. No
            object has moved.
    """
    if not isinstance(tape, wp.Tape):
        raise TypeError(f"tape: a wp.Tape is expected, not a {type(tape).__name__}")
    check_query(query)
    if not isinstance(poses, wp.array) or poses.grad is None:
        raise ValueError("poses: a Warp array made with requires_grad=True is expected")
    rows, recorded = pose_rows(poses, query), len(tape.launches)
    posed = PosedDistances(query, rows)
    del tape.launches[recorded:]  # the query's own, where the tape is recording
    distance = posed.distance
    distance.requires_grad = True
    if len(distance):  # an empty array has no gradient
        tape.record_func(lambda: posed.add_gradient(distance.grad, pose_rows(poses.grad, query)), [poses, distance])
    return distance
