"""Contacts with a gap beside contacts without, a part of the case `distance`: times by gap, and how many more."""

import time

import numpy as np
import warp as wp

import warp_abtree as ab

from .shapes import KNOT_PAIRS, knot, knot_batches, longest_side, pair_poses, scene_of_pairs
from .timing import medians, no_garbage_collection, one_core, ratio_of, time_in_turn

FULL = KNOT_PAIRS | {"pairs": (64, 1024, 8192)}
QUICK = {"faces": 300, "pairs": (4,), "distances": (0.2,), "repeats": 2}
GAPS = 0.0, 1e-4, 3e-4, 1e-3, 3e-3  # of the mesh's size


def run(device, quick=False):
    """Yield a row a number of pairs, distance of their centres, and gap: contacts, and times [ms] of launches in turn.

    Columns: more is contacts over those without a gap; ratio the time over that without one, of whole launches, and
    search_ratio of those alone that find the faces. On a CPU on one core.
    """
    device = wp.get_device(device)
    sizes = QUICK if quick else FULL
    model = ab.Model.from_arrays(*knot(sizes["faces"]), name="knot")
    for count, distance in knot_batches(device, sizes):
        yield from time_gaps(device, model, count, distance, sizes["repeats"])


def time_gaps(device, model, count, distance, repeats):
    """Yield the rows of one batch of pairs.

    Raises:
        RuntimeError: What intersects is not the same with a gap.
    """
    scene, pairs = scene_of_pairs(device, model, pair_poses(count, distance))
    plain = scene.intersect(pairs, output="contacts")
    queries, found = {}, {}
    for gap in (None, *GAPS):
        asked = None if gap is None else gap * longest_side(model)
        result = scene.intersect(pairs, output="contacts", gap=asked)
        rows = result.contacts if gap is None else result.contacts[result.contacts["separation"] < 0]
        if rows["faces"].tobytes() != plain.contacts["faces"].tobytes():
            raise RuntimeError("with a gap other faces intersect")
        found[gap] = len(result.contacts)
        queries[gap] = ab.ContactQuery(scene, pairs, capacity=max(1, found[gap]), gap=asked)
        queries[gap].grow()
    with one_core(), no_garbage_collection():
        clock = [time.thread_time] if device.is_cpu else []
        times = time_in_turn({gap: query.launch for gap, query in queries.items()}, device, repeats, *clock)
        search = time_in_turn({gap: query.traverse for gap, query in queries.items()}, device, repeats, *clock)
    middle = medians(times)
    for gap in GAPS:
        row = {"device": device.name, "pairs": count, "distance": distance, "gap": gap, "contacts": found[gap]}
        row |= {"more": found[gap] / max(1, found[None]), "without_ms": middle[None], "with_ms": middle[gap]}
        row |= {"ratio": ratio_of(times[gap], times[None]), "search_ratio": ratio_of(search[gap], search[None])}
        yield row | {"meet": np.count_nonzero(plain.any)}
