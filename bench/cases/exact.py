"""Triangle pairs, random and adversarial, against integer arithmetic: disagreements, fractions, error rates, times.

Then whole meshes: what "float32" saves and gets wrong, all face pairs of one batch, in turn with "exact".
"""

import functools
import itertools
import multiprocessing
import sys
from collections import Counter

import numpy as np
import warp as wp

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.testing import EXACT, FILTER, FLOAT32, UNCERTAIN

from ..shapes import knot, pair_poses, scene_of_pairs
from ..timing import ratio_of, summarise, time_call, time_in_turn
from ..triangle_pairs import ADVERSARIAL, make_chunk
from ..verify import count_differences, load_oracle

MODULE_OPTIONS = testing.kernel_options("exact/determinant.cuh", "base/lanes.cuh", "triangle/float32_filter.cuh")
PRECISIONS = ("exact", "float32")
FULL = {"faces": 5000, "pairs": 256, "coincident": 16, "repeats": 11}
QUICK = {"faces": 300, "pairs": 3, "coincident": 1, "repeats": 1}
COUNT, QUICK_COUNT = 100_000, 110
CHUNK = 20_000
# Every so many adversarial pairs, one is asked in all orders; the others in one order each, in turn.
WHOLE_EVERY = 64
ORDERS = list(itertools.product(itertools.permutations(range(3)), itertools.permutations(range(3)), (0, 1)))
STAGES = ("float32_stage_ns", "float64_stage_ns", "exact_stage_ns", "float32_ns")
PER_PAIR = ("meet", "to_float64", "to_exact", "float32_errors", *STAGES)


def run(device, count=None, quick=False):
    """Yield one row a kind of pair: pairs asked, fraction that intersect (meet), disagreements of any stage with the
    truth, fractions left to float64 and to exact signs, error rate of float32 alone, time a pair [ns]; then one a
    scene of meshes. Raise a RuntimeError where an answer was wrong, or the tests' oracle is not at hand.
    """
    if load_oracle() is None:
        raise RuntimeError("the exact oracle is not at hand; run this in a checkout with its tests")
    one = make_chunk(("random", 0, 1))
    ask_float32(one, device)  # compile before anything is timed
    for mode in (FILTER, EXACT, FLOAT32):
        ask(mode, one, device)
    jobs, wrong = list_jobs(count or (QUICK_COUNT if quick else COUNT)), 0
    with multiprocessing.get_context("spawn").Pool(1 if quick else None) as pool:
        chunks = zip(jobs, pool.imap(find_truth, jobs), strict=True)
        for kind, group in itertools.groupby(chunks, key=lambda chunk: chunk[0][0]):
            tally = Counter()
            for job, truth in group:
                tally.update(check_chunk(job, truth, device))
            wrong += tally["disagreements"]
            row = {"kind": kind, "pairs": tally["pairs"], "disagreements": tally["disagreements"]}
            yield row | {name: (1e6 if name in STAGES else 1) * tally[name] / tally["pairs"] for name in PER_PAIR}
    if wrong:
        raise RuntimeError("exact signs gave a wrong answer")
    yield from measure_meshes(device, QUICK if quick else FULL)


def measure_meshes(device, sizes):
    """Yield one row a scene: hits, fractions of face pairs that reach float64 and expansions, face pairs that float32
    misses and invents, and times of a launch [ms]."""
    model = ab.Model.from_arrays(*knot(sizes["faces"]), name="knot")
    scenes = {f"knots, centres {distance} apart": pair_poses(sizes["pairs"], distance) for distance in (0.9, 0.2)}
    scenes["coincident knots, any rotation"] = pair_poses(sizes["coincident"], 0.0)
    scenes["coincident knots, any rotation"][1::2] = scenes["coincident knots, any rotation"][::2]
    for name, poses in scenes.items():
        scene, pairs = scene_of_pairs(device, model, poses)
        queries = {p: ab.Query(scene, output="faces", pairs=pairs, precision=p) for p in PRECISIONS}
        found = {precision: query.run() for precision, query in queries.items()}
        times = time_in_turn({p: query.launch for p, query in queries.items()}, device, sizes["repeats"])
        exact = found["exact"]
        tests = exact.triangle_tests.sum()
        row = {"scene": name, "hits": len(exact.faces), "triangle_tests": tests}
        row |= {"to_float64": exact.float64_tests.sum() / tests, "to_exact": exact.exact_tests.sum() / tests}
        row["float32_missed"], row["float32_invented"] = count_differences(found["float32"].faces, exact.faces)
        row |= summarise(times)
        yield row | {"exact_to_float32": ratio_of(times["exact"], times["float32"])}


def list_jobs(count):
    """Return the chunks of a run: count / 10 adversarial pairs, then count random ones."""
    counts = {kind: -(-(count // 10) // len(ADVERSARIAL)) for kind in ADVERSARIAL} | {"random": count}
    return [
        (kind, number, min(CHUNK, total - start))
        for kind, total in counts.items()
        for number, start in enumerate(range(0, total, CHUNK))
    ]


def find_truth(job):
    """Return the exact answers for a chunk, bool (count,)."""
    oracle, pairs = load_oracle(), make_chunk(job)
    if job[0] == "extreme":  # no common exponent
        return np.array([oracle.triangles_intersect(a, b) for a, b in pairs])
    points = pairs.reshape(-1, 3)
    index = np.arange(len(points)).reshape(-1, 2, 3)
    rows = np.arange(len(pairs))
    return oracle.pairs_intersect(points, index[:, 0], points, index[:, 1], np.stack([rows, rows], 1))


def reorder_pairs(pairs):
    """Return the pairs in their orders, and the row that each one comes from."""
    rows = np.arange(len(pairs))
    whole = np.repeat(rows[::WHOLE_EVERY], len(ORDERS))
    order = np.concatenate([rows % len(ORDERS), np.arange(len(whole)) % len(ORDERS)])
    rows = np.concatenate([rows, whole])
    first, second, swap = (np.array(part)[order] for part in zip(*ORDERS))
    reordered = np.stack([pairs[rows[:, None], 0, first], pairs[rows[:, None], 1, second]], 1)
    reordered[swap == 1] = reordered[swap == 1, ::-1]
    return reordered, rows


@functools.cache
def pair_test(mode):
    """Return the kernel that tests triangles corners[i, 0] and corners[i, 1] in a mode of `predicates`."""

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def test_pair_kernel(corners: wp.array3d(dtype=wp.vec3d), answer_out: wp.array(dtype=wp.int32)):
        i = wp.tid()
        a, b = corners[i, 0], corners[i, 1]
        answer_out[i] = testing.decide_triangles(wp.static(mode), a[0], a[1], a[2], b[0], b[1], b[2])

    return test_pair_kernel


@wp.kernel(module="unique", module_options=MODULE_OPTIONS)
def float32_pair_kernel(
    error: wp.float32, unit: wp.float32, faces: wp.array2d(dtype=wp.mat33), answer_out: wp.array(dtype=wp.int32)
):
    i = wp.tid()
    answer_out[i] = testing.float32_filter_triangles(error, unit, faces[i, 0], faces[i, 1])


def time_launch(kernel, inputs, pairs, dtype, device):
    """Return a kernel's answers for pairs, int32 (count,), and the time of its launch [ms]."""
    corners = wp.array(np.ascontiguousarray(pairs), dtype=dtype, device=device)
    answers = wp.zeros(len(pairs), dtype=wp.int32, device=device)
    launch = functools.partial(wp.launch, kernel, len(pairs), [*inputs, corners, answers], device=device)
    taken = time_call(launch, device)() if len(pairs) else 0.0
    return answers.numpy(), taken


def ask(mode, pairs, device):
    """Return the answers of signs in a mode, and the time [ms]."""
    return time_launch(pair_test(int(mode)), [], pairs, wp.vec3d, device)


def ask_float32(pairs, device, proven=True):
    """Return the answers of the float32 stage, with its bound or without, and the time [ms]."""
    # Coordinates of at most 1 are off by at most 2^-25, differences by twice as much.
    bound = [1.02 * 2.0**-24, float(testing.FLOAT32_UNIT)] if proven else [0.0, 0.0]
    return time_launch(float32_pair_kernel, bound, unit_size(pairs).astype(np.float32), wp.mat33, device)


def unit_size(pairs):
    """Scale each pair to about unit size by a power of two, as the library does for float32."""
    exponent = np.frexp(np.abs(pairs).max((1, 2, 3), keepdims=True))[1]
    return np.ldexp(pairs, -exponent)


def check_chunk(job, truth, device):
    """Compare one chunk on a device with the truth; return its tally, times in [ms]."""
    pairs, rows = make_chunk(job), np.arange(len(truth))
    if job[0] != "random":
        pairs, rows = reorder_pairs(pairs)
    truth = truth[rows]
    # Every stage is asked about every pair, so that each is held to the truth wherever it is certain.
    single, single_time = ask_float32(pairs, device)
    double, _ = ask(FILTER, pairs, device)
    exact, _ = ask(EXACT, pairs, device)
    wrong = np.flatnonzero(
        ((single != truth) & (single != UNCERTAIN)) | ((double != truth) & (double != UNCERTAIN)) | (exact != truth)
    )
    for i in wrong[:3]:
        answers = f"stages {single[i]}, {double[i]}, {exact[i]}"
        print(f"{job[0]}: {pairs[i].tolist()}: exact {truth[i]}, {answers}", file=sys.stderr, flush=True)
    # As a query does: the next stage for what the one before left uncertain.
    to_float64 = np.flatnonzero(single == UNCERTAIN)
    again, double_time = ask(FILTER, pairs[to_float64], device)
    to_exact = to_float64[again == UNCERTAIN]
    _, exact_time = ask(EXACT, pairs[to_exact], device)
    unproven, unproven_time = ask_float32(pairs, device, proven=False)
    rest = np.flatnonzero(unproven == UNCERTAIN)
    unproven[rest], rest_time = ask(FLOAT32, unit_size(pairs[rest]), device)
    counts = len(truth), len(wrong), truth.sum(), len(to_float64), len(to_exact), (unproven != truth).sum()
    times = single_time, double_time, exact_time, unproven_time + rest_time
    return dict(zip(("pairs", "disagreements", *PER_PAIR), (*counts, *times), strict=True))
