"""Figures of the study `tradeoff`. Distances are in per cent of the longest side, times of one pose in microseconds."""

import numpy as np

from .html import COLOURS, MARKERS, STYLES, plain_ticks
from .parts import pick
from .tradeoff_peers import COACD, HULL, NEWTON_SDF, OURS, OURS_WITHIN, SIMPLIFIED, VHACD
from .tradeoff_tables import group, over_meshes

LOWEST = 1e-3  # per cent: below it axes are linear, so that 0, the exact answer, is in the picture
METHODS = {  # colour and marker
    OURS: (0, "o"),
    OURS_WITHIN: (5, "s"),
    SIMPLIFIED: (1, "^"),
    HULL: (6, "X"),
    COACD: (2, "D"),
    VHACD: (3, "v"),
    NEWTON_SDF: (4, "P"),
}


def per_cent(rows, name):
    """Return a column in per cent, NaN where there is nothing."""
    return 100 * np.array([np.nan if row.get(name) is None else row[name] for row in rows], float)


def error_axis(axis, what):
    """Let an error axis be logarithmic down to `LOWEST`, and show 0."""
    from matplotlib.ticker import NullLocator

    axis.set_yscale("symlog", linthresh=LOWEST, linscale=0.4)
    ticks = [0, 1e-3, 1e-2, 1e-1, 1, 10, 100]
    axis.set_yticks(ticks, ["0", "0.001", "0.01", "0.1", "1", "10", "100"])
    axis.yaxis.set_minor_locator(NullLocator())
    axis.set_ylim(-0.3 * LOWEST, 150)
    axis.set_ylabel(what)


def cost_axis(axis, label):
    """Let an axis of times or counts be logarithmic, its ticks plain numbers."""
    axis.set_xscale("log")
    plain_ticks(axis.xaxis, *axis.get_xlim())
    axis.set_xlabel(label)


def share_axis(axis, label=True):
    """Let an axis show shares of the faces in per cent."""
    axis.set_xscale("log")
    axis.set_xticks([0.1, 1, 10, 100], ["0.1", "1", "10", "100"])
    if label:
        axis.set_xlabel("faces kept [%]")


def draw_first_contact(rows, figure):
    """Error of the first contact along a motion, beside the certified bound, over the faces kept."""
    found = group(pick(rows, case="rung", kind="fraction"), "subject")
    if not found:
        return False
    left, right = figure.subplots(1, 2, sharey=True)
    for k, ((subject,), members) in enumerate(found.items()):
        style = {"color": COLOURS[k % len(COLOURS)], "marker": MARKERS[k % len(MARKERS)]}
        share = per_cent(members, "share")
        left.plot(share, per_cent(members, "contact_mean"), label=subject, **style)
        bounded = [row for row in members if row["bound"]]
        right.plot(per_cent(bounded, "bound"), per_cent(bounded, "contact_max"), label=subject, **style)
    share_axis(left)
    error_axis(left, "error of the first contact [% of the size]")
    left.set_title("mean of all motions", fontsize=10)
    line = np.array([LOWEST, 100])
    right.plot(line, line, color="0.4", linestyle="--", label="the bound itself")
    right.set_xscale("log")
    right.set_xlim(0.005, 200)
    right.set_xticks([0.01, 0.1, 1, 10, 100], ["0.01", "0.1", "1", "10", "100"])
    right.set_xlabel("certified bound, error(A) + error(B) [% of the size]")
    right.set_title("largest of all motions, against the bound", fontsize=10)
    right.legend(loc="lower right")
    return True


def draw_quality(rows, figure):
    """Four kinds of error over the faces kept: means over the meshes."""
    found = over_meshes(pick(rows, case="rung", kind="fraction"))
    if not found:
        return False
    share = per_cent(found, "share")
    panels = (
        ("yes or no [%]", (("precision", "precision"), ("recall", "recall")), (0, 103)),
        ("contacts [%]", (("contacts_missed", "missed"), ("contacts_invented", "invented")), (0, 103)),
        (
            "contact regions [% of the size]",
            (("region_mean", "mean distance"), ("region_hausdorff", "Hausdorff")),
            None,
        ),
        (
            "averaged normal [degrees]",
            (("normal_mean", "mean"), ("normal_clear_mean", "mean where normals agree")),
            None,
        ),
    )
    for number, (axis, (what, lines, limits)) in enumerate(zip(figure.subplots(2, 2).flat, panels, strict=True)):
        for k, (name, label) in enumerate(lines):
            y = per_cent(found, name) / (100 if number == 3 else 1)
            axis.plot(share, y, color=COLOURS[k], marker=MARKERS[k], linestyle=STYLES[k], label=label)
        share_axis(axis, number > 1)
        axis.set_ylabel(what)
        if limits:
            axis.set_ylim(*limits)
        elif number == 2:
            error_axis(axis, what)
        else:
            axis.set_ylim(bottom=0)
        axis.legend()
    return True


def draw_pareto(rows, figure):
    """Errors against time and node tests, mesh by mesh; what no other rung beats is filled."""
    found = group(pick(rows, case="rung"), "subject")
    if not found:
        return False
    axes = figure.subplots(2, 2, sharey="row")
    panels = (
        ("any_us", "node_tests", "contact_mean", "contact_front", "first contact [% of the size]", "yes or no"),
        (
            "contacts_us",
            "contacts_node_tests",
            "region_mean",
            "region_front",
            "region, mean [% of the size]",
            "contacts",
        ),
    )
    for line, (microseconds, tests, error, front, what, output) in zip(axes, panels, strict=True):
        for axis, column, label in (
            (line[0], microseconds, f"{output}: time of a pose [µs]"),
            (line[1], tests, f"{output}: node tests of a pose"),
        ):
            for k, ((subject,), members) in enumerate(found.items()):
                members = sorted(members, key=lambda row: row[microseconds])
                x, y = np.array([row[column] for row in members], float), per_cent(members, error)
                kept = np.array([row[front] for row in members])
                style = {"color": COLOURS[k % len(COLOURS)], "marker": MARKERS[k % len(MARKERS)]}
                axis.plot(x[kept], y[kept], linewidth=1, label=subject, **style)
                axis.plot(x[~kept], y[~kept], linestyle="", markerfacecolor="none", alpha=0.6, **style)
            cost_axis(axis, label)
        error_axis(line[0], what)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6)
    return True


def draw_dials(rows, figure):
    """Cost of what is asked, and what a margin around coarse surfaces does to yes or no."""
    asked, margins = pick(rows, case="output"), pick(rows, case="margin")
    if not asked or not margins:
        return False
    left, right = figure.subplots(1, 2)
    names = list(dict.fromkeys(row["setting"] for row in asked))
    shares = sorted({row["value"] for row in asked}, reverse=True)
    width = 0.8 / len(shares)
    for k, value in enumerate(shares):
        y = [np.exp(np.mean(np.log([row["us"] for row in pick(asked, value=value, setting=name)]))) for name in names]
        place = np.arange(len(names)) + (k - (len(shares) - 1) / 2) * width
        hatch = ("", "//", "..", "xx")[k % 4]
        left.bar(place, y, width, color=COLOURS[k], hatch=hatch, edgecolor="white", label=f"{value:.0%} of the faces")
    left.set_xticks(range(len(names)), names)
    left.set_yscale("log")
    plain_ticks(left.yaxis, *left.get_ylim())
    left.set_ylabel("time of a pose [µs], geometric mean")
    left.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    left.grid(False, axis="x")
    for k, value in enumerate(sorted({row["value"] for row in margins})):
        found = group(pick(margins, value=value), "factor")
        factors = [factor for (factor,) in found]
        for style, name in (("-", "recall"), ("--", "precision")):
            y = [100 * np.mean([row[name] for row in members if row[name] is not None]) for members in found.values()]
            label = f"{name}, {value:.0%} of the faces"
            right.plot(factors, y, style, color=COLOURS[k], marker=MARKERS[k], label=label)
    right.set_xlabel("margin, parts of error(A) + error(B)")
    right.set_ylabel("yes where not proved farther apart [%]")
    right.set_ylim(0, 104)
    right.legend(loc="lower right")
    return True


def draw_rivals(rows, figure):
    """Time of yes or no against the error of the first contact, one panel a mesh."""
    found = group(pick(rows, case="point"), "subject")
    if not found:
        return False
    mixed = len(group(pick(rows, case="point"), "where")) > 1  # a GPU and a core in one picture: the legend says which
    columns = min(3, len(found))
    axes = figure.subplots(-(-len(found) // columns), columns, sharey=True, squeeze=False)
    handles = {}
    for number, (axis, ((subject,), members)) in enumerate(zip(axes.flat, found.items(), strict=False)):
        for method, (colour, marker) in METHODS.items():
            points = [row for row in pick(members, method=method) if row["contact_mean"] is not None]
            if points:
                line = "-" if method in (OURS, OURS_WITHIN, SIMPLIFIED) else ":"
                x = [row["us"] for row in points]
                style = {"color": COLOURS[colour], "marker": marker, "linestyle": line, "linewidth": 1, "markersize": 5}
                label = f"{method} ({points[0]['where']})" if mixed else method
                (handles[label],) = axis.plot(x, per_cent(points, "contact_mean"), **style)
        cost_axis(axis, "time of a query [µs]")
        axis.set_title(subject, fontsize=10)
        what = "first contact off, mean [% of the size]"
        error_axis(axis, what if number % columns == 0 else "")
    for axis in list(axes.flat)[len(found) :]:
        axis.remove()
    figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=3)
    return True
