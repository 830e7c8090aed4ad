"""Steps in time and turns of `kernels.motion`, each by itself: in fractions no step is too long, nor any sum."""

import math
from fractions import Fraction

import numpy as np
import pytest
import warp as wp
from helpers.motions import STILL, find
from helpers.questions import launch, pairs_of, scene_of
from helpers.samples import corners_of, model_of_faces, random_quaternions
from oracles.motion import translation_contact
from oracles.triangle import fractions, quaternion_matrix

from warp_abtree.kernels.motion.face_pair import bend_of_face, safe_step, step_along, time_after
from warp_abtree.kernels.motion.linear import straight_step
from warp_abtree.kernels.motion.node_pair import later, step_of
from warp_abtree.kernels.motion.path import Moment, Motion
from warp_abtree.kernels.motion.turn import shortest_turn, sin_cos_half, turn_matrix
from warp_abtree.kernels.triangle.distance import corners_type

COUNT = 1000


@wp.kernel(module="unique", module_options={"fuse_fp": False})
def float32_step_kernel(x: wp.array2d(dtype=wp.float32), out: wp.array2d(dtype=wp.float32)):
    i = wp.tid()
    out[i, 0] = later(wp.float32(0.0), step_of(x[i, 0], x[i, 1], x[i, 2]))
    out[i, 1] = later(x[i, 3], x[i, 4])


@wp.kernel(module="unique", module_options={"fuse_fp": False})
def float64_step_kernel(x: wp.array2d(dtype=wp.float64), out: wp.array2d(dtype=wp.float64)):
    i = wp.tid()
    out[i, 0] = step_along(x[i, 0], x[i, 1], x[i, 2])
    out[i, 1] = time_after(x[i, 3], x[i, 4])


STEPS = (float32_step_kernel, np.float32, 2.0**-21), (float64_step_kernel, np.float64, 0)


@pytest.mark.parametrize(("kernel", "real", "off"), STEPS, ids=["float32", "float64"])
def test_no_step_is_too_long(device, kernel, real, off):
    """A gap is still open where a step ends, and a time is not after what it sums, of a step that may be off."""
    rng = np.random.default_rng(1)
    x = 10 ** rng.uniform(-5, 1, (COUNT, 5))
    x[:, 1] *= rng.choice([-1, 1], COUNT)
    x[:, 2] *= rng.choice([1, 2.0**-70 if real is np.float32 else 0], COUNT)
    x[:, 3] = rng.uniform(0.5, 1, COUNT) * rng.choice([0, 1], COUNT)
    x = x.astype(real)
    steps = launch(kernel, device, COUNT, x, columns=2)
    for (gap, rate, bend, t, step), (h, then) in zip(x.tolist(), steps.tolist(), strict=True):
        assert h > 0
        if h < np.inf:
            h = Fraction(h)
            assert Fraction(gap) + Fraction(rate) * h - Fraction(bend) * h * h / 2 >= 0
        else:
            assert bend == 0 and rate >= 0
        assert Fraction(then) <= Fraction(t) + Fraction(step) * (1 - Fraction(off)) or then == t
    x = np.array([[gap, rate, bend, 0, 0] for gap in (0, -1, np.nan) for rate in (-1, 0, 1) for bend in (0.5, 1)])
    assert (launch(kernel, device, len(x), x.astype(real), columns=2) == 0).all(), "what is no gap has no step"


@wp.struct
class Slide:
    """Two faces, how the mover's points lie and move in the base's frame, and what both err by."""

    n: wp.vec3d
    base: corners_type
    mover: corners_type
    moment: Moment
    slack: wp.float64
    speed_slack: wp.float64
    bend: wp.vec2d


@wp.kernel(module="unique", module_options={"fuse_fp": False})
def safe_step_kernel(slides: wp.array(dtype=Slide), out: wp.array2d(dtype=wp.float64)):
    i = wp.tid()
    s = slides[i]
    motion = Motion()
    motion.slack = s.slack
    motion.speed_slack = s.speed_slack
    motion.bend_size = s.bend[0]
    motion.bend_rest = s.bend[1]
    motion.axis_b = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))
    at, way = corners_type(), corners_type()
    for k in range(3):
        at[k] = s.moment.rotation * s.mover[k] + s.moment.shift
        way[k] = s.moment.spin * s.mover[k] + s.moment.speed
    out[i, 0] = safe_step(motion, s.n, s.base, at, way, bend_of_face(motion, s.mover))
    out[i, 1] = straight_step(s.slack, s.n, s.base, at, corners_type(), way)


def test_steps_of_faces_leave_room_for_all_that_they_may_be_off(device):
    """Slacks so large that each shows: gaps are narrower by one, speeds are less by the other."""
    rng, rows = np.random.default_rng(2), []
    for _ in range(200):
        n = rng.normal(size=3)
        row = {"n": n / np.linalg.norm(n), "base": rng.uniform(-1, 1, (3, 3)), "mover": rng.uniform(-1, 1, (3, 3))}
        row |= {"rotation": rng.normal(size=(3, 3)), "shift": 8 * row["n"] + rng.normal(size=3)}
        row |= {"spin": rng.normal(size=(3, 3)), "speed": rng.normal(size=3) - 3 * row["n"]}
        rows.append(row | dict(zip(("slack", "speed_slack", "bend"), (*rng.uniform(0, 1, 2), rng.uniform(0, 1, 2)))))
    slides = np.zeros(len(rows), Slide.numpy_dtype())
    for k, row in enumerate(rows):
        for name, value in row.items():
            (slides["moment"] if name in Moment.vars else slides)[name][k] = value
    found = launch(safe_step_kernel, device, len(rows), wp.array(slides, dtype=Slide, device=device), columns=2)
    for row, (bent, straight) in zip(rows, found, strict=True):
        n, top = row["n"], (row["base"] @ row["n"]).max() + row["slack"]
        gaps = (row["mover"] @ row["rotation"].T + row["shift"]) @ n - top
        rates = (row["mover"] @ row["spin"].T + row["speed"]) @ n
        bends = row["bend"][0] * np.full(3, np.linalg.norm(row["mover"][:, :2], axis=1).max()) + row["bend"][1]
        slower = rates - row["speed_slack"], rates - row["slack"]
        for step, rate, bend in zip((bent, straight), slower, (bends, 0 * bends)):
            times = [step_in(*terms) for terms in zip(gaps, rate, bend)]
            assert step == pytest.approx(min(times), rel=1e-10)


def step_in(gap, rate, bend):
    """Return the first root of gap + rate h - bend h^2 / 2, 0 without a gap."""
    if gap <= 0:
        return 0.0
    roots = np.roots([-bend / 2, rate, gap])
    return min((h for h in roots.real if h > 0), default=np.inf)


ROUNDED = [(1e6, 1.0, False), (1e6, 1.0, True), (1e6, 1e-3, False), (0.0, 1e-6, True), (30.0, 1e6, False)]


@pytest.mark.parametrize(("far", "size", "linear"), ROUNDED)
def test_contacts_are_not_late_where_float64_rounds_much(device, far, size, linear):
    """Small faces far from the origin, or from their frames, in fractions: rounding alone moves what they meet by."""
    rng = np.random.default_rng(3)
    cases, ends, truths = [], [], []
    for k in range(24):
        a, b = (size * (rng.normal(size=(1, 1, 3)) + rng.normal(size=(2, 3, 3))) for _ in range(2))
        off = far * rng.normal(size=(2, 3)) * (k % 2)
        models = [model_of_faces(soup + x, base_faces=2) for soup, x in zip((a, b), off)]
        still, start = np.array(STILL), np.array(STILL)
        still[:3] = far * rng.normal(size=3) - off[0]
        way = size * rng.normal(size=3)
        start[:3] = still[:3] + off[0] - off[1] - 3 * way
        end = start.copy()
        end[:3] += 6 * way
        cases.append([models[0], models[0].lod_max, still, models[1], models[1].lod_max, start])
        ends += [still, end]
        corners = [corners_of(model) for model in models]
        first, last = fractions(start[:3]), fractions(end[:3])
        posed = fractions(corners[0]) + fractions(still[:3]), fractions(corners[1]) + first
        truths.append(translation_contact(*posed, last - first))
    result = find(device, cases, np.array(ends), tolerance=2.0**-40, linear=linear)
    met = scene_of(device, cases).intersect(pairs_of(cases)).any
    touching = [truth is not None for truth in truths]
    assert sum(touching) > 5
    for truth, hit, time, clear in zip(truths, met, result.time.tolist(), result.clear, strict=True):
        if not hit and truth is not None:
            assert not clear and Fraction(time) <= truth


@wp.kernel(module="unique", module_options={"fuse_fp": False})
def halves_kernel(angle: wp.array(dtype=wp.float64), out: wp.array2d(dtype=wp.float64)):
    i = wp.tid()
    s, c = sin_cos_half(angle[i])
    out[i, 0] = s
    out[i, 1] = c


@wp.kernel(module="unique", module_options={"fuse_fp": False})
def turn_kernel(turn: wp.array(dtype=wp.mat33d), out: wp.array2d(dtype=wp.float64)):
    i = wp.tid()
    axis, angle, _ = shortest_turn(turn[i])
    back = turn_matrix(axis, angle)
    out[i, 0] = angle
    for j in range(9):
        out[i, 1 + j] = back[j / 3, j % 3]


def test_sines_are_those_of_float64(device):
    angles = np.linspace(0, math.pi, 20001)
    found = launch(halves_kernel, device, len(angles), angles, columns=2)
    truth = np.array([[math.sin(0.5 * x), math.cos(0.5 * x)] for x in angles])
    assert np.abs(found - truth).max() <= 4 * 2.0**-53


@pytest.mark.parametrize("angle", [3.14159, 3.0, 1.0, 1e-3, 1e-9, 1e-15, 0.0])
def test_turns_are_found_again(device, angle):
    axes = np.random.default_rng(1).normal(size=(200, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    turns = np.array([quaternion_matrix([*(math.sin(angle / 2) * axis), math.cos(angle / 2)]) for axis in axes])
    found = launch(turn_kernel, device, len(turns), turns, columns=10)
    assert np.abs(found[:, 0] - angle).max() <= 40 * 2.0**-53
    assert np.abs(found[:, 1:].reshape(-1, 3, 3) - turns).max() <= 40 * 2.0**-53


def test_half_revolutions_are_none(device):
    turns = np.array([quaternion_matrix([*q[:3], 0]) for q in random_quaternions(np.random.default_rng(2), 50)])
    assert (launch(turn_kernel, device, len(turns), turns, columns=10)[:, 0] == -1).all()
