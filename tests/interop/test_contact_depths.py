"""Depths of a CollisionManager's contacts: penetration depths that are known, and FCL's of convex solids."""

import math

import numpy as np
import pytest
import trimesh

import warp_abtree as ab

pytest.importorskip("fcl")
from trimesh.collision import CollisionManager as TrimeshManager
from trimesh.transformations import translation_matrix as shift


def test_depths_as_of_convex_solids(device):
    """Balls and boxes that a straight way frees: the depth that FCL finds by expanding a polytope."""
    theirs, ours = managers = TrimeshManager(), ab.CollisionManager(device)
    for manager in managers:
        manager.add_object("box", trimesh.creation.box((4, 4, 4)))
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    for sink in (0.05, 0.2, 0.4):
        at = shift((0.1, 0.2, 2.5 - sink))
        distance, data = ours.min_distance_single(ball, at, return_data=True)
        assert distance == data.distance == pytest.approx(theirs.min_distance_single(ball, at), abs=1e-5)
        assert distance == pytest.approx(-sink, abs=1e-9)
        _, contacts = ours.in_collision_single(ball, at, return_data=True)
        assert all(contact.depth == pytest.approx(sink, abs=1e-9) for contact in contacts) and contacts
        assert ours.min_distance_internal() == math.inf
    surfaces = ab.CollisionManager(device, solids=False)
    surfaces.add_object("box", trimesh.creation.box((4, 4, 4)))
    assert surfaces.min_distance_single(ball, shift((0.1, 0.2, 2.1))) == 0
    _, contacts = surfaces.in_collision_single(ball, shift((0.1, 0.2, 2.4)), return_data=True)
    assert all(contact.depth == pytest.approx(0.1, abs=1e-9) for contact in contacts) and contacts


@pytest.mark.parametrize("solids", [True, False])
@pytest.mark.parametrize(
    ("first", "second", "offset", "depth"),
    [
        ((12, 12, 1), (1, 1, 10), (0, 0, 0), 5.5),
        ((6, 1, 1), (1, 6, 0.6), (0, 0, 0), 0.8),
        ((1, 1, 1), (0.5, 0.5, 0.5), (0.1, 0.2, 0.73), 0.02),
        ((1, 1, 1), (1, 1, 1), (0, 0, 1), 0),
    ],
    ids=["pin through a plate", "crossing bars", "press fit", "touching"],
)
def test_depths_are_penetration_depths(device, first, second, offset, depth, solids):
    """Of all contacts of a pair, in both orders and turned as one; moved by their ways out, objects come free."""
    ours, other = (ab.CollisionManager(device, solids) for _ in range(2))
    turn = trimesh.transformations.random_rotation_matrix(np.array([0.3, 0.1, 0.8]))
    place = shift((3, -2, 1)) @ turn if depth else np.eye(4)
    ours.add_object("a", trimesh.creation.box(first), place)
    ours.add_object("far", trimesh.creation.box(first), shift((99, 0, 0)))
    at, mesh = place @ shift(offset), trimesh.creation.box(second)
    other.add_object("b", mesh, at)
    answers = [ours.in_collision_other(other, return_data=True), other.in_collision_other(ours, return_data=True)]
    ours.add_object("b", mesh, at)
    answers.append(ours.in_collision_internal(return_data=True))
    for hit, contacts in answers:
        assert hit and contacts
        for contact in contacts:
            assert contact.names == {"a", "b"} and contact.depth == pytest.approx(depth, abs=1e-9)
            assert np.linalg.norm(contact.way_out("a")) == pytest.approx(contact.depth)
            np.testing.assert_array_equal(contact.way_out("a"), -contact.way_out("b"))
    for name, start in (("a", place), ("b", at)) if depth else ():
        for part, expected in ((1 - 1e-6, True), (1 + 1e-9, False)):
            moved = start.copy()
            moved[:3, 3] += part * contacts[0].way_out(name)
            ours.set_transform(name, moved)
            assert ours.in_collision_internal() == expected
        ours.set_transform(name, start)
