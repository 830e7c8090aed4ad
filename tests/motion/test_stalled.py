"""Linear CCD in double words, alone: times that are never late, coordinates that err, and faces that are segments."""

from fractions import Fraction
from itertools import permutations

import numpy as np
import pytest
import warp as wp
from helpers.questions import launch

from warp_abtree.kernels import native
from warp_abtree.kernels.motion.face_pair import CLEAR, TOUCHES, FirstContact
from warp_abtree.kernels.motion.stalled import apart_until, words_type

wp.set_module_options(native.options("exact/apart_until.cuh"))

FACE = [(0, 0, 0), (4, 0, 0), (0, 4, 0)]
START = 2.0**-20  # before which faces are apart
ENDS = (0, 1, 1), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1)  # of segments as faces


@wp.kernel
def apart_kernel(
    starts: wp.array2d[wp.vec3d], ends: wp.array2d[wp.vec3d], error: wp.array[wp.float64], out: wp.array2d[wp.float64]
):
    i = wp.tid()
    first, last, contact = words_type(), words_type(), FirstContact()
    for k in range(6):
        for j in range(3):
            first[k, j] = starts[i, k][j]
            last[k, j] = ends[i, k][j]
    apart_until(first, last, wp.vec3d(), error[i], wp.float64(START), wp.float64(1.0), contact)
    out[i, 0] = contact.time
    out[i, 1] = wp.float64(contact.end)


def find(device, starts, ends, error=0.0):
    """Return times and outcomes of faces whose corners (n, 6, 3), A's first, move straight."""
    starts, ends = (np.ascontiguousarray(x, dtype=float) for x in (starts, ends))
    errors = np.broadcast_to(np.asarray(error, float), len(starts)).copy()
    time, end = launch(apart_kernel, device, len(starts), starts, ends, errors, columns=2).T
    return time, end.astype(int)


def over(n, height):
    """Return A's face and one of B with a corner over it, n times."""
    return np.tile([*FACE, (1, 1, height), (2, 1, height + 1), (1, 2, height + 1)], (n, 1, 1)).astype(float)


def test_times_are_never_late(device):
    """A corner comes down on a face at 1 / n: floats are over that as often as under it."""
    n = np.arange(2, 300)
    starts, ends = over(len(n), 1.0), over(len(n), 1.0)
    ends[:, 3:, 2] -= n[:, None]
    time, end = find(device, starts, ends)
    assert (end == int(TOUCHES)).all()
    truth = [Fraction(1, k) for k in n.tolist()]
    assert np.mean([1 / k > exact for k, exact in zip(n.tolist(), truth)]) > 0.3
    for t, exact in zip(time.tolist(), truth):
        assert exact * (1 - Fraction(1, 2**50)) <= Fraction(t) <= exact


@pytest.mark.parametrize("height", [1.0, 2.0**-30, 2.0**-60])
def test_what_coordinates_err_by_may_close_a_gap(device, height):
    """A corner stays at a height over a face; both may be off by half of that, or by much less."""
    starts, ends = over(2, height), over(2, height)
    ends[:, 3:, 0] += 0.5
    time, end = find(device, starts, ends, [height / 2, height * 2.0**-12])
    assert end[0] != int(CLEAR) and time[0] < 1 and end[1] == int(CLEAR) and time[1] == 1


@pytest.mark.parametrize("meets", [False, True])
def test_segments_are_alike_whichever_corner_is_twice(device, meets):
    """A segment as a face passes one end of an edge of the other, or crosses that."""
    p, q = (1, -2, 0.5), (1, 2, 0.5) if meets else (1, -1, 0.5)
    rows = [list(corners) for corners in {*permutations([p, p, q]), *permutations([p, q, q])}]
    starts = np.array([[*FACE, *row] for row in rows] + [[*row, *FACE] for row in rows], float)
    ends = starts.copy()
    half = len(rows)
    ends[:half, 3:, 2] -= 1
    ends[half:, :3, 2] -= 1
    time, end = find(device, starts, ends)
    assert (end == int(TOUCHES if meets else CLEAR)).all() and (np.ptp(time[:half]), np.ptp(time[half:])) == (0, 0)
    assert time == pytest.approx(0.5 if meets else 1.0, abs=1e-12)


@pytest.mark.parametrize(("way", "outcome"), [(3, TOUCHES), (1.75, CLEAR)])
def test_segments_on_one_line_meet_end_to_end(device, way, outcome):
    """Either way round, whichever corner is twice."""
    first, second = np.array([(0, 0, 0), (1, 0, 0)], float), np.array([(3, 0, 0), (4, 0, 0)], float)
    starts = np.array([[*first[list(a)], *second[list(b)]] for a in ENDS for b in ENDS])
    ends = starts + np.array([way, 0, 0]) * (np.arange(6) < 3)[:, None]
    time, end = find(device, starts, ends)
    assert (end == int(outcome)).all()
    assert time == pytest.approx(2 / 3 if outcome == TOUCHES else 1.0, abs=1e-12)


@pytest.mark.parametrize("aside", [0.0, 2.0**-40])
def test_faces_that_are_points(device, aside):
    """A point that goes on to another, to an end or an inside of a segment, or to a face, or past; in either order."""
    others = np.array([[(1, 0, 0)] * 3, [(1, 0, 0), (1, 0, 0), (2, 0, 0)], [(1, -1, 0), (1, 2, 0), (1, 2, 0)]], float)
    others = np.concatenate([others, [[(1, -1, -1), (1, 2, -1), (1, -1, 2)]]])
    point = np.tile([0, aside, 0], (len(others), 3, 1))
    starts = np.concatenate([np.concatenate([point, others], 1), np.concatenate([others, point], 1)])
    ends = starts + np.array([1.5, 0, 0]) * (starts[:, :, :1] == 0)
    time, end = find(device, starts, ends)
    meets = np.tile([aside == 0, aside == 0, True, True], 2)
    np.testing.assert_array_equal(end, np.where(meets, int(TOUCHES), int(CLEAR)))
    np.testing.assert_allclose(time, np.where(meets, 2 / 3, 1.0), atol=1e-12)
