"""Queries of continuous collision detection with ground truth in rational numbers: Sample-Queries of Tight-Inclusion.

Files NAME.vertex-face|edge-edge.N.csv.gz, in the folder that the environment variable ABTREE_CCD names, else in
../shared/ccd beside the checkout. Eight rows a query, four points at first and at last: numerator and denominator of x,
y and z, then 1 if they touch at some time while points move straight.

Source, also of Tight-Inclusion, whose own answers ipctk gives where it is installed: Wang et al. 2021, A large-scale
benchmark and an inclusion-based algorithm for continuous collision detection.
"""

import csv
import gzip
import os
from fractions import Fraction
from pathlib import Path

import numpy as np

try:
    import ipctk
except ImportError:
    ipctk = None
FOLDER = Path(os.environ.get("ABTREE_CCD", Path(__file__).resolve().parents[3] / "shared" / "ccd"))
# Which rows at either time are the corners of A's face and of B's, a vertex or an edge as a face without area.
CORNERS = {"vertex-face": (0, 0, 0, 1, 2, 3), "edge-edge": (0, 1, 1, 2, 3, 3)}
# Which of those corners are the points of a query.
POINTS = {"vertex-face": (0, 3, 4, 5), "edge-edge": (0, 1, 3, 4)}
OPTIONS = {"tolerance": 1e-6, "max_iterations": 1_000_000}  # as the authors of Tight-Inclusion run their benchmark


def read_queries(path: Path):
    """Return corners at first and at last, which float64 must hold, (p, 6, 3), and whether they touch, bool (p,)."""
    with gzip.open(path, "rt") as file:
        rows = [[int(x) for x in row] for row in csv.reader(file)]
    points = []
    for row in rows:
        exact = [Fraction(row[2 * k], row[2 * k + 1]) for k in range(3)]
        points.append([float(x) for x in exact])
        if any(Fraction(x) != y for x, y in zip(points[-1], exact)):
            raise ValueError(f"{path}: {row} is beyond float64")
    at = np.array(points).reshape(-1, 2, 4, 3)
    corners = CORNERS[path.name.split(".")[1]]
    return at[:, 0, corners], at[:, 1, corners], np.array([row[6] for row in rows[::8]]) != 0


def find_collisions(kind, starts, ends):
    """Return which queries of "vertex-face" or "edge-edge" Tight-Inclusion says to collide; points (p, 4, 3)."""
    inclusion = ipctk.tight_inclusion
    find = inclusion.point_triangle_ccd if kind == "vertex-face" else inclusion.edge_edge_ccd
    return [find(*first, *last, **OPTIONS)[0] for first, last in zip(starts, ends, strict=True)]
