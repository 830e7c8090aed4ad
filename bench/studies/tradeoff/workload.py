"""Workloads of the trade-off: two models, motions of B towards A, and poses along them."""

import numpy as np

import warp_abtree as ab

from ...shapes import longest_side, scene_of_poses
from ..motions import POSES_AT_A_TIME, SCAN_STEPS, Motions, find_first_contact

REAL = {name: (name, name) for name in ("cow", "fandisk", "homer", "rocker-arm")}
REAL |= {"bunny": ("stanford-bunny",) * 2, "env-rob": ("fcl-env", "fcl-rob")}
WITHOUT_REAL = {"warp bear": ("warp:bear",) * 2, "warp bunny": ("warp:bunny",) * 2, "warp rocks": ("warp:rocks",) * 2}
KNOT = {"knot": ("knot:5000",) * 2}
QUICK = ("cow", "env-rob", "warp bear")
# Distances along a motion from the first contact, of the longest side; below 0 B is further in.
OFFSETS = (0.1, 0.03, 0.01, 0.003, -0.003, -0.01, -0.03, -0.1, -0.3)


def workloads(context):
    """Yield the workloads at hand: real meshes against themselves, and a robot against its surroundings."""
    for source in (REAL, WITHOUT_REAL, KNOT):
        found = {name: pair for name, pair in source.items() if all(map(context.models.has, pair))}
        if found:
            break
    if source is not REAL:
        context.note(f"The real meshes are not at hand; {', '.join(found)} in their place.")
    names = [name for name in QUICK if name in found] or list(found)[:2]
    for name in names if context.quick else found:
        context.progress(name)
        a, b = found[name]
        model_a = context.model(a)
        yield Workload(context, name, model_a, model_a if a == b else context.model(b))


def part_of(run):
    """Return the part of the study that yields the rows which `run(context, workload)` has of each workload."""
    return lambda context: (row for workload in workloads(context) for row in run(context, workload))


class Workload:
    """Two models, motions with their first contact at the finest LODs, exact, and poses about it.

    Attributes:
        size: The longest side of the larger model's box; errors are given as fractions of it.
        low: Where each motion is first in contact.
        poses, offset: Poses (n, 7) of the first motions, from apart through touching to deep, and where they are from
            the first contact, in sizes; at 0 both sides of it.
        finest, truth: Both finest LODs, and their answer at each pose.
    """

    def __init__(self, context, name, model_a, model_b):
        self.name, self.a, self.b, self.device = name, model_a, model_b, context.device
        self.size = max(longest_side(model_a), longest_side(model_b))
        count, posed = context.size((64, 24), (12, 6))
        self.motions = Motions(np.random.default_rng(7), 2 * count, model_a, model_b)
        self.steps = context.size(SCAN_STEPS, 64)
        self.finest = model_a.lod_max, model_b.lod_max
        low, high = find_first_contact(self.ask_at(self.finest), self.motions, self.steps)
        chosen = np.flatnonzero(~np.isnan(low))[:count]
        self.motions.away, self.motions.rotations = self.motions.away[chosen], self.motions.rotations[chosen]
        self.low = low[chosen]
        which = np.tile(np.arange(min(posed, len(chosen))), len(OFFSETS) + 2)
        along = [self.low[:posed] + offset * self.size for offset in OFFSETS]
        along = np.concatenate([*along, self.low[:posed], high[chosen][:posed]])
        offset = np.repeat([*OFFSETS, 0.0, 0.0], len(which) // (len(OFFSETS) + 2))
        kept = along >= 0
        self.offset = offset[kept]
        self.poses = self.motions.poses(along[kept], which[kept])
        self.truth = self.ask_at(self.finest)(self.poses)

    def ask_at(self, lods):
        """Return a function of poses: whether A and B intersect at LODs."""
        return lambda poses: ab.sweep(self.a, self.b, poses, *lods, device=self.device)

    def place(self, lods, poses):
        """Return a scene of A and a B at each pose, at LODs, and its pairs."""
        scene, pairs = scene_of_poses(self.device, self.a, self.b, poses)
        scene.set_lods([lods[0]] + [lods[1]] * len(poses))
        return scene, pairs

    def query(self, lods, poses, output, **options):
        """Return a query of poses at LODs, whose first run makes room for what it finds."""
        make = {"contacts": ab.ContactQuery, "distance": ab.DistanceQuery}.get(output)
        asked = {} if make else {"output": output}
        scene, pairs = self.place(lods, poses)
        return (make or ab.Query)(scene, pairs=pairs, **asked, **options)

    def lods(self, fraction=None, tolerance=None):
        """Return LODs of A and B: of a fraction of the faces (0 is the base), or of errors that sum to a tolerance."""
        if fraction == 0:
            return 0, 0
        if fraction is not None:
            return tuple(model.lod_for(fraction=fraction) for model in (self.a, self.b))
        return tuple(model.lod_for(tolerance=tolerance * self.size / 2) for model in (self.a, self.b))

    def bound(self, lods):
        """Return error(A) + error(B) [model units]."""
        return self.a.error_at(lods[0]) + self.b.error_at(lods[1])

    def fraction(self, lods):
        """Return the fraction of the faces that is active."""
        counts = [len(model.mesh_at(lod)[1]) for model, lod in zip((self.a, self.b), lods, strict=True)]
        return sum(counts) / (self.a.face_count + self.b.face_count)

    def first_contact(self, intersects):
        """Return errors of the first contacts of the motions [sizes]: above 0 early, below 0 late, NaN without one."""
        low, _ = find_first_contact(intersects, self.motions, self.steps)
        return (low - self.low) / self.size

    def repeated(self, poses=None, least=POSES_AT_A_TIME):
        """Return poses, by default all, on CUDA several times over, at least so many: work for the device."""
        poses = self.poses if poses is None else poses
        return np.tile(poses, (-(-least // len(poses)) if self.device.is_cuda else 1, 1))


def time_rows(context, rows, launches, count, on_core=False):
    """Add the time of one of so many poses [us] to rows by setting, whose launches are taken in turn."""
    for key, milliseconds in context.time_launches(launches, on_core=on_core).items():
        rows[key] |= {"us": 1e3 * milliseconds / count}


def relate(rows, whole) -> list:
    """Return rows by (method, setting) with both, and their costs relative to one of them."""
    return [
        row | {"method": method, "setting": setting, "cost": row["us"] / rows[whole]["us"]}
        for (method, setting), row in rows.items()
    ]


def judge_answers(found, truth):
    """Return columns of yes-or-no answers beside the truth: counts, precision and recall (None of nothing)."""
    row = {"poses": len(truth), "meet": truth.sum(), "missed": (~found & truth).sum()}
    row["invented"] = (found & ~truth).sum()
    return row | rates(row["meet"], row["missed"], row["invented"])


def rates(meet, missed, invented):
    """Return precision and recall, None of nothing."""
    hits = meet - missed
    return {"precision": hits / (hits + invented) if hits + invented else None, "recall": hits / meet if meet else None}


def judge_contact(error):
    """Return columns of errors of the first contact [sizes]: mean and largest size, and the largest of either sign."""
    known = error[~np.isnan(error)]
    row = {"never": len(error) - len(known)}
    if not len(known):
        return row | dict.fromkeys(("contact_mean", "contact_max", "early_max", "late_max", "early", "late"))
    row |= {"contact_mean": np.abs(known).mean(), "contact_max": np.abs(known).max()}
    row |= {"early_max": max(0.0, known.max()), "late_max": max(0.0, -known.min())}
    return row | {"early": (known > 0).mean(), "late": (known < 0).mean()}


def find_front(costs, errors):
    """Return which points no other one beats in one and equals in the other at least, bool (n,); None is infinite."""
    points = [(cost, np.inf if error is None else error) for cost, error in zip(costs, errors, strict=True)]
    return [not any(a <= cost and b <= error and (a, b) != (cost, error) for a, b in points) for cost, error in points]
