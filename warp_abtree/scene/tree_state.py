"""The AB-Tree of an object, read to the host."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class TreeState:
    """The AB-Tree of one object at its LOD, on the host.

    Attributes:
        lod: Where it stands.
        status: 0 inactive, 1 active, per heap node (the root is 1), int32.
        lower, upper: Boxes [model units], model frame, float64 (nodes, 3), rounded outwards; (+inf, -inf) where
            inactive.
        skip: The node that a traversal visits in place of each, -1 where inactive, int32.
        face_node: Leaf of each face, int32 (n_f,).
    """

    lod: int
    status: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    skip: np.ndarray
    face_node: np.ndarray


def read_tree_state(batch, models, i: int) -> TreeState:
    """Return the `TreeState` of object i of a batch. Waits for the device."""
    batch.catch_up()
    states, slot = batch.states, batch.states.slots[batch.objects.state[i]]
    model = models[slot.model]
    lower, upper, skip = states.read_nodes(slot, model.tree.node_count)
    lower, upper = lower + model.centre, upper + model.centre
    return TreeState(
        slot.lod,
        (skip >= 0).astype(np.int32),
        np.where(np.isinf(lower), lower, np.nextafter(lower, -np.inf)),
        np.where(np.isinf(upper), upper, np.nextafter(upper, np.inf)),
        skip,
        model.tree.leaf_node.copy(),
    )
