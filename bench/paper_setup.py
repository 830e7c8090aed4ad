"""What the experiments of the paper share: its three models, pairs of objects in contact, launches of one refit."""

import copy

import numpy as np

import warp_abtree as ab
from warp_abtree import testing

from .shapes import centre_and_radius
from .update import forced

# Nothing public hands out the batch of an update.

# Of table 1: the paper's name, its faces and vertices of M^n and M^0; then ours, the best at hand first.
PAPER_MODELS = (
    ("bones", (4204, 2154), (10, 39), ("fandisk 4204", "warp:bear"), 10),
    ("cow", (5804, 2904), (10, 8), ("cow", "warp:rocks"), 10),
    ("bunny", (57563, 25000), (500, 1406), ("bunny 57564", "warp:bunny"), 500),
)


def paper_models(context, largest=True) -> list:
    """Return the models in place of bones, cow and bunny; without the bunny where a quick run leaves it out."""
    rows = PAPER_MODELS if largest or not context.quick else PAPER_MODELS[:2]
    return [context.model(*names, base_faces=base_faces) for _, _, _, names, base_faces in rows]


def longest_side(model) -> float:
    """Return the longest side of a model's box [model units]."""
    return float(np.ptp(model.mesh_at(model.lod_max)[0], axis=0).max())


class Approach:
    """Poses of copies of a model, B, around another one, A, object 0 of a scene, each along a direction of its own.

    Attributes:
        free: Distance of the centres just beyond the last contact of each B on its way out [model units], (count,).
    """

    def __init__(self, scene, model, count, steps, seed=0):
        rng = np.random.default_rng(seed)
        self.centre, radius = centre_and_radius(model)
        away = rng.normal(size=(count, 3))
        self.away = away / np.linalg.norm(away, axis=1, keepdims=True)
        x, y, z, w = (lambda q: q / np.linalg.norm(q, axis=0))(rng.normal(size=(4, count)))
        self.matrices = np.tile(np.eye(4), (count + 1, 1, 1))
        self.matrices[1:, 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], 1)
        self.matrices[1:, 1, :3] = np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], 1)
        self.matrices[1:, 2, :3] = np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], 1)
        self.scene = scene
        self.pairs = np.stack([np.zeros(count, np.int32), np.arange(1, count + 1, dtype=np.int32)], 1)
        self._find_contact(2 * radius, steps)

    def _find_contact(self, reach, steps):
        """Find where B is last in contact on its way out, by steps and then by bisection, and first is not."""
        query = ab.Query(self.scene, "any", pairs=self.pairs)

        def meets(along):
            self.place(along)
            return query.run().any

        low = np.zeros(len(self.pairs))
        for along in np.linspace(0, reach, steps):
            low = np.where(meets(np.full(len(low), along)), along, low)
        high = low + reach / (steps - 1)
        for _ in range(50):
            middle = (low + high) / 2
            met = meets(middle)
            low, high = np.where(met, middle, low), np.where(met, high, middle)
        self.free = high

    def place(self, along):
        """Pose every B with its centre a distance [model units] from A's."""
        self.matrices[1:, :3, 3] = self.centre + along[:, None] * self.away - self.matrices[1:, :3, :3] @ self.centre
        self.scene.set_poses(self.matrices)


class PosedPairs:
    """Pairs of objects of one model in random rotations: A at the origin, B so far pushed into it along a way out.

    Args:
        lods: LODs of A and of B.
        firsts: Objects A, one for all pairs or one for each; every one has a tree state of its own.
        share: Whether the one A is of B's model, so that they share a state where they stand at one LOD.

    Attributes:
        scene: `Scene`; objects 0 to firsts-1 are A.
        pairs: Object pairs, int (count, 2).
        matrices: Poses of all objects since the last push, (objects, 4, 4).
    """

    def __init__(self, model, count, device, lods=None, firsts=1, share=False, steps=32):
        lods = (model.lod_max, model.lod_max) if lods is None else lods
        finder = ab.Scene(device)
        finder.add(model)
        for _ in range(count):
            finder.add(model)
        self._approach = Approach(finder, model, count, steps)
        self._size = longest_side(model)
        self._firsts = firsts
        self.scene = ab.Scene(device)
        for _ in range(self._firsts):
            self.scene.add(model if share else copy.copy(model), lod=lods[0])
        for _ in range(count):
            self.scene.add(model, lod=lods[1])
        first = np.arange(count) % firsts
        self.pairs = np.stack([first, self._firsts + np.arange(count)], 1)

    def push(self, depth):
        """Pose every B so far inside from where it last touches A on its way out, as a part of A's longest side."""
        approach = self._approach
        approach.place(approach.free - depth * self._size)
        still = np.tile(np.eye(4), (self._firsts, 1, 1))
        self.matrices = np.concatenate([still, approach.matrices[1:]])
        self.scene.set_poses(self.matrices)

    def like(self, model, device):
        """Return a scene of another model, the same objects at the same poses."""
        scene = ab.Scene(device)
        for matrix in self.matrices:
            scene.add(model, matrix)
        return scene


def hear_batch(scene, lods, share):
    """Set LODs by one kind of refit (`update.REGIMES`) and return the batch of that update."""
    with forced(share):
        return scene.set_lods(lods)


def refit_launch(scene, batch):
    """Return a launch of marking and refit alone, the LODs being those that the batch leads to; it may be repeated."""
    return testing.repeat_update(batch, refine=False)
