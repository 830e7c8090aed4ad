"""Table 1: the models, and pairs of their objects in contact."""

import copy
import time
from functools import partial

import numpy as np

import warp_abtree as ab

from ...shapes import longest_side
from ..motions import Motions, find_first_contact

# The paper's name, its faces and vertices of M^n and M^0; then ours, the best at hand first, and its base faces. The
# paper's cow is at hand; its bunny is collapsed from the Stanford bunny; another mesh of as many faces is its bones.
PAPER_MODELS = (
    ("bones", (4204, 2154), (10, 39), ("fandisk 4204", "warp:bear"), 10),
    ("cow", (5804, 2904), (10, 8), ("cow", "warp:rocks"), 10),
    ("bunny", (57563, 25000), (500, 1406), ("bunny 57564", "warp:bunny"), 500),
)


def paper_models(context, largest=True) -> list:
    """Return the models in place of bones, cow and bunny; without the bunny where a quick run leaves it out."""
    rows = PAPER_MODELS if largest or not context.quick else PAPER_MODELS[:2]
    return [context.model(*names, base_faces=base_faces) for _, _, _, names, base_faces in rows]


def run(context):
    """Yield one row a model. Vertices are those that faces use; build is collapse, error bounds and tree, CPU time."""
    for (name, finest, base, _, base_faces), model in zip(PAPER_MODELS, paper_models(context), strict=True):
        vertices, faces, _ = model.mesh_at(model.lod_max)
        begin = time.process_time()
        again = ab.Model.from_arrays(vertices, faces, base_faces=base_faces)
        seconds = time.process_time() - begin
        if again.lod_max != model.lod_max:
            raise RuntimeError(f"{model.name}: built again it has {again.lod_max} splits, not {model.lod_max}")
        coarse_vertices, coarse_faces, _ = model.mesh_at(0)
        row = {"paper_model": name, "model": model.name}
        row |= {"paper_faces": finest[0], "faces": len(faces), "paper_vertices": finest[1], "vertices": len(vertices)}
        row |= {"paper_base_faces": base[0], "base_faces": len(coarse_faces)}
        row |= {"paper_base_vertices": base[1], "base_vertices": len(coarse_vertices)}
        yield row | {"splits": model.lod_max, "build_s": seconds}


class PosedPairs:
    """Pairs of objects of one model in random rotations: A at the origin, B moved into it along a random direction.

    Args:
        first_count: Objects A; every pair takes one of them in turn.
        share: Whether A is of B's model, so that they share a tree state where they stand at one LOD.

    Attributes:
        scene: `Scene`; its first objects are A.
        pairs: Object pairs, int (count, 2).
        poses: Of all objects since they were placed, (objects, 7).
    """

    def __init__(self, model, count, device, first_count=1, share=False, steps=32):
        self.motions = Motions(np.random.default_rng(0), count, model, model)
        ask = partial(ab.sweep, model, model, device=device)
        _, self._free = find_first_contact(ask, self.motions, steps, bisections=50)
        self._size, self._first_count = longest_side(model), first_count
        self.scene = ab.Scene(device)
        firsts = [model if share else copy.copy(model) for _ in range(first_count)]
        self.scene.add_many([*firsts, *[model] * count], np.tile([0.0, 0, 0, 0, 0, 0, 1], (first_count + count, 1)))
        self.pairs = np.stack([np.arange(count) % first_count, first_count + np.arange(count)], 1)

    def place(self, depth):
        """Pose every B so far behind its first contact, as a fraction of A's longest side."""
        still = np.tile([0.0, 0, 0, 0, 0, 0, 1], (self._first_count, 1))
        self.poses = np.concatenate([still, self.motions.poses(self._free - depth * self._size)])
        self.scene.set_poses(self.poses)
