"""One core against one core: ours beside python-fcl and trimesh, where installed, on posed pairs.

A workload is one model against another at 200 poses, half of them intersecting. Answers are compared before anything is
timed. Times are those that the thread ran. Ours is timed from the launch to the sorted result on the host; a baseline
over a loop of its own calls, objects made before, until the library has its contacts; no face numbers are read from
them.
"""

import time

import numpy as np
import warp as wp

import warp_abtree as ab

from ..baselines.fcl import Fcl, Trimesh
from ..meshes import real_meshes
from ..shapes import centre_and_radius, knot, pose_matrices, random_directions, scene_of_poses
from ..timing import no_garbage_collection, one_core, ratio_of, summarise, time_in_turn
from ..verify import judge_disputed

REAL = {
    "cow-cow": ("cow", "cow"),
    "bunny-bunny": ("stanford-bunny", "stanford-bunny"),
    "env-rob": ("fcl-env", "fcl-rob"),
}
FULL = {"faces": 5000, "poses": 200, "repeats": 5}
QUICK = {"faces": 300, "poses": 6, "repeats": 1}
BASELINES = (Fcl, Trimesh)


def run(device, quick=False):
    """Yield one row a workload and baseline (column peer): differences, queries a second of both, and ratios (ours over
    the peer)."""
    device = wp.get_device(device)
    sizes = QUICK if quick else FULL
    knots = ab.Model.from_arrays(*knot(sizes["faces"]), name="knot")
    for name, models in {"knot-knot": (knots, knots), **real_meshes(REAL)}.items():
        with one_core() as core:
            about = {"device": device.name, "workload": name, "core": core}
            for row in Workload(*models, device, sizes).run():
                yield about | row


def random_matrices(rng, model_a, model_b, count):
    """Return float64 (count, 4, 4): any rotation, B's centre in A's box grown by B's radius."""
    (centre_a, _), (centre_b, radius_b) = map(centre_and_radius, (model_a, model_b))
    reach = np.ptp(model_a.mesh_at(model_a.lod_max)[0], axis=0) / 2 + radius_b
    matrices = pose_matrices(np.concatenate([np.zeros((count, 3)), random_directions(rng, count, 4)], 1))
    matrices[:, :3, 3] = centre_a + reach * rng.uniform(-1, 1, (count, 3)) - matrices[:, :3, :3] @ centre_b
    return matrices


class Workload:
    """Two models at poses, half of them in contact, and our queries over them."""

    def __init__(self, model_a, model_b, device, sizes):
        self.device, self.repeats, count = device, sizes["repeats"], sizes["poses"]
        a = model_a.mesh_at(model_a.lod_max)[:2]
        self.meshes = a, a if model_b is model_a else model_b.mesh_at(model_b.lod_max)[:2]
        self.scene, pairs = scene_of_poses(device, model_a, model_b, np.tile(np.eye(4), (count, 1, 1)))
        rng, kept = np.random.default_rng(0), {True: [], False: []}
        while min(map(len, kept.values())) < (count + 1) // 2:
            matrices = random_matrices(rng, model_a, model_b, count)
            self.place(matrices)
            for matrix, intersects in zip(matrices, self.scene.intersect(pairs, "any").any, strict=True):
                kept[bool(intersects)].append(matrix)
        self.matrices = rng.permutation([*kept[True][: (count + 1) // 2], *kept[False][: count // 2]])
        self.place(self.matrices)
        self.queries = {output: ab.Query(self.scene, output, pairs=pairs) for output in ("any", "faces")}

    def place(self, matrices):
        """Pose B at matrices (n, 4, 4)."""
        self.scene.set_poses(np.concatenate([np.eye(4)[None], matrices]))

    def run(self):
        """Yield one row a baseline."""
        answers = {output: query.run() for output, query in self.queries.items()}
        any_hit, faces = answers["any"].any, answers["faces"].faces
        if not np.array_equal(any_hit, answers["faces"].count > 0):
            raise RuntimeError("outputs 'any' and 'faces' of ours differ")
        about = {"faces": " x ".join(str(len(mesh[1])) for mesh in self.meshes), "poses": len(self.matrices)}
        about |= {"meet": int(any_hit.sum()), "hits": len(faces)}
        made, rows = [], {}
        for kind in BASELINES:
            try:
                made.append(kind(*self.meshes, self.matrices))
            except ImportError as error:
                rows[kind.name] = {"skipped": str(error)}
        for baseline in made:
            rows[baseline.name] = self.compare(baseline, any_hit, faces)
        times = {output: self.time_output(output, made, any_hit) for output in self.queries}
        for name in [kind.name for kind in BASELINES]:
            row = about | {"peer": name} | rows[name]
            for output, found in times.items():
                shown = {
                    f"{who}_{output}": found[key] for who, key in (("ours", "ours"), ("peer", name)) if key in found
                }
                row |= summarise(shown)
                row |= {f"{key}_per_s": round(1e3 * len(self.matrices) / np.median(ms)) for key, ms in shown.items()}
                if name in found:
                    row[f"{output}_ratio"] = ratio_of(found[name], found["ours"])
            yield row

    def compare(self, baseline, found_any, found_faces):
        """Return what a baseline misses and invents beside our answers, which the oracle must not find wrong."""
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

    def time_output(self, output, made, found_any):
        """Return the times [ms] of ours and of the baselines by name."""
        query = self.queries[output]
        # Of one thread the time that it ran, whatever else the machine does; a GPU works while the thread waits.
        clock = time.thread_time if self.device.is_cpu else time.perf_counter
        launches = {"ours": lambda: (query.launch(), query.result())}
        launches |= {one.name: getattr(one, output) for one in made}
        with no_garbage_collection():  # on every device as on the CPU: results are read back
            times = time_in_turn(launches, wp.get_device("cpu"), self.repeats, clock)
        if not np.array_equal(query.result().any, found_any):
            raise RuntimeError(f"the timed answer of {output!r} differs from the checked one")
        return times
