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


class LodLevels:
    """A workload at one level of detail after another, beside the exact answer."""

    def __init__(self, workload):
        self.workload = workload
        self.exact = workload.query(workload.finest, workload.poses, "contacts").run()
        self.exact.check()
        if not np.array_equal(self.exact.any, workload.truth):
            raise RuntimeError("outputs 'any' and 'contacts' differ at the finest LODs")
        self.regions = make_regions(self.exact.contacts, len(workload.poses), workload.size)
        self.clear = resultants(self.exact.contacts, len(workload.poses)) > CLEAR
        self.levels = []

    def measure(self, kind, value, lods):
        """Add the row of a level, times aside; yield one row a distance from the first contact."""
        workload, exact = self.workload, self.exact
        found = workload.query(lods, workload.poses, "contacts").run()
        error = workload.first_contact(workload.ask_at(lods))
        bound = workload.bound(lods) / workload.size
        row = {"case": "level", "workload": workload.name, "kind": kind, "value": value}
        row |= {"share": workload.fraction(lods), "bound": bound}
        row |= judge_answers(found.any, exact.any) | judge_contact(error)
        if bound:
            row["contact_over_bound"] = (np.abs(error) > bound).sum()
        row |= compare_regions(make_regions(found.contacts, len(workload.poses), workload.size), self.regions)
        row |= compare_normals(found.pair_contacts, exact.pair_contacts, self.clear)
        row |= {"contacts": len(found.contacts), "contacts_node_tests": found.node_tests.mean()}
        row["node_tests"] = workload.query(lods, workload.poses, "any").run().node_tests.mean()
        self.levels.append((row, lods))
        for offset in np.unique(workload.offset) if kind == "fraction" else ():
            at = workload.offset == offset
            about = {"case": "offset", "workload": workload.name, "value": value, "offset": offset}
            yield about | judge_answers(found.any[at], exact.any[at])

    def time(self, context):
        """Return the rows with their times, taken in turn."""
        poses, launches, rows = self.workload.repeated(), {}, [row for row, _ in self.levels]
        for number, (row, lods) in enumerate(self.levels):
            room = max(1024, row["contacts"] * (len(poses) // len(self.workload.poses)))
            for output, options in {"any": {}, "contacts": {"capacity": room}}.items():
                query = self.workload.query(lods, poses, output, **options)
                query.run().check()
                launches[number, output] = query.launch
        for (number, output), milliseconds in context.time_launches(launches).items():
            rows[number][f"{output}_us"] = 1e3 * milliseconds / len(poses)
        finest = next(row for row in rows if (row["kind"], row["value"]) == ("fraction", 1))
        for row in rows:
            row |= {f"{output}_cost": row[f"{output}_us"] / finest[f"{output}_us"] for output in ("any", "contacts")}
        return rows


def run(context, workload):
    """Yield one row a level, and one a distance from the first contact."""
    levels = LodLevels(workload)
    for value in context.size(FRACTIONS, QUICK_FRACTIONS):
        yield from levels.measure("fraction", value, workload.lods(fraction=value))
    for value in context.size(TOLERANCES, QUICK_TOLERANCES):
        yield from levels.measure("tolerance", value, workload.lods(tolerance=value))
    yield from levels.time(context)
