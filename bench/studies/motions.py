"""Motions of B towards A, poses along them, and the first contact.

A lies at the origin. Along a motion, B keeps one random rotation and its centre comes from far away towards A's on a
straight line in a random direction; where it is on its way is the distance of the two centres [model units].
"""

import numpy as np

import warp_abtree as ab
from warp_abtree.checks.quaternions import matrices_of

from ..shapes import centre_and_radius, random_directions, scene_of_poses

SCAN_STEPS = 256
BISECTIONS = 32
POSES_AT_A_TIME = 4096
FAR = 1e3  # radii away: where poses that nobody asked for are put


class Motions:
    """Straight motions of B towards A.

    Attributes:
        away: Directions from A's centre, float64 (m, 3).
        rotations: Of B, unit quaternions (m, 4).
        reach: Distance of the centres at which nothing intersects yet.
        far: Pose of B out of reach, (7,).
    """

    def __init__(self, rng, count, model_a, model_b):
        (self.centre_a, radius_a), (self.centre_b, radius_b) = map(centre_and_radius, (model_a, model_b))
        self.away, self.rotations = random_directions(rng, count, 3), random_directions(rng, count, 4)
        self.reach = 1.05 * (radius_a + radius_b)
        self.far = np.array([*self.centre_a + FAR * (radius_a + radius_b), 0, 0, 0, 1.0])

    def __len__(self):
        return len(self.away)

    def poses(self, along, which=None):
        """Return poses of B in A's frame, float64 (n, 7), its centre a distance from A's.

        Args:
            along: Distances [model units], (n,).
            which: Motions, (n,); None is all in turn.
        """
        which = np.arange(len(self)) if which is None else which
        centre_b = matrices_of(self.rotations[which]) @ self.centre_b
        place = self.centre_a + np.asarray(along)[:, None] * self.away[which] - centre_b
        return np.concatenate([place, self.rotations[which]], 1)


def find_first_contact(intersects, motions, steps=SCAN_STEPS, bisections=BISECTIONS):
    """Return where each motion is first in contact and where it last was free, (m,) each; NaN where it never is.

    Equal steps from outside, then bisection between the step in contact and the one before it. A contact shorter than
    one step may be passed over.

    Args:
        intersects: Called with poses (n, 7), returns bool (n,).
    """
    count = len(motions)
    along = motions.reach * np.arange(steps, -1, -1) / steps
    low, high = np.full(count, np.nan), np.full(count, np.nan)
    block = max(1, POSES_AT_A_TIME // count)
    searched = np.arange(count)
    for start in range(0, steps + 1, block):
        part = along[start : start + block]
        poses = motions.poses(np.tile(part, len(searched)), np.repeat(searched, len(part)))
        found = intersects(poses).reshape(-1, len(part))
        first, hit = found.argmax(1), found.any(1)
        low[searched[hit]] = part[first[hit]]
        high[searched[hit]] = part[first[hit]] + motions.reach / steps
        searched = searched[~hit]
        if not len(searched):
            break
    which = np.flatnonzero(~np.isnan(low))
    for _ in range(bisections):
        middle = (low[which] + high[which]) / 2
        hit = intersects(motions.poses(middle, which))
        low[which], high[which] = np.where(hit, middle, low[which]), np.where(hit, high[which], middle)
    return low, high


class PoseScene:
    """A scene of A and a number of Bs, room, all of one LOD: any number of poses, so many at a time.

    Bs that are not asked stand at the pose far; pairs are (0, 1), (0, 2), ...
    """

    def __init__(self, device, models, lods, far, room):
        self.scene, self.pairs = scene_of_poses(device, *models, np.tile(far, (room, 1)))
        self.scene.set_lods([lods[0]] + [lods[1]] * room)
        self.room, self._far, self._any = room, far, ab.Query(self.scene, "any", pairs=self.pairs)

    def place(self, poses):
        """Pose the first Bs, and put the others away."""
        still, rest = [(0, 0, 0, 0, 0, 0, 1)], np.tile(self._far, (self.room - len(poses), 1))
        self.scene.set_poses(np.concatenate([still, poses, rest]))

    def intersects(self, poses):
        """Return whether A and B intersect at each pose."""
        found = np.zeros(len(poses), bool)
        for start in range(0, len(poses), self.room):
            part = poses[start : start + self.room]
            self.place(part)
            self._any.set_pairs(self.pairs[: len(part)])
            found[start : start + len(part)] = self._any.run().any
        return found

    def query(self, poses, output, **options):
        """Return a query of poses, which are placed; its first run makes room for what it finds."""
        self.place(poses)
        make = {"contacts": ab.ContactQuery, "distance": ab.DistanceQuery}.get(output)
        asked = {} if make else {"output": output}
        return (make or ab.Query)(self.scene, pairs=self.pairs[: len(poses)], **asked, **options)
