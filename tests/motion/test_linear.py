"""First contacts where vertices move straight: whole meshes, and public queries with ground truth."""

import numpy as np
import pytest
from helpers import refused
from helpers.motions import STILL, find, random_motions
from helpers.questions import in_a_row
from oracles.motion import apart_until, straight_soups
from oracles.triangle import box_pairs, pairs_intersect

from bench.motions.ccd_queries import FOLDER, read_queries
from warp_abtree import testing

TOLERANCE = 1e-6


def soups_intersect(a, b):
    """Return whether corners (f, 3, 3) have a point in common, in integers."""
    pairs = box_pairs(a, b)
    corners = [np.arange(3 * len(soup)).reshape(-1, 3) for soup in (a, b)]
    return pairs_intersect(a.reshape(-1, 3), corners[0], b.reshape(-1, 3), corners[1], pairs).any()


def test_never_late_and_early_by_the_tolerance(device):
    cases, ends = random_motions(np.random.default_rng(1), 40, ("box", "small ball", "torus", "soup"), 40, 1.5)
    result = find(device, cases, ends, linear=True)
    assert not result.undecided.any() and 10 < result.clear.sum() < 35 and (result.time == 0).sum() < 10
    for case, path, time, clear in zip(cases, ends.reshape(-1, 2, 7), result.time, result.clear, strict=True):
        meshes = [model.mesh_at(lod)[:2] for model, lod in (case[:2], case[3:5])]
        place, speed = straight_soups(meshes, (case[2], case[5]), path)
        if time > 0:
            assert apart_until(place, speed, 1e-3) <= time + TOLERANCE
            for part in (0.0, 0.3, 0.6, 0.8, 0.9, 0.97, 0.999, 1.0):
                assert not soups_intersect(*place(part * time))
        if not clear:
            assert soups_intersect(*place(min(time + TOLERANCE, 1.0) if time > 0 else 0.0))


def test_without_turns_it_is_the_rigid_motion(device):
    cases, ends = random_motions(np.random.default_rng(3), 30)
    for case, path in zip(cases, ends.reshape(-1, 2, 7)):
        path[:, 3:] = case[2][3:], case[5][3:]
    rigid, straight = (find(device, cases, ends, linear=linear) for linear in (False, True))
    np.testing.assert_array_equal(rigid.clear, straight.clear)
    np.testing.assert_allclose(rigid.time, straight.time, rtol=0, atol=TOLERANCE)


def test_half_revolutions_have_straight_ways(device):
    scene = in_a_row(device, "box", (0, 8))
    ends = [STILL, [8, 0, 0, 0, 0, 1, 0]]
    assert scene.first_contact([(0, 1)], ends, linear=True).clear.all()
    refused(ValueError, "one kind of path", scene.first_contact, [(0, 1)], ends, linear=True, screw=True)


def test_public_queries_are_told_from_contacts(device):
    """Ground truth in rational numbers; one of them comes within 2^-105 of its size."""
    files = sorted(FOLDER.glob("*.csv.gz"))
    if not files:
        pytest.skip("queries of continuous collision detection are not at hand; ABTREE_CCD names their folder")
    beyond = 0
    for path in files:
        starts, ends, truth = read_queries(path)
        _, clear, undecided = testing.advance_corners(starts, ends, TOLERANCE, device)
        assert not clear[truth].any() and not undecided.any()
        beyond += (~truth & ~clear).sum()
    assert beyond <= 1
