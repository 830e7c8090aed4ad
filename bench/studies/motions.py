"""Motions of B towards A, poses along them, and the first contact.

A lies at the origin. Along a motion, B keeps one random rotation and its centre comes from far away towards A's on a
straight line in a random direction; where it is on its way is the distance of the two centres [model units].
"""

import numpy as np

from warp_abtree.checks.quaternions import matrices_of

from ..shapes import centre_and_radius, random_directions

SCAN_STEPS = 256
BISECTIONS = 32
POSES_AT_A_TIME = 4096


class Motions:
    """Straight motions of B towards A.

    Attributes:
        away: Directions from A's centre, float64 (m, 3).
        rotations: Of B, unit quaternions (m, 4).
        reach: Distance of the centres at which nothing intersects yet.
    """

    def __init__(self, rng, count, model_a, model_b):
        (self.centre_a, radius_a), (self.centre_b, radius_b) = map(centre_and_radius, (model_a, model_b))
        self.away, self.rotations = random_directions(rng, count, 3), random_directions(rng, count, 4)
        self.reach = 1.05 * (radius_a + radius_b)

    def __len__(self):
        return len(self.away)

    def poses(self, along, which=None):
        """Return poses of B in A's frame, float64 (n, 7), its centre so far from A's, (n,) [model units], on motions
        `which`, (n,); None is all in turn."""
        which = np.arange(len(self)) if which is None else which
        centre_b = matrices_of(self.rotations[which]) @ self.centre_b
        place = self.centre_a + np.asarray(along)[:, None] * self.away[which] - centre_b
        return np.concatenate([place, self.rotations[which]], 1)


def find_first_contact(intersects, motions, steps=SCAN_STEPS, bisections=BISECTIONS):
    """Return where each motion is first in contact and where it last was free, (m,) each; NaN where it never is.

    Equal steps from outside, then bisection between the step in contact and the one before it. A contact shorter than
    one step may be passed over. `intersects` is called with poses (n, 7) and returns bool (n,).
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
