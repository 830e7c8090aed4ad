"""Times of first contact: what a coarser tolerance and a coarser LOD save, and how far the time is off.

B comes from apart, passes A on the far side at a random distance, and turns by `TURN` on the way. The truth is the
finest LODs' with the least tolerance; times are given as fractions of the motion. A tolerance makes a time early, a LOD
early or late.
"""

import numpy as np

import warp_abtree as ab
from warp_abtree.checks.quaternions import matrices_of, multiply_quaternions, quaternions_about

from ...shapes import random_directions
from .workload import relate, time_rows

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

    def __init__(self, workload):
        self.workload, motions = workload, workload.motions
        self.once = len(motions)
        rng, reach = np.random.default_rng(11), np.full(self.once, motions.reach)
        starts, ends = motions.poses(reach), motions.poses(-reach)
        turns = quaternions_about(random_directions(rng, self.once, 3), np.full(self.once, TURN))
        first, centre = (poses[:, :3] + matrices_of(poses[:, 3:]) @ motions.centre_b for poses in (starts, ends))
        centre += ASIDE * motions.reach * rng.normal(size=(self.once, 3))
        ends[:, 3:] = multiply_quaternions(turns, ends[:, 3:])
        ends[:, :3] = centre - matrices_of(ends[:, 3:]) @ motions.centre_b
        self.way = np.linalg.norm(centre - first, axis=1) / workload.size
        self._starts, self._ends = map(workload.repeated, (starts, ends))
        self.truth = self.ask(1, LEAST).run()

    def ask(self, fraction, tolerance):
        """Return a query of all motions."""
        scene, pairs = self.workload.place(self.workload.lods(fraction=fraction), self._starts)
        return ab.FirstContactQuery(scene, np.concatenate([STILL, self._ends]), pairs, tolerance=tolerance)

    def row(self, method, setting, found):
        """Return a row of times of contact, its own time aside."""
        once = slice(self.once)
        clear, truth = found.clear[once], self.truth.clear[once]
        early = np.where(clear | truth, 0.0, self.truth.time[once] - found.time[once])
        off, way = np.abs(early)[~clear & ~truth], self.way[~clear & ~truth]
        row = {"case": "motion", "workload": self.workload.name, "method": method, "setting": setting}
        row |= {"poses": self.once, "meet": (~truth).sum(), "missed": (clear & ~truth).sum()}
        row |= {"invented": (truth & ~clear).sum(), "undecided": found.undecided[once].sum()}
        row |= {"time_mean": off.mean() if len(off) else None, "contact_mean": (off * way).mean() if len(off) else None}
        row |= {"early_max": max(0.0, early.max()), "late_max": max(0.0, -early.min())}
        tests = {"node_tests": found.node_tests, "face_tests": found.triangle_tests}
        return row | {name: values[once].mean() for name, values in tests.items()}


def run(context, workload):
    """Return rows of tolerances at the finest LODs, and of LODs with the usual one, with their times."""
    contacts, rows, queries = Contacts(workload), {}, {}
    settings = [(TOLERANCE, f"{tolerance:.0e}", 1, tolerance) for tolerance in TOLERANCES]
    settings += [(OURS, f"{fraction:g} of the faces", fraction, USUAL) for fraction in (*FRACTIONS, 1)]
    for method, setting, fraction, tolerance in settings:
        queries[method, setting] = query = contacts.ask(fraction, tolerance)
        rows[method, setting] = contacts.row(method, setting, query.run())
    time_rows(context, rows, {key: query.launch for key, query in queries.items()}, len(query.pairs))
    return relate(rows, (OURS, "1 of the faces"))
