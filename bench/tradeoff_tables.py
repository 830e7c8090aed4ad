"""Tables and claims of the study `tradeoff`: pure functions of its rows."""

import numpy as np

from .parts import Claim, Column, Table, pick
from .tradeoff_promise import judge_promise

SUMMED = ("poses", "meet", "missed", "invented")
LARGEST = ("early_max", "late_max", "contact_max", "gap_max", "region_hausdorff_max")
SHOWN_OFFSETS = (0.01, 0.1, 0.5)  # shares of the faces


def values(rows, name):
    """Return the values of a column that are there."""
    return [row[name] for row in rows if row.get(name) is not None]


def geometric(numbers):
    """Return the geometric mean, None of nothing."""
    return float(np.exp(np.mean(np.log(numbers)))) if numbers else None


def aggregate(rows, *names, ratios=()):
    """Return one row: counts summed, precision and recall of the sums, maxima, ratios' geometric means, other means."""
    row = {name: sum(values(rows, name)) for name in SUMMED if values(rows, name)}
    if "meet" in row:
        hits = row["meet"] - row["missed"]
        row["precision"] = hits / (hits + row["invented"]) if hits + row["invented"] else None
        row["recall"] = hits / row["meet"] if row["meet"] else None
    for name in names:
        found = values(rows, name)
        row[name] = (max(found) if name in LARGEST else float(np.mean(found))) if found else None
    for name in ratios:
        row[name] = geometric(values(rows, name))
    return row | {"subjects": len({row["subject"] for row in rows})}


def group(rows, *names):
    """Return rows by the values of columns, in the order in which they come."""
    found = {}
    for row in rows:
        found.setdefault(tuple(row.get(name) for name in names), []).append(row)
    return found


# --- levels of detail ------------------------------------------------------------------------------------------------

LOD_MEANS = ("bound", "contact_mean", "early", "early_max", "late_max", "gap_mean", "gap_max", "contacts_missed")
LOD_MEANS += ("contacts_invented", "region_mean", "region_hausdorff", "region_hausdorff_max")
LOD_MEANS += ("normal_p95", "share")


def over_meshes(rows):
    """Return one row a share of the faces: means over the meshes."""
    found = []
    for (value,), members in group(rows, "value").items():
        costs = [dict(row) for row in members]
        for row in costs:
            finest = pick(rows, subject=row["subject"], value=1)[0]
            for name in ("node_tests", "contacts_node_tests"):
                row[f"{name}_cost"] = row[name] / finest[name]
        ratios = ("any_cost", "contacts_cost", "node_tests_cost", "contacts_node_tests_cost")
        row = {"value": value, "rung": "base" if value == 0 else f"{value:.3g}"}
        row |= aggregate(costs, *LOD_MEANS, ratios=ratios)
        for name in ("normal", "normal_clear"):
            row[f"{name}_mean"] = over_poses(members, f"{name}_mean", f"{name}_poses")
        found.append(row)
    return found


def over_poses(rows, name, count):
    """Return the mean of a column over all poses that its rows are means of, None of nothing."""
    known = [row for row in rows if row.get(name) is not None and row.get(count)]
    total = sum(row[count] for row in known)
    return sum(row[name] * row[count] for row in known) / total if total else None


def choose(rows):
    """Return one row a tolerance: the LOD that `lod_for` gives, what it costs, and which would do where the mean error
    of the first contact, or of the contact region, is what counts."""
    found = []
    for (value,), members in group(pick(rows, kind="tolerance"), "value").items():
        shares = values(members, "share")
        row = {"tolerance": value, "kept": f"{min(shares):.1%} to {max(shares):.1%}"}
        row |= aggregate(members, "bound", *LOD_MEANS[1:], ratios=("any_cost", "contacts_cost"))
        row["kept_median"] = float(np.median(shares))
        row["sound"] = all(member["within_tolerance"] and member["coarsest"] for member in members)
        for name in ("contact_mean", "region_mean"):
            enough = [
                cheapest(pick(rows, subject=member["subject"], kind="fraction"), name, value) for member in members
            ]
            row[f"{name}_share"] = float(np.median([rung["share"] for rung in enough]))
            output = "any" if name == "contact_mean" else "contacts"
            row[f"{name}_cost"] = geometric([rung[f"{output}_cost"] for rung in enough])
        found.append(row)
    return found


def cheapest(rows, name, error):
    """Return the rung of fewest faces from which on all finer ones keep an error within a limit."""
    found = None
    for row in sorted(rows, key=lambda row: -row["share"]):
        if row.get(name) is None or row[name] > error:
            break
        found = row
    return found


def by_offset(rows):
    """Return one row a distance from the first contact: shares of wrong answers at some LODs."""
    found = []
    for (offset,), members in sorted(group(rows, "offset").items(), reverse=True):
        row = {"offset": offset, "poses": sum(row["poses"] for row in pick(members, value=1))}
        row["meet"] = sum(row["meet"] for row in pick(members, value=1))
        for value in SHOWN_OFFSETS:
            at = pick(members, value=value)
            wrong = sum(member["missed"] + member["invented"] for member in at)
            row[f"wrong {value}"] = wrong / sum(member["poses"] for member in at) if at else None
        found.append(row)
    return found


SHARE = Column("rung", "faces kept, part")
ANSWERS = (Column("precision", "precision", ".3f"), Column("recall", "recall", ".3f"))
CONTACT = (
    Column("contact_mean", "first contact off, mean [size]", ".2%"),
    Column("early_max", "at most early [size]", ".2%"),
    Column("late_max", "at most late [size]", ".2%"),
)
REGION = (
    Column("contacts_missed", "contacts missed", ".1%"),
    Column("contacts_invented", "contacts invented", ".1%"),
    Column("region_mean", "regions apart, mean [size]", ".2%"),
    Column("region_hausdorff", "regions apart, Hausdorff [size]", ".2%"),
    Column("normal_mean", "normal off, mean [degrees]", ".1f"),
    Column("normal_clear_mean", "where normals agree [degrees]", ".1f"),
    Column("normal_p95", "normal off, 95 % [degrees]", ".1f"),
)
COST = (
    Column("any_cost", "time of yes or no, of the finest's", ".2f"),
    Column("contacts_cost", "time of contacts, of the finest's", ".2f"),
)
LOD_TABLES = (
    Table(
        "tradeoff_lods",
        "A level of detail against the finest exact answer, over all meshes",
        (SHARE, Column("bound", "certified bound, A and B [size]", ".2%"), *ANSWERS, *CONTACT, *COST),
        {"case": "rung", "kind": "fraction"},
        over_meshes,
        "size: the longest side of the larger model. Counts are summed over meshes, distances are means over meshes, "
        "largest values the largest of all, times geometric means.",
    ),
    Table(
        "tradeoff_regions",
        "Contact regions and normals, over all meshes",
        (SHARE, *REGION, Column("contacts_node_tests_cost", "node tests of contacts, of the finest's", ".2f"), COST[1]),
        {"case": "rung", "kind": "fraction"},
        over_meshes,
        "A contact is missed or invented where the other region has nothing within 1 % of the size. Normals agree "
        "where their weighted mean is longer than 0.5; angles are means over all such poses.",
    ),
    Table(
        "tradeoff_choose",
        "For this error, use this level of detail",
        (
            Column("tolerance", "both errors within [size]", ".1%"),
            Column("kept", "faces that lod_for(tolerance=) keeps"),
            Column("any_cost", "time of yes or no, of the finest's", ".2f"),
            Column("contacts_cost", "time of contacts, of the finest's", ".2f"),
            Column("contact_mean", "first contact off, mean [size]", ".3%"),
            Column("region_mean", "regions apart, mean [size]", ".3%"),
            Column("contact_mean_share", "faces if the mean first contact may be off by so much", ".1%"),
            Column("contact_mean_cost", "time of yes or no there", ".2f"),
            Column("region_mean_share", "faces if the mean region may be off by so much", ".1%"),
            Column("region_mean_cost", "time of contacts there", ".2f"),
        ),
        {"case": "rung"},
        choose,
        "Medians of the shares, geometric means of the times. The last four columns are of the measured rungs and hold "
        "for means over motions like these, without any guarantee for one of them.",
    ),
    Table(
        "tradeoff_offsets",
        "Wrong answers by distance from the first contact",
        (
            Column("offset", "distance from the first contact [size]", "+.1%"),
            Column("poses", "poses", ",d"),
            Column("meet", "that meet", ",d"),
            *(Column(f"wrong {value}", f"wrong at {value:.0%} of the faces", ".1%") for value in SHOWN_OFFSETS),
        ),
        {"case": "offset"},
        by_offset,
    ),
    Table(
        "tradeoff_by_mesh",
        "Every mesh and rung",
        (
            Column("subject", "meshes"),
            Column("kind", "rung by"),
            Column("value", "value", ".3g"),
            Column("share", "faces kept", ".2%"),
            Column("bound", "certified bound [size]", ".3%"),
            *ANSWERS,
            Column("contact_mean", "first contact off, mean [size]", ".3%"),
            Column("gap_max", "largest gap [size]", ".3%"),
            Column("late_max", "at most late [size]", ".3%"),
            Column("region_mean", "regions apart, mean [size]", ".3%"),
            Column("normal_mean", "normal off [degrees]", ".1f"),
            Column("normal_clear_mean", "where normals agree", ".1f"),
            Column("node_tests", "node tests, yes or no", ",.0f"),
            Column("any_us", "yes or no [us]", ".3g"),
            Column("contact_front", "on the front"),
            Column("contacts_node_tests", "node tests, contacts", ",.0f"),
            Column("contacts_us", "contacts [us]", ".3g"),
            Column("region_front", "on the front"),
        ),
        {"case": "rung"},
    ),
)


def judge_lod_for(rows):
    found = pick(rows, case="rung", kind="tolerance")
    bad = sum(not (row["within_tolerance"] and row["coarsest"]) for row in found)
    return bad == 0, f"{bad} of {len(found)} differ from a search through all LODs."


def coarse(rows):
    """Return the rungs of a share of the faces other than the finest."""
    return [row for row in pick(rows, case="rung", kind="fraction") if row["value"] != 1]


def judge_contact_bound(rows):
    found = coarse(rows)
    beyond = sum(row.get("contact_over_bound") or 0 for row in found)
    ratio = max(row["contact_max"] / row["bound"] for row in found if row["contact_max"] is not None and row["bound"])
    means = [row["contact_mean"] / row["bound"] for row in found if row["contact_mean"] is not None and row["bound"]]
    return beyond == 0, (
        f"{beyond} first contacts off by more, at most {ratio:.2f} times the bound; the mean error is "
        f"{geometric([mean for mean in means if mean > 0]):.3f} of it."
    )


def judge_gap(rows):
    found = [row for row in coarse(rows) if row.get("early") is not None]
    early, behind = (float(np.mean([row[name] for row in found])) for name in ("early", "late"))
    gap, late = max(row["gap_max"] for row in found), max(row["late_max"] for row in found)
    beyond = sum(row["gap_over_bound"] for row in found)
    return early > 0.5, (
        f"{early:.0%} of the first contacts come early and leave a gap, of {gap:.2%} of the size at most ({beyond} of "
        f"them beyond the bound); {behind:.0%} come late, by up to {late:.1%}: the objects overlap first."
    )


def judge_faster(name, limit=0.5):
    def judge(rows):
        found = pick(rows, case="rung", kind="fraction", value=0.1)
        if not found:
            return None, "Not measured."
        costs = [row[f"{name}_cost"] for row in found]
        return geometric(costs) < limit, (
            f"At 10 % of the faces {geometric(costs):.2f} of the finest's time ({min(costs):.2f} to {max(costs):.2f})."
        )

    return judge


LOD_CLAIMS = (
    Claim("lod_for(tolerance=) gives the coarsest LOD within a tolerance", "this project", judge_lod_for),
    Claim(
        "The error of the first contact along a motion stays within the certified bound",
        "nobody: it is not promised",
        judge_contact_bound,
    ),
    Claim(
        "At a low LOD objects bounce off each other at a distance: most first contacts come early, leaving a gap",
        "paper, section 4",
        judge_gap,
    ),
    Claim(
        "When the resolution decreases, interference detection gets significantly faster: contacts, at least twice",
        "paper, section 5.2",
        judge_faster("contacts"),
    ),
    Claim("The same for yes or no, at least twice", "paper, section 5.2", judge_faster("any")),
)


# --- dials -----------------------------------------------------------------------------------------------------------


def precisions(rows):
    """Return one row a share of the faces, kind of poses and precision."""
    found = []
    for (value, kind, setting), members in group(rows, "value", "poses_kind", "setting").items():
        row = {"value": value, "poses_kind": kind, "setting": setting} | aggregate(members, ratios=("cost",))
        for name in ("hits", "faces_missed", "faces_invented"):
            row[name] = sum(values(members, name))
        found.append(row)
    return sorted(found, key=lambda row: (-row["value"], row["poses_kind"]))


def outputs(rows):
    """Return one row a share of the faces and output."""
    found = []
    for (value, setting), members in group(rows, "value", "setting").items():
        means = aggregate(members, "node_tests", "triangle_tests", ratios=("us", "cost", "of_finest"))
        found.append({"value": value, "setting": setting} | means)
    return found


def margins(rows):
    """Return one row a share of the faces and margin."""
    found = []
    for (value, factor), members in group(rows, "value", "factor").items():
        means = aggregate(members, "margin", "contact_mean", "early_max", "late_max", ratios=("us", "cost"))
        found.append({"value": value, "factor": factor} | means)
    return found


VALUE = Column("value", "faces kept", ".0%")
DIAL_TABLES = (
    Table(
        "tradeoff_precision",
        "Precision, all face pairs, beside the exact answer at the same LOD",
        (
            VALUE,
            Column("poses_kind", "poses"),
            Column("setting", "precision"),
            Column("missed", "yes missed", ",d"),
            Column("invented", "yes invented", ",d"),
            Column("hits", "face pairs", ",d"),
            Column("faces_missed", "missed", ",d"),
            Column("faces_invented", "invented", ",d"),
            Column("cost", "time, of exact's", ".2f"),
        ),
        {"case": "precision"},
        precisions,
    ),
    Table(
        "tradeoff_outputs",
        "What is asked",
        (
            VALUE,
            Column("setting", "output"),
            Column("us", "time of a pose [us]", ".3g"),
            Column("cost", "of yes or no", ".2f"),
            Column("of_finest", "of the same at the finest", ".2f"),
            Column("node_tests", "node tests", ",.0f"),
            Column("triangle_tests", "triangle tests", ",.0f"),
        ),
        {"case": "output"},
        outputs,
    ),
    Table(
        "tradeoff_margin",
        "Yes where not proved farther apart than a margin",
        (
            VALUE,
            Column("factor", "margin, of both errors", ".3g"),
            *ANSWERS,
            *CONTACT,
            Column("us", "time of a pose [us]", ".3g"),
            Column("cost", "of yes or no at that LOD", ".2f"),
        ),
        {"case": "margin"},
        margins,
    ),
)


# --- promises --------------------------------------------------------------------------------------------------------

PROMISE_TABLES = (
    Table(
        "tradeoff_surface",
        "Distance of the original surface from the surface at random LODs",
        (
            Column("subject", "mesh"),
            Column("faces", "faces", ",d"),
            Column("configurations", "LODs tried", ",d"),
            Column("points", "points", ",d"),
            Column("violations", "beyond the bound", ",d"),
            Column("used_median", "largest distance found, of the bound: median", ".2f"),
            Column("used_max", "at most", ".2f"),
            Column("back_max", "largest distance the other way, of the bound", ".2f"),
        ),
        {"case": "surface"},
    ),
    Table(
        "tradeoff_apart",
        "Proved apart at random LODs and poses about the first contact",
        (
            Column("subject", "meshes"),
            Column("configurations", "configurations", ",d"),
            Column("violations", "proved apart, yet they meet", ",d"),
            Column("free", "apart at the finest LODs", ",d"),
            Column("proved", "of these proved apart", ".1%"),
            Column("met", "meet at the finest LODs", ",d"),
            Column("coarse_missed", "of these missed by yes or no at the LODs", ".1%"),
        ),
        {"case": "apart"},
    ),
)
PROMISE_CLAIMS = (
    Claim(
        "No point of the original surface lies farther from the surface at a LOD than its certified error",
        "this project",
        lambda rows: judge_promise(rows, "surface"),
    ),
    Claim(
        "Pairs whose coarse surfaces are proved farther apart than both errors do not meet at the finest LODs",
        "this project",
        lambda rows: judge_promise(rows, "apart"),
    ),
)


# --- rivals ----------------------------------------------------------------------------------------------------------


def rivals(rows):
    """Return one row a method and setting: times beside those of the finest exact answer, means over the meshes."""
    finest = {row["subject"]: row["us"] for row in rows if row["method"] == "our LODs" and row["contact_max"] == 0}
    found = []
    for (method, setting), members in group(rows, "method", "setting").items():
        members = [row | {"cost": row["us"] / finest[row["subject"]]} for row in members]
        row = {"method": method, "setting": setting, "where": members[0]["where"]}
        row |= aggregate(
            members, "share", "contact_mean", "early_max", "late_max", "pieces", ratios=("us", "cost", "build_s")
        )
        row["fronts"] = sum(member["front"] for member in members)
        found.append(row)
    return sorted(found, key=lambda row: (row["method"], row["share"] if row["share"] is not None else 0))


RIVAL_TABLES = (
    Table(
        "tradeoff_rivals",
        "Ways to trade accuracy for speed, over all meshes: yes or no",
        (
            Column("method", "method"),
            Column("setting", "setting"),
            Column("where", "runs on"),
            Column("subjects", "meshes", "d"),
            Column("share", "faces, of the original's", ".1%"),
            *ANSWERS,
            *CONTACT,
            Column("us", "time of a query [us]", ".3g"),
            Column("cost", "of our finest's", ",.2f"),
            Column("build_s", "made in [s]", ".2g"),
            Column("fronts", "fronts it is on", "d"),
        ),
        {"case": "point"},
        rivals,
        "Means over the meshes; times are geometric means. A point is on a mesh's front if none is faster and nearer.",
    ),
    Table(
        "tradeoff_rivals_by_mesh",
        "The same, mesh by mesh",
        (
            Column("subject", "meshes"),
            Column("method", "method"),
            Column("setting", "setting"),
            Column("where", "runs on"),
            Column("share", "faces, of the original's", ".1%"),
            *ANSWERS,
            *CONTACT,
            Column("us", "time of a query [us]", ".3g"),
            Column("pieces", "pieces", "d"),
            Column("made_by", "made by"),
            Column("build_s", "made in [s]", ".2g"),
            Column("front", "on the front"),
        ),
        {"case": "point"},
    ),
    Table("tradeoff_versions", "Versions", (Column("versions", "versions"),), {"case": "versions"}),
)


def judge_rivals(rows):
    found = pick(rows, case="point")
    fronts = group([row for row in found if row["front"]], "method")
    total = sum(len(members) for members in fronts.values())
    counts = ", ".join(f"{method} {len(members)}" for (method,), members in fronts.items())
    return all(method.startswith("our LODs") for (method,) in fronts), f"{total} points are on the fronts: {counts}."


RIVAL_CLAIMS = (
    Claim("No rival is both faster and nearer than all of our LODs: only ours are on the fronts", "none", judge_rivals),
)
