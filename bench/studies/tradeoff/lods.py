"""Cost and error of a level of detail, against the exact answer at the finest LODs."""

import numpy as np

from .regions import compare_normals, compare_regions, make_regions, resultants
from .workload import judge_answers, judge_contact

FRACTIONS = (0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1)
# Of the longest side, both models' errors together.
TOLERANCES = (0.1, 0.05, 0.02, 0.01, 0.005, 0.002)
QUICK_FRACTIONS = (0, 0.02, 0.1, 0.5, 1)
QUICK_TOLERANCES = (0.05, 0.01)
CLEAR = 0.5  # length of the mean of a pose's normals from which on they are said to agree


def run(context, workload):
    """Yield one row a level, and one a distance from the first contact."""
    exact = workload.query(workload.finest, workload.poses, "contacts").run()
    exact.check()
    if not np.array_equal(exact.any, workload.truth):
        raise RuntimeError("outputs 'any' and 'contacts' differ at the finest LODs")
    regions = make_regions(exact.contacts, len(workload.poses), workload.size)
    clear = resultants(exact.contacts, len(workload.poses)) > CLEAR
    settings = [("fraction", value) for value in context.size(FRACTIONS, QUICK_FRACTIONS)]
    settings += [("tolerance", value) for value in context.size(TOLERANCES, QUICK_TOLERANCES)]
    levels = []
    for kind, value in settings:
        lods = workload.lods(**{kind: value})
        found = workload.query(lods, workload.poses, "contacts").run()
        row = {"case": "level", "workload": workload.name, "kind": kind, "value": value}
        error, bound = workload.first_contact(workload.ask_at(lods)), workload.bound(lods) / workload.size
        row |= {"share": workload.fraction(lods), "bound": bound}
        row |= judge_answers(found.any, exact.any) | judge_contact(error)
        if bound:
            row["contact_over_bound"] = (np.abs(error) > bound).sum()
        row |= compare_regions(make_regions(found.contacts, len(workload.poses), workload.size), regions)
        row |= compare_normals(found.pair_contacts, exact.pair_contacts, clear)
        row |= {"contacts": len(found.contacts), "contacts_node_tests": found.node_tests.mean()}
        row["node_tests"] = workload.query(lods, workload.poses, "any").run().node_tests.mean()
        levels.append((row, lods))
        for offset in np.unique(workload.offset) if kind == "fraction" else ():
            at = workload.offset == offset
            about = {"case": "offset", "workload": workload.name, "value": value, "offset": offset}
            yield about | judge_answers(found.any[at], exact.any[at])
    yield from time_levels(context, workload, levels)


def time_levels(context, workload, levels):
    """Return the rows of levels (row, LODs) with their times, taken in turn."""
    poses, launches, rows = workload.repeated(), {}, [row for row, _ in levels]
    for number, (row, lods) in enumerate(levels):
        room = max(1024, row["contacts"] * (len(poses) // len(workload.poses)))
        for output, options in {"any": {}, "contacts": {"capacity": room}}.items():
            query = workload.query(lods, poses, output, **options)
            query.run().check()
            launches[number, output] = query.launch
    for (number, output), milliseconds in context.time_launches(launches).items():
        rows[number][f"{output}_us"] = 1e3 * milliseconds / len(poses)
    finest = next(row for row in rows if (row["kind"], row["value"]) == ("fraction", 1))
    for row in rows:
        row |= {f"{output}_cost": row[f"{output}_us"] / finest[f"{output}_us"] for output in ("any", "contacts")}
    return rows
