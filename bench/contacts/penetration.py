"""Penetration that contact points allow: how deep the near faces of a pair get before one of its points stops a motion.

The second object moves along a twist until a point blocks, at most twice the gap. To first order, and without friction:
a contact at p with normal n comes apart at the rate n . (v + w x (p - c)). All near faces, as points, allow none.
"""

from typing import NamedTuple

import numpy as np

from ..shapes import random_directions

TWISTS, SEED = 2000, 20_260
CHUNK = 100  # twists at once
SLOWEST = 1e-9  # rate of approach under which a point does not block


class Contacts(NamedTuple):
    """Contacts of one pair, world frame; normals from the first object to the second."""

    point: np.ndarray  # (k, 3) [m]
    normal: np.ndarray  # (k, 3)
    separation: np.ndarray  # (k,) [m], negative inside


def near_contacts(rows) -> Contacts:
    """Return all near contacts of rows of `Result.contacts`."""
    return Contacts((rows["p0"] + rows["p1"]) / 2, rows["normal"], rows["separation"])


def random_twists(contacts: Contacts, count=TWISTS, seed=SEED):
    """Return twists (count, 6), velocities and angular velocities about the mean of the contacts, and that mean.

    Their length is 1, a rotation counted by the speed of the contact that is farthest from the mean.
    """
    centre = contacts.point.mean(0)
    size = np.linalg.norm(contacts.point - centre, axis=1).max()
    twists = random_directions(np.random.default_rng(seed), count, 6)
    twists[:, 3:] /= size
    return twists, centre


def wrenches(contacts: Contacts, centre):
    """Return what a twist is multiplied by for the rate at which each contact comes apart, (k, 6)."""
    return np.concatenate([contacts.normal, np.cross(contacts.point - centre, contacts.normal)], 1)


def blocked_at(twists, centre, points: Contacts, limit):
    """Return how far each twist goes until a point blocks, (count,)."""
    approach = -(twists @ wrenches(points, centre).T)
    room = np.where(approach > SLOWEST, np.maximum(points.separation, 0), np.inf)
    return (room / np.maximum(approach, SLOWEST)).min(1, initial=limit)


def penetration_allowed(contacts: Contacts, points: Contacts, gap, count=TWISTS, seed=SEED):
    """Return how much deeper than at the start the near faces get along each twist [m], (count,)."""
    twists, centre = random_twists(contacts, count, seed)
    moved = twists * blocked_at(twists, centre, points, 2 * gap)[:, None]
    across, at_start = wrenches(contacts, centre).T, max(0.0, -contacts.separation.min())
    parts = np.split(moved, range(CHUNK, count, CHUNK))
    least = np.concatenate([(part @ across + contacts.separation).min(1) for part in parts])
    return np.maximum(0.0, -least) - at_start
