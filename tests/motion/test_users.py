"""Users of first contacts: the collision manager."""

import numpy as np
import pytest
import trimesh
from helpers import refused
from trimesh.transformations import rotation_matrix, translation_matrix

import warp_abtree as ab


def test_collision_manager(device):
    manager = ab.CollisionManager(device)
    assert manager.first_contact_internal({}, return_names=True) == (1.0, None)
    box = trimesh.creation.box()
    for name, x in (("a", 0.0), ("b", 3.0), ("c", -4.0)):
        manager.add_object(name, box, translation_matrix((x, 0, 0)))
    assert manager.first_contact_internal({}) == 1.0
    # b reaches a after 2 of 4, c after 3 of 4.
    ends = {"b": translation_matrix((-1.0, 0.1, 0.2)), "c": translation_matrix((0.0, 0.1, 0.2))}
    time, names = manager.first_contact_internal(ends, return_names=True)
    assert names == ("a", "b") and time == pytest.approx(0.5, abs=1e-6) and time <= 0.5
    # What moves ends nowhere: the objects stand where they stood.
    assert manager.first_contact_internal(ends) == time and not manager.in_collision_internal()
    manager.remove_object("b")
    assert manager.first_contact_internal({"c": translation_matrix((0.0, 0.1, 0.2))}) == pytest.approx(0.75, abs=1e-6)
    manager.set_transform("c", translation_matrix((0.2, 0, 0)))
    assert manager.first_contact_internal({}, return_names=True) == (0.0, ("a", "c"))
    manager.set_transform("c", translation_matrix((-4, 0, 0)))
    for ends, message in (
        ({"d": np.eye(4)}, "d not in"),
        ({"c": 2 * np.eye(4)}, "not rigid"),
        ({"c": rotation_matrix(np.pi, (0, 0, 1))}, "half a revolution"),
    ):
        refused(ValueError, message, manager.first_contact_internal, ends)
