"""Triangle pairs, random and adversarial, against integer arithmetic: disagreements, shares, error rates and times."""

import functools
import importlib.util
import itertools
import multiprocessing
import sys
import time
from pathlib import Path

import numpy as np
import warp as wp

from warp_abtree.kernels.arithmetic.predicates import EXACT, FILTER, FLOAT32, UNCERTAIN
from warp_abtree.kernels.triangle.float32_filter import FLOAT32_UNIT, float32_filter_triangles
from warp_abtree.kernels.triangle.float64_filter import decide_triangles

MODULE_OPTIONS = {"enable_backward": False, "fuse_fp": False}
ORACLE = Path(__file__).resolve().parents[1] / "tests" / "oracles" / "triangle.py"
CHUNK = 20_000
# Every so many adversarial pairs, one is asked in all orders; the others in one order each, in turn.
WHOLE_EVERY = 64
ORDERS = [
    (p, q, swap) for p in itertools.permutations(range(3)) for q in itertools.permutations(range(3)) for swap in (0, 1)
]


# --- pairs: functions of (rng, count), float64 (count, 2, 3, 3) ------------------------------------------------------


def generic(rng, count):
    """Triangles of all sizes near each other."""
    size = 2.0 ** rng.uniform(-3, 1, (count, 2, 1, 1))
    return rng.normal(size=(count, 2, 3, 3)) * size + 0.5 * rng.normal(size=(count, 2, 1, 3))


def lattice(rng, count):
    """Corners on a lattice of two to six points an axis: most pairs touch, are coplanar or have zero area."""
    return np.floor(rng.random((count, 2, 3, 3)) * rng.integers(2, 7, (count, 1, 1, 1)))


def coplanar(rng, count):
    """Both triangles in one oblique plane, exactly; some are segments and points."""
    u, v, origin = rng.integers(-(2**9), 2**9, (3, count, 1, 1, 3)).astype(float)
    s, t = rng.integers(-3, 4, (2, count, 2, 3, 1)).astype(float)
    return u * s + v * t + origin


def nearly_coplanar(rng, count):
    """The same, in a plane of real numbers, hence a rounding or two apart."""
    u, v, origin = rng.normal(size=(3, count, 1, 1, 3))
    s, t = rng.integers(-3, 4, (2, count, 2, 3, 1)).astype(float)
    return u * s + v * t + origin


def touch(rng, a):
    """Return triangles with a corner, or more, on a corner, an edge or the inside of others (count, 3, 3)."""
    count = len(a)
    weight = rng.choice([0.0, 0.25, 0.5, 1.0, -0.5], (count, 3, 3))
    weight[:, :, 2] = 1 - weight[:, :, 0] - weight[:, :, 1]
    return (weight[:, :, :, None] * a[:, None]).sum(2)


def touching(rng, count):
    """The second triangle starts on the first, exactly, and some of it lies in the first's plane."""
    a = 4.0 * rng.integers(-(2**8), 2**8, (count, 3, 3))
    off = rng.integers(0, 2, (count, 3, 1)) * rng.integers(-64, 65, (count, 3, 3))
    off[:, 0] = 0
    return np.stack([a, touch(rng, a) + off], 1)


def nudge(rng, pairs):
    """Move coordinates by up to two units in the last place."""
    return pairs + rng.integers(-2, 3, pairs.shape) * np.spacing(np.abs(pairs))


def ulp_perturbed(rng, count):
    """The same on real coordinates, every coordinate moved by up to two units in the last place."""
    a = rng.normal(size=(count, 3, 3)) + 2.0 ** rng.integers(-3, 12, (count, 1, 1)) * rng.normal(size=(count, 1, 3))
    off = rng.integers(0, 2, (count, 3, 1)) * rng.normal(size=(count, 3, 3))
    off[:, 0] = 0
    return nudge(rng, np.stack([a, touch(rng, a) + off], 1))


def shared(rng, count):
    """One to three corners shared to the bit, in any place, on real coordinates."""
    pairs = rng.normal(size=(count, 2, 3, 3)) * 2.0 ** rng.integers(-20, 20, (count, 1, 1, 1))
    number = rng.integers(1, 4, count)
    for corner in range(3):
        pairs[number > corner, 1, corner] = pairs[number > corner, 0, corner]
    order = rng.permuted(np.tile(np.arange(3), (count, 1)), axis=1)
    pairs[:, 1] = np.take_along_axis(pairs[:, 1], order[:, :, None], 1)
    return pairs


def nearly_shared(rng, count):
    """The same with every coordinate moved by up to two units in the last place."""
    return nudge(rng, shared(rng, count))


def collinear(rng, count):
    """Segments and points along a line or two, some against whole triangles."""
    origin, way = rng.integers(-4, 5, (2, count, 2, 1, 3)).astype(float)
    one_line = rng.random(count) < 0.3
    origin[one_line, 1], way[one_line, 1] = origin[one_line, 0], way[one_line, 0]
    segment = origin + way * rng.integers(-3, 4, (count, 2, 3, 1))
    whole = rng.random((count, 2, 1, 1)) < 0.3
    return np.where(whole, rng.integers(-4, 5, (count, 2, 3, 3)), segment).astype(float)


def zero_area(rng, count):
    """A segment or point of real coordinates against a triangle that it starts on, or nearly so."""
    a = rng.normal(size=(count, 3, 3))
    b = touch(rng, a) + rng.choice([0.0, 2.0**-52, 1.0], (count, 1, 1)) * rng.normal(size=(count, 3, 3))
    b[:, 2] = b[:, 1]
    point = rng.random(count) < 0.2
    b[point, 1] = b[point, 2] = b[point, 0]
    return np.stack([a, b], 1)


def sliver(rng, count):
    """Triangles of aspect 1e12 that start on one another."""
    corner, far, side = rng.normal(size=(3, count, 3))
    middle = rng.random((count, 1))
    a = np.stack([corner, corner + far, corner + middle * far + 1e-12 * side], 1)
    start = touch(rng, a)[:, 0]
    far, side = rng.normal(size=(2, count, 3))
    b = np.stack([start, start + far, start + rng.random((count, 1)) * far + 1e-12 * side], 1)
    ends = rng.random(count) < 0.5
    b[ends] += 1e-12 * rng.normal(size=(int(ends.sum()), 1, 3))
    return np.stack([a, b], 1)


def extreme(rng, count):
    """Pairs of the kinds above at magnitudes from 2^-270 to 2^140, or coordinates of mixed magnitude."""
    pairs = np.concatenate([make(rng, -(-count // 4)) for make in (generic, touching, ulp_perturbed, lattice)])[:count]
    scale = np.where(rng.random((count, 1, 1, 1)) < 0.5, 0, rng.integers(-40, 41, pairs.shape))
    return clear_tiny(np.ldexp(pairs, scale + rng.integers(-240, 90, (count, 1, 1, 1))))


def clear_tiny(pairs):
    """Coordinates under 2^-290 are 0, as in the library."""
    return np.where(np.abs(pairs) < 2.0**-290, 0.0, pairs)


ADVERSARIAL = {
    make.__name__: make
    for make in (
        lattice,
        coplanar,
        nearly_coplanar,
        touching,
        ulp_perturbed,
        shared,
        nearly_shared,
        collinear,
        zero_area,
        sliver,
        extreme,
    )
}
KINDS = {"random": generic, **ADVERSARIAL}


def make_chunk(job):
    """Return the pairs of (kind, chunk number, count), the same to the bit whoever asks."""
    kind, number, count = job
    seed = [list(KINDS).index(kind), number]
    return clear_tiny(KINDS[kind](np.random.default_rng(seed), count))


# --- answers ---------------------------------------------------------------------------------------------------------


@functools.cache
def load_oracle():
    """Return the tests' exact test in integers, written apart from the kernels."""
    if not ORACLE.is_file():
        raise RuntimeError(f"the exact oracle {ORACLE.name} is not at hand; run this in a checkout with its tests")
    spec = importlib.util.spec_from_file_location("oracle_triangle", ORACLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def find_truth(job):
    """Return the exact answers for a chunk, bool (count,)."""
    oracle = load_oracle()
    pairs = make_chunk(job)
    if job[0] == "extreme":  # no common exponent
        return np.array([oracle.triangles_intersect(a, b) for a, b in pairs])
    points = pairs.reshape(-1, 3)
    index = np.arange(len(points)).reshape(-1, 2, 3)
    rows = np.arange(len(pairs))
    return oracle.pairs_intersect(points, index[:, 0], points, index[:, 1], np.stack([rows, rows], 1))


def turn_pairs(pairs):
    """Return the pairs in their orders, and the row that each one comes from."""
    rows = np.arange(len(pairs))
    whole = np.repeat(rows[::WHOLE_EVERY], len(ORDERS))
    order = np.concatenate([rows % len(ORDERS), np.arange(len(whole)) % len(ORDERS)])
    rows = np.concatenate([rows, whole])
    turned = np.empty((len(rows), 2, 3, 3))
    for k, (p, q, swap) in enumerate(ORDERS):
        chosen = order == k
        turned[chosen, swap] = pairs[rows[chosen], 0][:, p]
        turned[chosen, 1 - swap] = pairs[rows[chosen], 1][:, q]
    return turned, rows


@functools.cache
def pair_test(mode):
    """Return the kernel that tests triangles corners[i, :3] and corners[i, 3:] in a mode of `predicates`."""

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def test_pair_kernel(corners: wp.array2d(dtype=wp.vec3d), meet_out: wp.array(dtype=wp.int32)):
        i = wp.tid()
        meet_out[i] = decide_triangles(
            wp.static(mode), corners[i, 0], corners[i, 1], corners[i, 2], corners[i, 3], corners[i, 4], corners[i, 5]
        )

    return test_pair_kernel


@wp.kernel(module="unique", module_options=MODULE_OPTIONS)
def screen_pair_kernel(
    error: wp.float32,
    unit: wp.float32,
    corners: wp.array2d(dtype=wp.vec3),
    meet_out: wp.array(dtype=wp.int32),
):
    i = wp.tid()
    meet_out[i] = float32_filter_triangles(
        error, unit, corners[i, 0], corners[i, 1], corners[i, 2], corners[i, 3], corners[i, 4], corners[i, 5]
    )


def time_launch(kernel, inputs, count, device):
    """Return a kernel's answers, int32 (count,), and the time of its launch [s]."""
    answers = wp.zeros(count, dtype=wp.int32, device=device)
    if count == 0:
        return answers.numpy(), 0.0
    wp.synchronize_device(device)
    begin = time.perf_counter()
    wp.launch(kernel, dim=count, inputs=[*inputs, answers], device=device)
    wp.synchronize_device(device)
    return answers.numpy(), time.perf_counter() - begin


def ask(mode, pairs, device):
    """Return the answers of float64 or exact signs, int32 (count,), and the time [s]."""
    corners = wp.array(np.ascontiguousarray(pairs).reshape(-1, 6, 3), dtype=wp.vec3d, device=device)
    return time_launch(pair_test(int(mode)), [corners], len(pairs), device)


def ask_float32(pairs, device, proven=True):
    """Return the answers of the float32 stage, with its bound or without, and the time [s]."""
    near = unit_size(pairs).astype(np.float32)
    # Coordinates of at most 1 are off by at most 2^-25, differences by twice as much.
    error, unit = (1.02 * 2.0**-24, float(FLOAT32_UNIT)) if proven else (0.0, 0.0)
    corners = wp.array(near.reshape(-1, 6, 3), dtype=wp.vec3, device=device)
    return time_launch(screen_pair_kernel, [error, unit, corners], len(pairs), device)


def unit_size(pairs):
    """Scale each pair to about unit size by a power of two, as the library does for float32."""
    exponent = np.frexp(np.abs(pairs).max((1, 2, 3), keepdims=True))[1]
    return np.ldexp(pairs, -exponent)


def check_chunk(job, truth, device, tally):
    """Compare one chunk on a device with the truth, and add to the tally of its kind."""
    pairs, rows = make_chunk(job), np.arange(len(truth))
    if job[0] != "random":
        pairs, rows = turn_pairs(pairs)
    truth = truth[rows]
    # Every stage is asked about every pair, so that each is held to the truth wherever it is sure.
    screened, screen_time = ask_float32(pairs, device)
    filtered, _ = ask(FILTER, pairs, device)
    exact, _ = ask(EXACT, pairs, device)
    wrong = np.flatnonzero(
        ((screened != truth) & (screened != UNCERTAIN))
        | ((filtered != truth) & (filtered != UNCERTAIN))
        | (exact != truth)
    )
    for i in wrong[:3]:
        answers = f"stages {screened[i]}, {filtered[i]}, {exact[i]}"
        print(f"{job[0]}: {pairs[i].tolist()}: exact {truth[i]}, {answers}", file=sys.stderr, flush=True)
    # As a query does: the next stage for what the one before left open.
    left = np.flatnonzero(screened == UNCERTAIN)
    again, filter_time = ask(FILTER, pairs[left], device)
    hard = left[again == UNCERTAIN]
    _, exact_time = ask(EXACT, pairs[hard], device)
    single, single_time = ask_float32(pairs, device, proven=False)
    rest = np.flatnonzero(single == UNCERTAIN)
    single[rest], rest_time = ask(FLOAT32, unit_size(pairs[rest]), device)
    tally += [
        len(truth), truth.sum(), len(wrong), len(left), len(hard), (single != truth).sum(),
        screen_time, filter_time, exact_time, single_time + rest_time,
    ]  # fmt: skip


def plan(count):
    """Return the chunks of a run: count / 10 adversarial pairs, then count random ones."""
    shares = {kind: -(-(count // 10) // len(ADVERSARIAL)) for kind in ADVERSARIAL}
    shares["random"] = count
    jobs = []
    for kind, share in shares.items():
        starts = range(0, share, CHUNK)
        jobs += [(kind, number, min(CHUNK, share - start)) for number, start in enumerate(starts)]
    return jobs


def run(device, count=100_000, processes=2):
    """Yield one row a kind of pair: pairs asked, share that meet, disagreements of any stage with the truth, shares
    left to float64 and to expansions, error rate of float32 alone, time of each a pair asked [ns].

    Raises:
        RuntimeError: An answer was wrong, or the tests' oracle is not at hand.
    """
    device = wp.get_device(device)
    load_oracle()
    jobs = plan(count)
    tallies = {}
    for mode in (FILTER, EXACT, FLOAT32):
        ask(mode, make_chunk(("random", 0, 1)), device)  # compile before anything is timed
    ask_float32(make_chunk(("random", 0, 1)), device)
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        begin = time.perf_counter()
        # Kinds end in the order of the jobs, so a kind's row is whole when the next one starts.
        for at, (job, truth) in enumerate(zip(jobs, pool.imap(find_truth, jobs))):
            if job[0] not in tallies and tallies:
                yield summarise(device, *list(tallies.items())[-1])
            check_chunk(job, truth, device, tallies.setdefault(job[0], np.zeros(10)))
            done, wrong = (int(sum(tally[k] for tally in tallies.values())) for k in (0, 2))
            line = f"{at + 1}/{len(jobs)} chunks, {done} pairs, {wrong} wrong, {time.perf_counter() - begin:.0f} s"
            print(f"{job[0]}: {line}", file=sys.stderr, flush=True)
    yield summarise(device, *list(tallies.items())[-1])
    if any(tally[2] for tally in tallies.values()):
        raise RuntimeError("exact signs gave a wrong answer")


def summarise(device, kind, tally):
    """Turn a tally into a row."""
    pairs, meet, wrong, left, hard, single, *times = tally.tolist()
    stages = ("float32_stage_ns", "float64_stage_ns", "exact_stage_ns", "float32_ns")
    return {
        "device": device.name,
        "kind": kind,
        "pairs": int(pairs),
        "meet": round(meet / pairs, 4),
        "disagreements": int(wrong),
        "to_float64": float(f"{left / pairs:.3g}"),
        "to_exact": float(f"{hard / pairs:.3g}"),
        "float32_errors": float(f"{single / pairs:.3g}"),
        **{name: round(1e9 * t / pairs, 1) for name, t in zip(stages, times, strict=True)},
    }
