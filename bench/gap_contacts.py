"""Contacts with a gap beside contacts without, a part of the case `distance`: times by gap, and how many more."""

import time

import numpy as np
import warp as wp

import warp_abtree as ab

from .shapes import knot, longest_side, pair_poses, scene_of_pairs
from .timing import medians, no_garbage_collection, one_core, ratio_of, time_in_turn

FULL = {"faces": 5000, "pairs": (64, 1024, 8192), "distances": (0.9, 0.2), "repeats": 15}
CPU = FULL | {"pairs": (64,)}
QUICK = {"faces": 300, "pairs": (4,), "distances": (0.2,), "repeats": 2}
GAPS = 0.0, 1e-4, 3e-4, 1e-3, 3e-3  # of the mesh's size
PAIRS_MAX_CLOSE = 1024  # more have too many contacts where meshes are that near
FAR = 0.9


def run(device, quick=False):
    """Yield a row a number of pairs, distance of their centres, and gap: contacts, and times [ms] of launches in turn.

    Columns: more is contacts over those without a gap; ratio the time over that without one, of whole launches, and
    search_ratio of those alone that find the faces. On a CPU on one core.
    """
    device = wp.get_device(device)
    sizes = QUICK if quick else CPU if device.is_cpu else FULL
    model = ab.Model.from_arrays(*knot(sizes["faces"]), name="knot")
    for count in sizes["pairs"]:
        for distance in sizes["distances"]:
            if distance >= FAR or count <= PAIRS_MAX_CLOSE:
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
        result = scene.intersect(pairs, output="contacts", gap=None if gap is None else gap * longest_side(model))
        rows = result.contacts if gap is None else result.contacts[result.contacts["separation"] < 0]
        if rows["faces"].tobytes() != plain.contacts["faces"].tobytes():
            raise RuntimeError("with a gap other faces intersect")
        found[gap] = len(result.contacts)
        asked = None if gap is None else gap * longest_side(model)
        queries[gap] = ab.ContactQuery(scene, pairs, capacity=max(1, found[gap]), gap=asked)
        queries[gap].grow()
    with one_core(), no_garbage_collection():
        clock = [time.thread_time] if device.is_cpu else []
        times = time_in_turn({gap: query.launch for gap, query in queries.items()}, device, repeats, *clock)
        search = time_in_turn({gap: query.traverse for gap, query in queries.items()}, device, repeats, *clock)
    middle = medians(times)
    for gap in GAPS:
        row = {"device": device.name, "pairs": count, "distance": distance, "gap": gap, "contacts": found[gap]}
        row |= {"more": round(found[gap] / max(1, found[None]), 3)}
        row |= {"without_ms": round(middle[None], 4), "with_ms": round(middle[gap], 4)}
        row |= {"ratio": ratio_of(times[gap], times[None]), "search_ratio": ratio_of(search[gap], search[None])}
        yield row | {"meet": int(np.count_nonzero(plain.any))}
