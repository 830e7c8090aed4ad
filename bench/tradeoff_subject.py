"""What the trade-off is measured on: two models, motions of B towards A, poses along them, and the first contact.

A lies at the origin. Along a motion, B keeps one random rotation and its centre comes from far away towards A's on a
straight line in a random direction; where it is on its way is the distance of the two centres [model units]. First
contact is looked for in equal steps from outside, then by bisection between the step that meets and the one before it,
in the same way for whatever answers yes or no. What meets for less than one step on its way may be passed over.
"""

import time

import numpy as np

import warp_abtree as ab

from .peers import no_garbage_collection, one_core
from .shapes import centre_and_radius
from .timing import time_rounds

REAL = {
    "cow": ("cow", "cow"),
    "fandisk": ("fandisk", "fandisk"),
    "homer": ("homer", "homer"),
    "rocker-arm": ("rocker-arm", "rocker-arm"),
    "bunny": ("stanford-bunny", "stanford-bunny"),
    "env-rob": ("fcl-env", "fcl-rob"),
}
WITHOUT_REAL = {"warp bear": ("warp:bear",) * 2, "warp bunny": ("warp:bunny",) * 2, "warp rocks": ("warp:rocks",) * 2}
QUICK = ("cow", "env-rob", "warp bear")
# Distances along a motion from the first contact, of the longest side; below 0 B is further in.
OFFSETS = (0.1, 0.03, 0.01, 0.003, -0.003, -0.01, -0.03, -0.1, -0.3)
SCAN_STEPS = 256
BISECTIONS = 32
POSES_AT_A_TIME = 4096
FAR = 1e3  # radii away: where poses that nobody asked for are put


def subjects(context):
    """Yield the subjects at hand: real meshes against themselves, and a robot against its surroundings."""
    found = {name: pair for name, pair in REAL.items() if all(map(context.has, pair))}
    if not found:
        context.note("The real meshes are not at hand; those inside Warp stand in for them.")
        found = {name: pair for name, pair in WITHOUT_REAL.items() if all(map(context.has, pair))}
    if not found:
        context.note("Warp's meshes are not at hand (extra `usd`); a knot stands in for them.")
        found = {"knot": ("knot:5000",) * 2}
    quick = [name for name in QUICK if name in found] or list(found)[:2]
    for name in quick if context.quick else found:
        a, b = found[name]
        model_a = context.model(a)
        yield Subject(context, name, model_a, model_a if a == b else context.model(b))


def rotate(quaternions, point):
    """Return a point turned by unit quaternions (n, 4) x y z w."""
    u, w = quaternions[:, :3], quaternions[:, 3:]
    cross = np.cross(u, point)
    return point + 2 * (w * cross + np.cross(u, cross))


class Motions:
    """Straight motions of B towards A.

    Attributes:
        away: Directions from A's centre, float64 (m, 3).
        turns: Rotations of B, unit quaternions (m, 4).
        reach: Distance of the centres at which nothing meets yet.
    """

    def __init__(self, rng, count, model_a, model_b):
        (self.centre_a, radius_a), (self.centre_b, radius_b) = map(centre_and_radius, (model_a, model_b))
        away, turns = rng.normal(size=(count, 3)), rng.normal(size=(count, 4))
        self.away = away / np.linalg.norm(away, axis=1, keepdims=True)
        self.turns = turns / np.linalg.norm(turns, axis=1, keepdims=True)
        self.reach = 1.05 * (radius_a + radius_b)
        self.far = np.array([*self.centre_a + FAR * (radius_a + radius_b), 0, 0, 0, 1.0])

    def __len__(self):
        return len(self.away)

    def keep(self, chosen):
        """Keep some of the motions."""
        self.away, self.turns = self.away[chosen], self.turns[chosen]

    def poses(self, along, which=None):
        """Return poses of B in A's frame, float64 (n, 7), its centre a distance from A's.

        Args:
            along: Distances [model units], (n,).
            which: Motions, (n,); None is all in turn.
        """
        which = np.arange(len(self)) if which is None else which
        turns = self.turns[which]
        place = self.centre_a + np.asarray(along)[:, None] * self.away[which] - rotate(turns, self.centre_b)
        return np.concatenate([place, turns], 1)


def find_first_contact(meets, motions, steps=SCAN_STEPS, bisections=BISECTIONS):
    """Return where each motion is first in contact and where it last was free, (m,) each; NaN where it never meets.

    Args:
        meets: Called with poses (n, 7), returns bool (n,).
    """
    count = len(motions)
    along = motions.reach * np.arange(steps, -1, -1) / steps
    low, high = np.full(count, np.nan), np.full(count, np.nan)
    block = max(1, POSES_AT_A_TIME // count)
    open_ = np.arange(count)
    for start in range(0, steps + 1, block):
        part = along[start : start + block]
        found = meets(motions.poses(np.tile(part, len(open_)), np.repeat(open_, len(part)))).reshape(-1, len(part))
        first = found.argmax(1)
        met = found.any(1)
        low[open_[met]] = part[first[met]]
        high[open_[met]] = part[first[met]] + motions.reach / steps
        open_ = open_[~met]
        if not len(open_):
            break
    which = np.flatnonzero(~np.isnan(low))
    for _ in range(bisections):
        middle = (low[which] + high[which]) / 2
        met = meets(motions.poses(middle, which))
        low[which], high[which] = np.where(met, middle, low[which]), np.where(met, high[which], middle)
    return low, high


class Stage:
    """A scene of A and a number of Bs, all Bs of one LOD: asks whatever of at most so many poses at a time.

    Attributes:
        scene, pairs: The `ab.Scene`, and its pairs (0, 1), (0, 2), ...
    """

    def __init__(self, subject, lods, room):
        self.scene = ab.Scene(subject.device)
        self.scene.add(subject.a, lod=lods[0])
        for _ in range(room):
            self.scene.add(subject.b, lod=lods[1])
        self.room = room
        self.pairs = np.stack([np.zeros(room, np.int32), np.arange(1, room + 1, dtype=np.int32)], 1)
        self._rows = np.tile(subject.motions.far, (room + 1, 1))
        self._rows[0] = 0, 0, 0, 0, 0, 0, 1
        self._far = subject.motions.far
        self._queries = {}

    def place(self, poses):
        """Pose the first Bs, and put the others away."""
        self._rows[1 : len(poses) + 1] = poses
        self._rows[len(poses) + 1 :] = self._far
        self.scene.set_poses(self._rows)

    def _in_parts(self, poses, query, column):
        found = []
        for start in range(0, len(poses), self.room):
            part = poses[start : start + self.room]
            self.place(part)
            query.set_pairs(self.pairs[: len(part)])
            found.append(getattr(query.run(), column))
        return np.concatenate(found) if found else np.zeros(0, bool)

    def meets(self, poses, precision="exact"):
        """Return whether A and B meet at each pose."""
        key = "any", precision
        if key not in self._queries:
            self._queries[key] = ab.Query(self.scene, "any", pairs=self.pairs, precision=precision)
        return self._in_parts(poses, self._queries[key], "any")

    def near(self, poses, within):
        """Return whether A and B are not proved farther apart than a distance, at each pose."""
        if "within" not in self._queries:
            self._queries["within"] = ab.Query(self.scene, "any", pairs=self.pairs, within=0.0)
        query, found = self._queries["within"], []
        within = np.broadcast_to(np.asarray(within, float), len(poses))
        for start in range(0, len(poses), self.room):
            part = poses[start : start + self.room]
            self.place(part)
            query.set_pairs(self.pairs[: len(part)], within=within[start : start + self.room])
            found.append(~query.run().apart)
        return np.concatenate(found)

    def ask(self, poses, output, precision="exact"):
        """Return the `ab.Result` at poses, no more than there is room for."""
        self.place(poses)
        return self.scene.intersect(self.pairs[: len(poses)], output, precision)


class Subject:
    """Two models, motions with their first contact at the finest LODs, exact, and poses about it.

    Attributes:
        size: The longest side of the larger model's box; errors are given as parts of it.
        low, high: Where each motion is first in contact, and last free.
        poses, offset: Poses (n, 7) of the first motions, from apart through touching to deep, and where they are from
            the first contact, in sizes; at 0 both sides of it.
        finest: Its LODs.
    """

    def __init__(self, context, name, model_a, model_b):
        self.name, self.a, self.b, self.device = name, model_a, model_b, context.device
        sides = [np.ptp(model.mesh_at(model.lod_max)[0], axis=0).max() for model in (model_a, model_b)]
        self.size = float(max(sides))
        self.finest = (model_a.lod_max, model_b.lod_max)
        count, posed = context.size((64, 24), (12, 6))
        self.motions = Motions(np.random.default_rng(7), 2 * count, model_a, model_b)
        self.steps = context.size(SCAN_STEPS, 64)
        stage = Stage(self, self.finest, min(POSES_AT_A_TIME, 16 * count))
        low, high = find_first_contact(stage.meets, self.motions, self.steps)
        chosen = np.flatnonzero(~np.isnan(low))[:count]
        self.motions.keep(chosen)
        self.low, self.high = low[chosen], high[chosen]
        which = np.tile(np.arange(min(posed, len(chosen))), len(OFFSETS) + 2)
        along = [self.low[:posed] + offset * self.size for offset in OFFSETS]
        along = np.concatenate([*along, self.low[:posed], self.high[:posed]])
        self.offset = np.repeat([*OFFSETS, 0.0, 0.0], len(which) // (len(OFFSETS) + 2))
        kept = along >= 0
        self.offset = self.offset[kept]
        self.poses = self.motions.poses(along[kept], which[kept])
        self.stage = stage
        self.truth = stage.meets(self.poses)

    def lods(self, fraction=None, tolerance=None):
        """Return LODs of A and B: of a share of the faces (0 is the base), or so that both errors sum to a tolerance.

        Args:
            tolerance: Of the size.
        """
        if fraction == 0:
            return 0, 0
        if fraction is not None:
            return tuple(model.lod_for(fraction=fraction) for model in (self.a, self.b))
        return tuple(model.lod_for(tolerance=tolerance * self.size / 2) for model in (self.a, self.b))

    def bound(self, lods):
        """Return error(A) + error(B) [model units]."""
        return self.a.error_at(lods[0]) + self.b.error_at(lods[1])

    def share(self, lods):
        """Return the share of the faces that is active."""
        counts = [len(model.mesh_at(lod)[1]) for model, lod in zip((self.a, self.b), lods, strict=True)]
        return sum(counts) / (self.a.face_count + self.b.face_count)

    def first_contact(self, meets):
        """Return the error of the first contact along each motion [sizes]: above 0 too early, below 0 too late.

        NaN where there is none.
        """
        low, _ = find_first_contact(meets, self.motions, self.steps)
        return (low - self.low) / self.size

    def tiled(self, least=POSES_AT_A_TIME):
        """Return poses to time: all of them, on CUDA several times over, at least so many: work for the device."""
        times = -(-least // len(self.poses)) if self.device.is_cuda else 1
        return np.tile(self.poses, (times, 1))


def time_launches(context, launches, repeats=None, on_core=False):
    """Return the median time [ms] of launches by name, in turn: on CUDA of graph replays.

    Else the CPU time of one thread on one core, which other work on the machine disturbs less than the wall clock.

    Args:
        on_core: Whether these run on the host whatever the device.
    """
    if context.device.is_cuda and not on_core:
        return context.time_in_turn(launches, repeats or context.size(9, 3))

    def clocked(launch):
        def run():
            launch()  # untimed: the caches are full of what ran before, which may have been large
            begin = time.thread_time()
            launch()
            return 1e3 * (time.thread_time() - begin)

        return run

    with one_core(), no_garbage_collection():
        times = time_rounds({name: clocked(launch) for name, launch in launches.items()}, repeats or context.size(7, 3))
    return {name: float(np.median(values)) for name, values in times.items()}


def judge_answers(found, truth):
    """Return columns of yes-or-no answers beside the truth: counts, precision and recall (None of nothing)."""
    hits, invented = int((found & truth).sum()), int((found & ~truth).sum())
    missed = int((~found & truth).sum())
    return {
        "poses": len(truth),
        "meet": int(truth.sum()),
        "missed": missed,
        "invented": invented,
        "precision": hits / (hits + invented) if hits + invented else None,
        "recall": hits / (hits + missed) if hits + missed else None,
    }


def judge_contact(error):
    """Return columns of errors of the first contact [sizes]: mean and largest size, and the largest of either sign."""
    known = error[~np.isnan(error)]
    if not len(known):
        return {"contact_mean": None, "contact_max": None, "early_max": None, "late_max": None, "never": len(error)}
    return {
        "contact_mean": float(np.abs(known).mean()),
        "contact_max": float(np.abs(known).max()),
        "early_max": float(max(0.0, known.max())),
        "late_max": float(max(0.0, -known.min())),
        "early": float((known > 0).mean()),
        "late": float((known < 0).mean()),
        "never": int(np.isnan(error).sum()),
    }


def find_front(points):
    """Return which (cost, error) points no other one beats in one and equals in the other at least, bool (n,)."""
    points = np.asarray(points, float)
    front = np.ones(len(points), bool)
    for i, (cost, error) in enumerate(points):
        better = (points[:, 0] <= cost) & (points[:, 1] <= error) & ((points[:, 0] < cost) | (points[:, 1] < error))
        front[i] = not better.any()
    return front
