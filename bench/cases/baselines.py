"""One core against one core: ours beside FCL in C++, python-fcl and trimesh, where installed, on posed pairs.

A workload is one model against another at 200 poses, half of them intersecting. Answers are compared before anything is
timed. Times are those that the thread ran. Ours is timed from the launch to the sorted result on the host; a baseline
over a loop of its own calls, objects made before, until the library has its contacts; no face numbers are read from
them.
"""

import time

import numpy as np
import warp as wp

import warp_abtree as ab
from warp_abtree.checks.quaternions import matrices_of

from ..baselines.fcl import Fcl
from ..baselines.fcl_cpp import FclCpp
from ..baselines.trimesh import Trimesh
from ..meshes import real_meshes
from ..shapes import knot, random_directions, scene_of_poses
from ..timing import no_garbage_collection, one_core, ratio_of, summarise, time_in_turn
from ..verify import judge_disputed

REAL = {
    "cow-cow": ("cow", "cow"),
    "bunny-bunny": ("stanford-bunny", "stanford-bunny"),
    "env-rob": ("fcl-env", "fcl-rob"),
}
FULL = {"faces": 5000, "poses": 200, "repeats": 5}
QUICK = {"faces": 300, "poses": 6, "repeats": 1}
BASELINES = (FclCpp, Fcl, Trimesh)
IDENTITY = (0, 0, 0, 0, 0, 0, 1)


def run(device, quick=False):
    """Yield one row a workload and baseline (column peer): differences, queries a second of both, and ratios (ours over
    the peer)."""
    device = wp.get_device(device)
    sizes = QUICK if quick else FULL
    knots = ab.Model.from_arrays(*knot(sizes["faces"]), name="knot")
    for name, models in {"knot-knot": (knots, knots), **real_meshes(REAL)}.items():
        with one_core() as core:
            workload = Workload(name, *models, device, sizes)
            workload.about["core"] = core
            yield from workload.run()


def random_matrices(rng, vertices_a, vertices_b, count):
    """Return float64 (count, 4, 4): any rotation, B's centre in A's box grown by B's radius."""
    centre_a, centre_b = ((points.min(0) + points.max(0)) / 2 for points in (vertices_a, vertices_b))
    reach = np.ptp(vertices_a, axis=0) / 2 + np.linalg.norm(vertices_b - centre_b, axis=1).max()
    matrices = np.zeros((count, 4, 4))
    matrices[:, :3, :3] = matrices_of(random_directions(rng, count, 4))
    matrices[:, :3, 3] = centre_a + reach * rng.uniform(-1, 1, (count, 3)) - matrices[:, :3, :3] @ centre_b
    matrices[:, 3, 3] = 1
    return matrices


def half_in_contact(scene, pairs, vertices_a, vertices_b, seed=0):
    """Return a matrix of B for every pair, half of them with and half without contact, in random order."""
    rng = np.random.default_rng(seed)
    count = len(pairs)
    kept = {True: [], False: []}
    while min(map(len, kept.values())) < (count + 1) // 2:
        matrices = random_matrices(rng, vertices_a, vertices_b, count)
        scene.set_poses(np.concatenate([np.eye(4)[None], matrices]))
        for matrix, intersects in zip(matrices, scene.intersect(pairs, "any").any, strict=True):
            kept[bool(intersects)].append(matrix)
    return rng.permutation(np.stack([*kept[True][: (count + 1) // 2], *kept[False][: count // 2]]))


def run_to_host(query):
    """Return a callable that launches a query and returns its result."""
    return lambda: (query.launch(), query.result())[1]


class Workload:
    """Two models at poses, half of them in contact, and our queries over them."""

    def __init__(self, name, model_a, model_b, device, sizes):
        self.device, self.repeats = device, sizes["repeats"]
        a = model_a.mesh_at(model_a.lod_max)[:2]
        b = a if model_b is model_a else model_b.mesh_at(model_b.lod_max)[:2]
        scene, pairs = scene_of_poses(device, model_a, model_b, [IDENTITY] * sizes["poses"])
        self.meshes, self.matrices = (a, b), half_in_contact(scene, pairs, a[0], b[0])
        scene.set_poses(np.concatenate([np.eye(4)[None], self.matrices]))
        self.queries = {output: ab.Query(scene, output, pairs=pairs) for output in ("any", "faces")}
        sides = f"{len(a[1])} x {len(b[1])}"
        self.about = {"device": device.name, "workload": name, "faces": sides, "poses": len(pairs)}

    def run(self):
        """Yield one row a baseline."""
        found = {output: query.run() for output, query in self.queries.items()}
        if not np.array_equal(found["any"].any, found["faces"].count > 0):
            raise RuntimeError("outputs 'any' and 'faces' of ours differ")
        about = self.about | {"meet": int(found["any"].any.sum()), "hits": len(found["faces"].faces)}
        made, rows = [], {}
        for kind in BASELINES:
            try:
                made.append(kind(*self.meshes, self.matrices))
            except ImportError as error:
                rows[kind.name] = {"skipped": str(error)}
        for baseline in made:
            rows[baseline.name] = self.compare(baseline, found["any"].any, found["faces"].faces)
        times = self.time_baselines(made, found["any"].any)
        for kind in BASELINES:
            row = about | {"peer": kind.name} | rows[kind.name]
            for output in self.queries:
                ours, theirs = (times.get((who, output)) for who in ("ours", kind.name))
                row |= self.rate(f"ours_{output}", ours)
                if theirs is not None:
                    row |= self.rate(f"peer_{output}", theirs) | {f"{output}_ratio": ratio_of(theirs, ours)}
            yield row

    def compare(self, baseline, found_any, found_faces):
        """Return what a baseline misses and invents beside our answers, poses and face pairs.

        Raises:
            RuntimeError: The oracle finds one of our answers wrong.
        """
        answer = np.array(baseline.any(), bool)
        ours = {tuple(row) for row in found_faces.tolist()}
        theirs = {(pose, *pair) for pose, one in enumerate(baseline.faces()) for pair in baseline.face_pairs(one)}
        judged = judge_disputed(
            list(theirs), list(ours), self.meshes, lambda pose: (np.eye(4), self.matrices[pose]), baseline.name
        )
        return {
            "any_missed": int((found_any & ~answer).sum()),
            "any_invented": int((answer & ~found_any).sum()),
            "faces_missed": len(ours - theirs),
            "faces_invented": len(theirs - ours),
            "ours_wrong": "not judged" if judged is None else 0,
        }

    def time_baselines(self, made, found_any):
        """Return the times [ms] of ours and of the baselines, by name and output."""
        times = {}
        # Of one thread the time that it ran, whatever else the machine does; a GPU works while the thread waits.
        clock = time.thread_time if self.device.is_cpu else time.perf_counter
        for output, query in self.queries.items():
            launches = {"ours": run_to_host(query)} | {one.name: getattr(one, output) for one in made}
            with no_garbage_collection():  # on every device as on the CPU: results are read back
                measured = time_in_turn(launches, wp.get_device("cpu"), self.repeats, clock)
            times |= {(who, output): values for who, values in measured.items()}
            if not np.array_equal(query.result().any, found_any):
                raise RuntimeError(f"the timed answer of {output!r} differs from the checked one")
        return times

    def rate(self, name, times):
        """Return the columns of a batch's times [ms], with queries a second."""
        per_second = round(1e3 * len(self.matrices) / float(np.median(times)))
        return {f"{name}_per_s": per_second} | summarise(name, times)
