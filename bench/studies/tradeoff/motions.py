"""Times of first contact: what a coarser tolerance and a coarser LOD save, and how far the time is off.

B comes from apart, passes A on the far side at a random distance, and turns by `TURN` on the way. The truth is the
finest LODs' with the least tolerance; times are given as fractions of the motion. A tolerance makes a time early, a LOD
early or late.
"""

import numpy as np

import warp_abtree as ab
from warp_abtree.checks.quaternions import multiply_quaternions, quaternions_about

from ...shapes import random_directions
from ..motions import POSES_AT_A_TIME
from .workload import workloads

TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)
FRACTIONS = (0.01, 0.1, 0.5)
USUAL, LEAST = 1e-6, 2.0**-40
TURN, ASIDE = 1.0, 1.0  # [rad], [reach]
STILL = [[0.0, 0, 0, 0, 0, 0, 1]]
OURS, TOLERANCE = "our LODs", "tolerance at the finest LODs"


class Contacts:
    """A workload's motions, on CUDA several times over, and queries of their first contacts.

    Attributes:
        once: How many motions are not repeated.
        way: Length of each one's way, B's centre's, in sizes, (once,).
    """

    def __init__(self, context, workload):
        self.context, self.workload, motions = context, workload, workload.motions
        self.once = len(motions)
        rng, reach = np.random.default_rng(11), np.full(self.once, motions.reach)
        starts, ends = motions.poses(reach), motions.poses(-reach)
        turns = quaternions_about(random_directions(rng, self.once, 3), np.full(self.once, TURN))
        centre = ends[:, :3] + rotate(ends[:, 3:], motions.centre_b)
        centre += ASIDE * motions.reach * rng.normal(size=(self.once, 3))
        ends[:, 3:] = multiply_quaternions(turns, ends[:, 3:])
        ends[:, :3] = centre - rotate(ends[:, 3:], motions.centre_b)
        first = starts[:, :3] + rotate(starts[:, 3:], motions.centre_b)
        self.way = np.linalg.norm(centre - first, axis=1) / workload.size
        times = -(-POSES_AT_A_TIME // self.once) if context.device.is_cuda else 1
        self._starts, self._ends = (np.tile(poses, (times, 1)) for poses in (starts, ends))
        self.truth = self.ask(1, LEAST).run()

    def ask(self, fraction, tolerance):
        """Return a query of all motions."""
        scene = self.workload.scene(self.workload.lods(fraction=fraction), len(self._starts))
        scene.place(self._starts)
        ends = np.concatenate([STILL, self._ends])
        return ab.FirstContactQuery(scene.scene, ends, scene.pairs, tolerance=tolerance)

    def row(self, method, setting, found):
        """Return a row of times of contact, its own time aside."""
        once = slice(self.once)
        clear, truth = found.clear[once], self.truth.clear[once]
        early = np.where(clear | truth, 0.0, self.truth.time[once] - found.time[once])
        both = ~clear & ~truth
        row = {"case": "motion", "workload": self.workload.name, "method": method, "setting": setting}
        row |= {"poses": self.once, "meet": int((~truth).sum()), "missed": int((clear & ~truth).sum())}
        row |= {"invented": int((truth & ~clear).sum()), "undecided": int(found.undecided[once].sum())}
        row |= {"time_mean": float(np.abs(early[both]).mean()) if both.any() else None}
        row |= {"early_max": max(0.0, float(early.max())), "late_max": max(0.0, float(-early.min()))}
        row |= {"contact_mean": float(np.abs(early * self.way)[both].mean()) if both.any() else None}
        row |= {"node_tests": float(found.node_tests[once].mean())}
        return row | {"face_tests": float(found.triangle_tests[once].mean())}


def rotate(quaternions, point):
    """Return a point as quaternions (n, 4) turn it, (n, 3)."""
    q, w = quaternions[:, :3], quaternions[:, 3:]
    across = 2 * np.cross(q, point)
    return point + w * across + np.cross(q, across)


def measure(contacts):
    """Return rows of tolerances at the finest LODs, and of LODs with the usual one, with their times."""
    rows, queries = {}, {}
    settings = [(TOLERANCE, f"{tolerance:.0e}", 1, tolerance) for tolerance in TOLERANCES]
    settings += [(OURS, f"{fraction:g} of the faces", fraction, USUAL) for fraction in (*FRACTIONS, 1)]
    for method, setting, fraction, tolerance in settings:
        queries[method, setting] = query = contacts.ask(fraction, tolerance)
        rows[method, setting] = contacts.row(method, setting, query.run())
    launches = {key: query.launch for key, query in queries.items()}
    for key, ms in contacts.context.time_launches(launches).items():
        rows[key]["us"] = 1e3 * ms / len(queries[key].pairs)
    whole = rows[OURS, "1 of the faces"]["us"]
    return [row | {"cost": row["us"] / whole} for row in rows.values()]


def run(context):
    """Yield one row a workload, and tolerance or LOD."""
    for workload in workloads(context):
        yield from measure(Contacts(context, workload))
