"""Checks of answers before a time is printed: face pairs compared, and the exact oracle of the tests as judge."""

import functools
import importlib.util
from pathlib import Path

import numpy as np

ORACLE = Path(__file__).resolve().parents[1] / "tests" / "oracles" / "triangle.py"


@functools.cache
def load_oracle():
    """Return the exact oracle of the tests, written apart from the kernels; None where there is no checkout."""
    if not ORACLE.is_file():
        return None
    spec = importlib.util.spec_from_file_location("oracle_triangle", ORACLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def count_differences(found, truth):
    """Return how many rows of face pairs (k, 3) are missed and how many invented; no row comes twice."""
    rows, kept = (np.asarray(x, np.int64).reshape(-1, 3) for x in (truth, found))
    base = 1 + max((int(x[:, 1:].max()) for x in (rows, kept) if len(x)), default=0)
    rows, kept = ((x[:, 0] * base + x[:, 1]) * base + x[:, 2] for x in (rows, kept))
    common = len(np.intersect1d(rows, kept, assume_unique=True))
    return len(rows) - common, len(kept) - common


def judge_disputed(found, ours, meshes, poses, name, most=None):
    """Let the oracle decide face pairs that only one side reports; return how many, None without the oracle; raise a
    RuntimeError where the library is wrong in one of them.

    Args:
        found, ours: Rows (pair, face of A, face of B) of a baseline and of the library.
        meshes: Vertices and faces of A and of B.
        poses: Called with a pair; returns the poses of A and B.
        name: Of the baseline.
        most: Judge about so many, evenly chosen; None judges all.
    """
    oracle = load_oracle()
    if oracle is None:
        return None
    theirs, mine = (set(map(tuple, np.asarray(rows).tolist())) for rows in (found, ours))
    disputed = sorted(mine ^ theirs)
    disputed = disputed[:: max(1, len(disputed) // most) if most else 1]
    (vertices_a, faces_a), (vertices_b, faces_b) = meshes
    wrong = 0
    for pair in dict.fromkeys(row[0] for row in disputed):
        rows = np.array([row for row in disputed if row[0] == pair])
        corners_a = vertices_a[faces_a[rows[:, 1]]].reshape(-1, 3)
        corners_b = oracle.into_frame_of_a(vertices_b[faces_b[rows[:, 2]]].reshape(-1, 3), *poses(pair))
        index = np.arange(len(corners_a)).reshape(-1, 3)
        meets = oracle.pairs_intersect(corners_a, index, corners_b, index, [(k, k) for k in range(len(rows))])
        wrong += sum(bool(meet) != (tuple(row) in mine) for meet, row in zip(meets, rows.tolist(), strict=True))
    if wrong:
        raise RuntimeError(f"{wrong} of {len(disputed)} face pairs on which {name} differs are errors of ours")
    return len(disputed)
