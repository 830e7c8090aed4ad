"""Random motions of samples, and their first contacts."""

import numpy as np

from helpers.questions import pairs_of, random_lod, scene_of
from helpers.samples import random_poses, sample

NAMES = ("box", "small ball", "crumbs", "soup", "torus", "three", "capsule", "one", "lattice soup", "twins")
ANSWERS = ("time", "clear", "undecided")
STILL = np.array([0, 0, 0, 0, 0, 0, 1.0])
FACES = 60


def to_bytes(result):
    return [np.asarray(getattr(result, name)).tobytes() for name in ANSWERS]


def random_motions(rng, count, names=NAMES, faces=FACES, spread=2.0):
    """Return cases at their starts, apart as a rule, and end poses (2 count, 7)."""
    cases, ends = [], []
    for _ in range(count):
        models = [sample(name) for name in rng.choice(names, 2)]
        starts, ends_now = (random_poses(rng, 2, spread) for _ in range(2))
        cases.append([x for m, pose in zip(models, starts) for x in (m, random_lod(rng, m, faces), pose)])
        ends.append(ends_now)
    return cases, np.concatenate(ends)


def find(device, cases, ends, **options):
    return scene_of(device, cases).first_contact(pairs_of(cases), ends, **options)
