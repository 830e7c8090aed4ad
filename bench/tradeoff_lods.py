"""Part `lods`: what a level of detail costs and gets wrong, against the exact answer at the finest LODs."""

import numpy as np

import warp_abtree as ab

from .tradeoff_regions import compare_normals, compare_regions, make_regions, resultants
from .tradeoff_subject import Stage, find_front, judge_answers, judge_contact, subjects, time_launches

FRACTIONS = (0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1)
# Of the longest side, both models' errors together.
TOLERANCES = (0.1, 0.05, 0.02, 0.01, 0.005, 0.002)
QUICK_FRACTIONS = (0, 0.02, 0.1, 0.5, 1)
QUICK_TOLERANCES = (0.05, 0.01)
GAP_BISECTIONS = 16
CLEAR = 0.5  # length of the mean of a pose's normals from which on they are said to agree


def rungs(context, subject):
    """Return (kind, value, LODs of A and B) of what is measured."""
    fractions = context.size(FRACTIONS, QUICK_FRACTIONS)
    found = [("fraction", value, subject.lods(fraction=value)) for value in fractions]
    tolerances = context.size(TOLERANCES, QUICK_TOLERANCES)
    return found + [("tolerance", value, subject.lods(tolerance=value)) for value in tolerances]


def is_coarsest(model, tolerance):
    """Return whether `lod_for` gives the coarsest LOD within a tolerance, found by going through all of them."""
    within = [lod for lod in range(model.lod_max + 1) if model.error_at(lod) <= tolerance]
    return model.lod_for(tolerance=tolerance) == min(within)


def find_gaps(subject, error):
    """Return the distance of the finest surfaces where coarse ones first touch [sizes]: 0 where those are too late.

    By bisection on `within`, so to 2^-16 of the error of the first contact, which is the most it can be.
    """
    early = np.flatnonzero(error > 0)
    gaps = np.where(np.isnan(error), np.nan, 0.0)
    if len(early):
        poses = subject.motions.poses(subject.low[early] + error[early] * subject.size, early)
        low, high = np.zeros(len(early)), 1.001 * error[early]
        for _ in range(GAP_BISECTIONS):
            middle = (low + high) / 2
            near = subject.stage.near(poses, middle * subject.size)
            low, high = np.where(near, low, middle), np.where(near, middle, high)
        gaps[early] = high
    return gaps


def judge_rung(subject, kind, value, lods, stage, exact, regions):
    """Return the row of one rung, times aside, and its yes or no at each pose."""
    found = stage.ask(subject.poses, "contacts")
    error = subject.first_contact(stage.meets)
    gaps = find_gaps(subject, error)
    bound = subject.bound(lods) / subject.size
    row = {"case": "rung", "subject": subject.name, "kind": kind, "value": value, "lod_a": lods[0], "lod_b": lods[1]}
    row |= {"faces": subject.a.face_count + subject.b.face_count, "share": subject.share(lods)}
    row |= {"size": subject.size, "bound": bound}
    row |= judge_answers(found.any, exact.any) | judge_contact(error)
    known = gaps[~np.isnan(gaps)]
    row |= {"gap_mean": float(known.mean()) if len(known) else None, "gap_max": float(known.max(initial=0.0))}
    row["gap_over_bound"] = int((known > bound + 1e-4 * np.abs(error[~np.isnan(gaps)])).sum())
    if bound:
        row["contact_over_bound"] = int((np.abs(error) > bound).sum())
    row |= compare_regions(make_regions(found.contacts, len(subject.poses), subject.size), regions)
    clear = resultants(exact.contacts, len(subject.poses)) > CLEAR
    row |= compare_normals(found.pair_contacts, exact.pair_contacts, clear)
    row["contacts"] = int(len(found.contacts))
    row["node_tests"] = float(stage.ask(subject.poses, "any").node_tests.mean())
    row["contacts_node_tests"] = float(found.node_tests.mean())
    if kind == "tolerance":
        models = {subject.a, subject.b}
        row["within_tolerance"] = bool(bound <= value)
        row["coarsest"] = all(is_coarsest(model, value * subject.size / 2) for model in models)
    return row, found


def offset_rows(subject, kind, value, found, exact):
    """Yield one row a distance from the first contact: yes or no, missed and invented."""
    if kind != "fraction":
        return
    for offset in np.unique(subject.offset):
        at = subject.offset == offset
        row = {"case": "offset", "subject": subject.name, "value": value, "offset": float(offset)}
        yield row | judge_answers(found.any[at], exact.any[at])


def time_rungs(context, subject, stages, contacts):
    """Return the median time [ms] of launches of "any" and "contacts" of all stages, asked in turn."""
    poses = subject.tiled()
    launches = {}
    for number, stage in enumerate(stages):
        stage.place(poses)
        pairs = stage.pairs[: len(poses)]
        query = ab.Query(stage.scene, "any", pairs=pairs)
        demand = contacts[number] * (len(poses) // len(subject.poses))
        whole = ab.ContactQuery(stage.scene, pairs, capacity=max(1024, demand))
        for output, operator in (("any", query), ("contacts", whole)):
            operator.run().check()
            launches[number, output] = operator.launch
    return time_launches(context, launches), len(poses)


def mark_fronts(rows):
    """Say which rungs of a subject no other one beats in time and in an error."""
    fronts = ("any_us", "contact_mean", "contact_front"), ("contacts_us", "region_mean", "region_front")
    for cost, error, name in fronts:
        points = [(row[cost], row.get(error)) for row in rows]
        points = [(a, np.inf if b is None else b) for a, b in points]
        for row, front in zip(rows, find_front(points), strict=True):
            row[name] = bool(front)


def run(context):
    """Yield one row a subject and rung, and one a distance from the first contact."""
    for subject in subjects(context):
        exact = subject.stage.ask(subject.poses, "contacts")
        exact.check()
        if not np.array_equal(exact.any, subject.truth):
            raise RuntimeError("outputs 'any' and 'contacts' differ at the finest LODs")
        regions = make_regions(exact.contacts, len(subject.poses), subject.size)
        room = max(len(subject.tiled()), subject.stage.room)
        asked = rungs(context, subject)
        rows, stages = [], []
        for number, (kind, value, lods) in enumerate(asked):
            context.progress(f"{subject.name}: {kind} {value:g}", number, len(asked) + 1)
            stage = Stage(subject, lods, room)
            row, found = judge_rung(subject, kind, value, lods, stage, exact, regions)
            yield from offset_rows(subject, kind, value, found, exact)
            rows.append(row)
            stages.append(stage)
        context.progress(f"{subject.name}: times", len(asked), len(asked) + 1)
        times, count = time_rungs(context, subject, stages, [row["contacts"] for row in rows])
        for (number, output), milliseconds in times.items():
            rows[number][f"{output}_us"] = 1e3 * milliseconds / count
        finest = next(row for row in rows if (row["kind"], row["value"]) == ("fraction", 1))
        for row in rows:
            row["timed_poses"] = count
            for output in ("any", "contacts"):
                row[f"{output}_cost"] = row[f"{output}_us"] / finest[f"{output}_us"]
        mark_fronts(rows)
        yield from rows
