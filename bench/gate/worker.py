"""Worker of `python -m bench gate`: digests of answers, times of launches, and kernels, of the tree that it imports.

Run by its path with a checkout as PYTHONPATH, so that one file asks two trees the same; of the library it uses public
names and `warp_abtree.testing`. It reads commands as JSON, a line each, and answers each by a line of JSON.
"""

import gc
import hashlib
import json
import sys
import time
import traceback
from functools import partial

import numpy as np
import warp as wp

import warp_abtree as ab
from bench.meshes import ModelFolder, mesh_file
from bench.shapes import knot, pair_poses, pose_matrices, random_poses, scene_of_objects, scene_of_pairs, scene_of_poses
from bench.timing import make_runs, time_call
from warp_abtree import testing

FACES = {False: 5000, True: 300}  # of a knot; quick
FIELDS = ("pairs", "any", "apart", "count", "faces", "contacts", "pair_contacts", "points", "distance", "bracket")
FIELDS += ("point_faces", "time", "clear", "undecided")
NUT = ("factory-bolt-m20", "factory-nut-m20")
NUT_POSE = (0, 0, 0.0204, 0, 0, 0, 1)  # crosses the thread
LAUNCHES_BEFORE = 20  # what is asked often makes slabs first


class Questions:
    """Scenes, answers and launches of one device and size."""

    def __init__(self, device, quick):
        self.device, self.quick = wp.get_device(device), quick
        self.model = ab.Model.from_arrays(*knot(FACES[quick]), name="knot")
        self.few = 4 if quick else 64
        self.many = 8 if quick else 1024 if self.device.is_cuda else 64

    def pairs(self, count, distance=0.9, fraction=1.0):
        """Return a scene of pairs of knots at a LOD, and its pairs."""
        scene, pairs = scene_of_pairs(self.device, self.model, pair_poses(count, distance))
        if fraction < 1:
            scene.set_lods(np.full(scene.object_count, self.model.lod_for(fraction=fraction)))
        return scene, pairs

    def apart(self, count):
        """Return a scene of a knot and so many others at random poses about it, and its pairs."""
        return scene_of_poses(self.device, self.model, self.model, pose_matrices(random_poses(2.0, count)))

    def nut(self):
        """Return a scene of a nut on its bolt, and the pair."""
        return scene_of_poses(self.device, *(ModelFolder(None).load([name]) for name in NUT), [NUT_POSE])


def fields_of(result):
    """Return the arrays of a result that were asked for."""
    return [getattr(result, name) for name in FIELDS if getattr(result, name) is not None]


def ask_outputs(ask):
    for fraction in (1.0, 0.1, 0.01):
        scene, pairs = ask.pairs(ask.few, 0.9, fraction)
        for output in ("any", "count", "faces", "contacts"):
            yield f"{output} {fraction}", fields_of(scene.intersect(pairs, output, within=0.02))
    yield "contacts gap", fields_of(scene.intersect(pairs, "contacts", gap=0.02))


def ask_distances(ask):
    scene, pairs = ask.apart(ask.few)
    query = ab.DistanceQuery(scene, pairs)
    for turn in ("fresh", "again", "once more"):
        yield turn, fields_of(query.run())
    yield "beyond", fields_of(scene.intersect(pairs, "distance", beyond=0.3, tolerance=1e-3))
    solid = ab.Scene(ask.device)
    for i, pose in enumerate(random_poses(0.8, 2 * ask.few)):
        solid.add(ask.model, pose, lod=ask.model.lod_for(fraction=1 / (1 + i % 3)), solid=True)
    for output in ("any", "count"):
        yield f"solid {output}", fields_of(solid.intersect(pairs, output))
    yield "signed", fields_of(ab.DistanceQuery(solid, pairs, signed=True).run())


def ask_motions(ask):
    scene, pairs = ask.pairs(ask.few, 3.0)
    ends = random_poses(2.0, scene.object_count, seed=7)
    for options in ({}, {"screw": True}, {"linear": True}, {"tolerance": 1e-3}):
        yield str(options), fields_of(scene.first_contact(pairs, ends, **options))


def ask_manifolds(ask):
    scene, pairs = ask.pairs(ask.few, 0.9, 0.1)
    for gap in (None, 0.01):
        found = ab.ManifoldQuery(scene, pairs, gap=gap).run()
        yield f"gap {gap}", [found.points[name] for name in ("pair", "point", "normal", "depth")]


def ask_trees(ask):
    scene = scene_of_objects(ask.device, ask.model, random_poses(1.0, 4))
    for fraction in (1.0, 0.5, 0.02, 0.3):
        scene.set_lods(np.full(4, ask.model.lod_for(fraction=fraction)))
        state = scene.tree_state(0)
        yield str(fraction), [getattr(state, name) for name in ("status", "lower", "upper", "face_node")]
    faces = ask.model.mesh_at(ask.model.lod_max // 3)
    yield "model", [*faces, np.array([ask.model.error_at(lod) for lod in range(0, ask.model.lod_max + 1, 50)])]


def ask_sweeps(ask):
    poses = random_poses(1.5, 16 * ask.few)
    for output in ("any", "count", "faces", "distance"):
        yield output, [ab.sweep(ask.model, ask.model, poses, output=output, device=ask.device)]


def ask_frames(ask):
    scene = scene_of_objects(ask.device, ask.model, random_poses(2.0, 16))
    frame = ab.Pipeline(scene, output="contacts", capacity=2**17)
    frame.launch()
    frame.check()
    yield "pipeline", fields_of(frame.result())
    scene = scene_of_objects(ask.device, ask.model, random_poses(2.0, 8), world_size=2)
    scene.set_lods(np.full(8, ask.model.lod_for(fraction=0.05)))
    bodies = ab.Dynamics(scene, gravity=(0, 0, 0), velocity=[(0.1 * i, 0, 0) for i in range(8)])
    for _ in range(10):
        bodies.step(1 / 60)
    yield "bodies", [np.asarray(bodies.poses()), *map(np.asarray, bodies.velocities())]


ASKED = (ask_outputs, ask_distances, ask_motions, ask_manifolds, ask_trees, ask_sweeps, ask_frames)


def launch_query(scene, pairs, output):
    """Return the launch of a query with room for its hits."""
    query = ab.ContactQuery(scene, pairs) if output == "contacts" else ab.Query(scene, output, pairs=pairs)
    query.run()
    return query.launch


def launch_distance(ask, fresh):
    query = ab.DistanceQuery(*ask.apart(ask.many))
    for _ in range(LAUNCHES_BEFORE):
        query.launch()
    return (lambda: (query.forget(), query.launch())) if fresh else query.launch


def launch_motion(ask):
    scene, pairs = ask.pairs(ask.many, 3.0)
    query = ab.FirstContactQuery(scene, random_poses(2.0, scene.object_count, seed=7), pairs)
    query.run()
    return query.launch


def launch_update(ask, fraction):
    """Return the launch of an update of four states there and back."""
    scene, models = ab.Scene(ask.device), [ab.Model.from_arrays(*knot(FACES[ask.quick] + 40 * k)) for k in range(4)]
    for model in models:
        scene.add(model)
    there = [round(model.lod_max * (1 - fraction)) for model in models]
    with testing.force_refits(None):
        forth = testing.repeat_update(scene.set_lods(there))
        back = testing.repeat_update(scene.set_lods([model.lod_max for model in models]))
    return lambda: (forth(), back())


def launch_frame(ask):
    scene = scene_of_objects(ask.device, ask.model, random_poses(4.0, 16))
    frame = ab.Pipeline(scene, output="count", capacity=ab.Buffers(pairs=256))
    frame.launch()
    frame.check()
    return frame.launch


def call_scene(ask, count, output):
    scene, pairs = ask.pairs(count)
    return lambda: scene.intersect(pairs, output)


def launches(ask):
    """Return makers of launches by name, and those of calls that wait for the device."""
    many = ask.many

    def of_knots(output, *placed):
        return lambda: launch_query(*ask.pairs(*placed), output)

    made = {"query, 1 pair": of_knots("faces", 1)}
    made |= {f"query, {n} pairs at {d}": of_knots("faces", n, d) for n, d in ((ask.few, 0.9), (many, 0.2))}
    if ask.device.is_cuda and not ask.quick:
        made["query, 8192 pairs at 0.9"] = of_knots("faces", 8192)
    made |= {f"query {many}, {output}": of_knots(output, many) for output in ("any", "contacts")}
    coarse = [(fraction, output) for fraction in (0.1, 0.01) for output in ("faces", "any", "contacts")]
    made |= {f"coarse {fraction}, {output}": of_knots(output, many, 0.9, fraction) for fraction, output in coarse}
    made |= {f"distance {many}, {kind}": partial(launch_distance, ask, kind == "fresh") for kind in ("fresh", "again")}
    made[f"motion, {many}"] = partial(launch_motion, ask)
    made |= {f"update, {fraction}": partial(launch_update, ask, fraction) for fraction in (0.003, 0.1, 0.9)}
    made["frame, 16 objects"] = partial(launch_frame, ask)
    if all(map(mesh_file, NUT)):
        made |= {f"assembly, {output}": lambda o=output: launch_query(*ask.nut(), o) for output in ("any", "faces")}
    asked = [(count, output) for count in (1, ask.few) for output in ("any", "faces")]
    return made, {f"host {count}, {output}": partial(call_scene, ask, count, output) for count, output in asked}


def kernels_of(device):
    """Return registers, local and shared memory [bytes] of every loaded CUDA kernel, by its name; sorted lists."""
    found = {}
    gc.unfreeze()  # else they are not listed
    for kernel in [kernel for kernel in gc.get_objects() if isinstance(kernel, wp.Kernel)]:
        for block_dim in {block_dim for _, block_dim in getattr(kernel.module, "execs", {})}:
            try:
                properties = wp.get_cuda_kernel_properties(kernel, device, block_dim)
            except (RuntimeError, TypeError, ValueError, KeyError):
                continue  # generic, or of another variant
            row = [value for _, value in sorted(properties.items())]
            found.setdefault(f"{kernel.key} {block_dim}", []).append(row)
            names = sorted(properties)
    return {"names": names, "kernels": {key: sorted(rows) for key, rows in found.items()}} if found else {}


def serve(device, quick):
    """Answer commands until the input ends."""
    out, sys.stdout = sys.stdout, sys.stderr  # what is printed by others is no answer
    wp.config.log_level = wp.LOG_WARNING
    ask, runs = Questions(device, quick), {}
    made, calls = launches(ask)

    def answer(command):
        what, name = command["do"], command.get("name")
        if what == "list":
            return {"digests": [part.__name__ for part in ASKED], "times": [*made, *calls]}
        if what == "first":
            return [int(value) for value in ask.pairs(1)[0].intersect([(0, 1)], "any").any]
        if what == "digest":
            with testing.regime(**command.get("regime", {})):
                part = next(part for part in ASKED if part.__name__ == name)
                return {key: digest(arrays) for key, arrays in part(ask)}
        if what == "prepare":
            runs.clear()
            gc.collect()
            gc.freeze()  # what is left stays, and need not be looked at again
            with testing.regime(cpu_threads=1):
                runs["launch"] = launch = (calls | made)[name]()  # a graph holds none of its arrays
                if name in calls:
                    runs[name] = time_call(launch, ask.device)
                else:
                    runs.update(make_runs({name: launch}, ask.device, time.thread_time))
            return None
        if what == "time":
            with testing.regime(cpu_threads=1):
                return [runs[name]() for _ in range(command["repeats"])]
        return kernels_of(ask.device) if ask.device.is_cuda else {}

    for line in sys.stdin:
        try:
            found = {"answer": answer(json.loads(line))}
        except Exception:
            found = {"error": traceback.format_exc()}
        print(json.dumps(found), file=out, flush=True)


def digest(arrays):
    """Return the SHA-256 of arrays, their types and shapes."""
    total = hashlib.sha256()
    for array in map(np.ascontiguousarray, arrays):
        total.update(f"{array.dtype.descr} {array.shape}".encode() + array.tobytes())
    return total.hexdigest()[:16]


if __name__ == "__main__":
    serve(sys.argv[1], sys.argv[2] == "quick")
