"""Means over workloads, which the tables and figures of the study show."""

import numpy as np

from ...tables import pick
from .workload import rates

SUMMED = ("poses", "meet", "missed", "invented", "undecided")
LARGEST = ("early_max", "late_max", "contact_max", "region_hausdorff_max", "distance_max")
RATIOS = ("us", "cost", "build_s", "any_cost", "contacts_cost")
TESTS = ("node_tests", "contacts_node_tests")
RATIOS += tuple(f"{name}_cost" for name in TESTS)
SHOWN_OFFSETS = (0.01, 0.1, 0.5)  # fractions of the faces


def values(rows, name):
    """Return the values of a column that are there."""
    return [row[name] for row in rows if row.get(name) is not None]


def geometric(numbers):
    """Return the geometric mean, None of nothing."""
    return float(np.exp(np.mean(np.log(numbers)))) if numbers else None


def group(rows, *names):
    """Return rows by the values of columns, in the order in which they come."""
    found = {}
    for row in rows:
        found.setdefault(tuple(row.get(name) for name in names), []).append(row)
    return found


def aggregate(rows) -> dict:
    """Return one row: counts summed, precision and recall of the sums, geometric means of ratios, maxima, means."""
    row = {"workloads": len({row["workload"] for row in rows})}
    for name in dict.fromkeys(key for row in rows for key in row):
        found = values(rows, name)
        if not found or isinstance(found[0], str):
            continue
        if name in SUMMED:
            row[name] = sum(found)
        elif name in RATIOS:
            row[name] = geometric(found)
        else:
            row[name] = max(found) if name in LARGEST else float(np.mean(found))
    if "meet" in row:
        row |= rates(row["meet"], row["missed"], row["invented"])
    return row


def summarise(rows, names) -> list:
    """Return one row for each combination of the values of columns."""
    return [aggregate(members) | dict(zip(names, key, strict=True)) for key, members in group(rows, *names).items()]


def over_meshes(rows):
    """Return one row a fraction of the faces: means over the meshes, of normals over all poses."""
    found = []
    finest = {row["workload"]: row for row in pick(rows, value=1)}
    for (value,), members in group(rows, "value").items():
        costs = [row | {f"{name}_cost": row[name] / finest[row["workload"]][name] for name in TESTS} for row in members]
        row = aggregate(costs) | {"value": value, "level": "base" if value == 0 else f"{value:.3g}"}
        for name in ("normal", "normal_clear"):
            known = [member for member in members if member.get(f"{name}_poses")]
            total = sum(member[f"{name}_poses"] for member in known)
            weighted = sum(member[f"{name}_mean"] * member[f"{name}_poses"] for member in known)
            row[f"{name}_mean"] = weighted / total if total else None
        found.append(row)
    return found


def choose(rows):
    """Return one row a tolerance: the LOD that `lod_for` gives, what it costs, and which would do where the mean error
    of the first contact, or of the contact region, is what counts."""
    found = []
    for (value,), members in group(pick(rows, kind="tolerance"), "value").items():
        fractions = values(members, "share")
        row = {"tolerance": value, "kept": f"{min(fractions):.1%} to {max(fractions):.1%}"} | aggregate(members)
        for name, output in (("contact_mean", "any"), ("region_mean", "contacts")):
            enough = [
                cheapest(pick(rows, workload=member["workload"], kind="fraction"), name, value) for member in members
            ]
            row[f"{name}_share"] = float(np.median([level["share"] for level in enough]))
            row[f"{name}_cost"] = geometric([level[f"{output}_cost"] for level in enough])
        found.append(row)
    return found


def cheapest(rows, name, error):
    """Return the level of fewest faces from which on all finer ones keep an error within a limit."""
    found = None
    for row in sorted(rows, key=lambda row: -row["share"]):
        if row.get(name) is None or row[name] > error:
            break
        found = row
    return found


def by_offset(rows):
    """Return one row a distance from the first contact: fractions of wrong answers at some LODs."""
    found = []
    for (offset,), members in sorted(group(rows, "offset").items(), reverse=True):
        whole = pick(members, value=1)
        row = {"offset": offset, "poses": sum(values(whole, "poses")), "meet": sum(values(whole, "meet"))}
        for value in SHOWN_OFFSETS:
            at = pick(members, value=value)
            wrong = sum(member["missed"] + member["invented"] for member in at)
            row[f"wrong {value}"] = wrong / sum(member["poses"] for member in at) if at else None
        found.append(row)
    return found


def over_workloads(rows):
    """Return one row a method and setting: times beside those of the finest exact answer, means over the workloads."""
    finest = {row["workload"]: row["us"] for row in rows if row["method"] == "our LODs" and row["contact_max"] == 0}
    found = []
    for (method, setting), members in group(rows, "method", "setting").items():
        row = aggregate([member | {"cost": member["us"] / finest[member["workload"]]} for member in members])
        row |= {"method": method, "setting": setting, "where": members[0]["where"]}
        found.append(row | {"fronts": sum(member["front"] for member in members)})
    return sorted(found, key=lambda row: (row["method"], row["share"] if row["share"] is not None else 0))
