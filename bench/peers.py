"""One core against one core: ours beside FCL in C++, python-fcl, trimesh and Coal, where installed, on posed pairs.

A workload is one model against another at 200 poses, half of them in contact. Answers are compared before anything is
timed. Times are those that the thread ran. Ours is timed from the launch to the sorted result on the host. A peer is
timed over a loop of its own calls, objects made before, until the library has its contacts; no face numbers are read
from them. Then ours on all cores is timed in turn with ours on one, by the wall clock.
"""

import contextlib
import gc
import importlib.util
import os
import time
from pathlib import Path

import numpy as np
import warp as wp

import warp_abtree as ab
from warp_abtree import testing

from .fcl_peer import FclCppPeer
from .shapes import knot
from .timing import summarise, time_in_turn

ORACLE = Path(__file__).resolve().parents[1] / "tests" / "oracles" / "triangle.py"
REAL = {
    "cow-cow": ("cow", "cow"),
    "bunny-bunny": ("stanford-bunny", "stanford-bunny"),
    "env-rob": ("fcl-env", "fcl-rob"),
}
FULL = {"faces": 5000, "poses": 200, "repeats": 5}
QUICK = {"faces": 300, "poses": 6, "repeats": 1}
ALL_CONTACTS = 2**31 - 1
JUDGED_MAX = 20_000


# --- peers: made of two meshes (vertices, faces) and B's matrices (n, 4, 4), with A at the origin; methods that run all
# --- poses and return a list of answers, and `face_pairs`, which reads (k, 2) numbers of faces out of one answer ------


class FclPeer:
    """python-fcl: a BVHModel (OBB tree with RSS) of each mesh."""

    name = "python-fcl"

    def __init__(self, a, b, matrices):
        import fcl

        self.fcl = fcl
        tree_a = self._make_tree(*a)
        tree_b = tree_a if b is a else self._make_tree(*b)
        self.a = fcl.CollisionObject(tree_a, fcl.Transform())
        self.b = [fcl.CollisionObject(tree_b, fcl.Transform(m[:3, :3], m[:3, 3])) for m in matrices]
        self.yes_no = fcl.CollisionRequest()
        self.all = fcl.CollisionRequest(num_max_contacts=ALL_CONTACTS, enable_contact=True)

    def _make_tree(self, vertices, faces):
        tree = self.fcl.BVHModel()
        tree.beginModel(len(vertices), len(faces))
        tree.addSubModel(vertices, faces)
        tree.endModel()
        return tree

    def _collide(self, request):
        answers = []
        for b in self.b:
            result = self.fcl.CollisionResult()
            self.fcl.collide(self.a, b, request, result)
            answers.append(result)
        return answers

    def any(self):
        return [result.is_collision for result in self._collide(self.yes_no)]

    def faces(self):
        return self._collide(self.all)

    @staticmethod
    def face_pairs(answer):
        return [(contact.b1, contact.b2) for contact in answer.contacts]


class TrimeshPeer:
    """trimesh: two CollisionManagers of one object each, which hold python-fcl's trees; B is moved for each pose."""

    name = "trimesh"

    def __init__(self, a, b, matrices):
        import fcl  # noqa: F401 - trimesh has its managers from it
        from trimesh import Trimesh
        from trimesh.collision import CollisionManager

        self.a, self.b, self.matrices = CollisionManager(), CollisionManager(), matrices
        self.a.add_object("a", Trimesh(*a, process=False))
        self.b.add_object("b", Trimesh(*b, process=False))

    def _collide(self, **wanted):
        answers = []
        for matrix in self.matrices:
            self.b.set_transform("b", matrix)
            answers.append(self.a.in_collision_other(self.b, **wanted))
        return answers

    def any(self):
        return self._collide()

    def faces(self):
        return self._collide(return_data=True)

    @staticmethod
    def face_pairs(answer):
        return [(contact.index("a"), contact.index("b")) for contact in answer[1]]


class CoalPeer:
    """Coal: a BVHModel (OBB tree with RSS) of each mesh, scaled up because of its absolute tolerance of 1e-6."""

    name = "coal"
    size = 2.0**12

    def __init__(self, a, b, matrices):
        import coal

        self.coal = coal
        self.scale = self.size / 2.0 ** np.floor(np.log2(np.ptp(a[0], axis=0).max()))
        self.a = self._make_tree(*a)
        self.b = self.a if b is a else self._make_tree(*b)
        self.origin = coal.Transform3s.Identity()
        self.poses = [coal.Transform3s(m[:3, :3], self.scale * m[:3, 3]) for m in matrices]
        self.yes_no = coal.CollisionRequest()
        self.all = coal.CollisionRequest()
        self.all.num_max_contacts = ALL_CONTACTS
        self.all.enable_contact = True

    def _make_tree(self, vertices, faces):
        tree = self.coal.BVHModelOBBRSS()
        tree.beginModel(len(faces), len(vertices))
        tree.addVertices(self.scale * vertices)
        tree.addTriangles(faces.astype(np.int64))
        tree.endModel()
        return tree

    def _collide(self, request):
        answers = []
        for pose in self.poses:
            result = self.coal.CollisionResult()
            self.coal.collide(self.a, self.origin, self.b, pose, request, result)
            answers.append(result)
        return answers

    def any(self):
        return [result.isCollision() for result in self._collide(self.yes_no)]

    def faces(self):
        return self._collide(self.all)

    @staticmethod
    def face_pairs(answer):
        return [(contact.b1, contact.b2) for contact in answer.getContacts()]


PEERS = (FclCppPeer, FclPeer, TrimeshPeer, CoalPeer)


# --- workloads -------------------------------------------------------------------------------------------------------


def workloads(face_target):
    """Yield (name, model of A, model of B): the knot, and what the folder in ABTREE_MESHES has of the real ones."""
    model = ab.Model.from_arrays(*knot(face_target), name="knot")
    yield "knot-knot", model, model
    folder = Path(os.environ.get("ABTREE_MESHES", ""))
    for name, stems in REAL.items():
        files = [folder / f"{stem}.obj.gz" for stem in stems]
        if all(file.is_file() for file in files):
            models = {file: ab.Model.load(file) for file in files}
            yield name, *(models[file] for file in files)


def random_matrices(rng, vertices_a, vertices_b, count):
    """Return float64 (count, 4, 4): any rotation, B's centre in A's box grown by B's radius."""
    centre_a, centre_b = ((points.min(0) + points.max(0)) / 2 for points in (vertices_a, vertices_b))
    reach = np.ptp(vertices_a, axis=0) / 2 + np.linalg.norm(vertices_b - centre_b, axis=1).max()
    q = rng.normal(size=(count, 4))
    x, y, z, w = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    matrices = np.zeros((count, 4, 4))
    matrices[:, 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], 1)
    matrices[:, 1, :3] = np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], 1)
    matrices[:, 2, :3] = np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], 1)
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
        for matrix, meets in zip(matrices, scene.intersect(pairs, "any").any, strict=True):
            kept[bool(meets)].append(matrix)
    return rng.permutation(np.stack([*kept[True][: (count + 1) // 2], *kept[False][: count // 2]]))


# --- answers ---------------------------------------------------------------------------------------------------------


def load_oracle():
    """Return the exact oracle of the tests, None where there is no checkout with its tests."""
    if not ORACLE.is_file():
        return None
    spec = importlib.util.spec_from_file_location("oracle_triangle", ORACLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def count_ours_wrong(disputed, ours, a, b, matrices):
    """Return in how many (pose, face of A, face of B), (k, 3), ours is wrong; None if not judged.

    Args:
        disputed: What only one side reports.
        ours: Whether it is ours, bool (k,).
    """
    oracle = load_oracle()
    if oracle is None or len(disputed) > JUDGED_MAX:
        return None
    wrong = 0
    for pose in np.unique(disputed[:, 0]):
        mine = disputed[:, 0] == pose
        corners_a = a[0][a[1][disputed[mine, 1]]].reshape(-1, 3)
        corners_b = oracle.into_frame_of_a(b[0][b[1][disputed[mine, 2]]].reshape(-1, 3), np.eye(4), matrices[pose])
        faces = np.arange(len(corners_a)).reshape(-1, 3)
        meets = oracle.pairs_intersect(corners_a, faces, corners_b, faces, [(k, k) for k in range(len(faces))])
        wrong += int((meets != ours[mine]).sum())
    return wrong


def compare(peer, found_any, found_faces, a, b, matrices):
    """Return what a peer misses and invents beside our answers, poses and face pairs.

    Raises:
        RuntimeError: The oracle finds one of our answers wrong.
    """
    answer = np.array(peer.any(), bool)
    ours = {tuple(row) for row in found_faces.tolist()}
    theirs = {(pose, *pair) for pose, answers in enumerate(peer.faces()) for pair in peer.face_pairs(answers)}
    disputed = np.array(sorted(ours ^ theirs), np.int64).reshape(-1, 3)
    from_ours = np.array([tuple(row) in ours for row in disputed.tolist()], bool)
    wrong = count_ours_wrong(disputed, from_ours, a, b, matrices)
    if wrong:
        raise RuntimeError(f"{wrong} of {len(disputed)} face pairs on which {peer.name} differs are errors of ours")
    return {
        "any_missed": int((found_any & ~answer).sum()),
        "any_invented": int((answer & ~found_any).sum()),
        "faces_missed": len(ours - theirs),
        "faces_invented": len(theirs - ours),
        "ours_wrong": "not judged" if wrong is None else wrong,
    }


# --- times -----------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def one_core():
    """Hold this thread, and those it starts, on one core; yield its number, None where the system has no such call."""
    if not hasattr(os, "sched_setaffinity"):
        yield None
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(allowed)})
    try:
        yield max(allowed)
    finally:
        os.sched_setaffinity(0, allowed)


@contextlib.contextmanager
def no_garbage_collection():
    """Keep Python's collector out of the times: it would go through the contacts that peers make by the thousand."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def run_to_host(query):
    """Return a callable that launches a query and returns its result."""

    def run():
        query.launch()
        return query.result()

    return run


def run(device, quick=False):
    """Yield one row a workload and peer, differences, queries a second of both and ratios (ours over the peer), and one
    a workload of ours on one core and on all.
    """
    device = wp.get_device(device)
    sizes = QUICK if quick else FULL
    for name, model_a, model_b in workloads(sizes["faces"]):
        with one_core() as core:
            about, queries, matrices, meshes = make_workload(name, model_a, model_b, device, sizes["poses"])
            yield from run_workload(about | {"core": core}, queries, matrices, meshes, sizes["repeats"])
        yield about | time_cores(queries, sizes["repeats"])


def make_workload(name, model_a, model_b, device, pose_count):
    """Return the columns that name a workload, its queries by output, matrices of B and both meshes."""
    a = model_a.mesh_at(model_a.lod_max)[:2]
    b = a if model_b is model_a else model_b.mesh_at(model_b.lod_max)[:2]
    scene = ab.Scene(device)
    scene.add(model_a)
    for _ in range(pose_count):
        scene.add(model_b)
    pairs = [(0, i + 1) for i in range(pose_count)]
    matrices = half_in_contact(scene, pairs, a[0], b[0])
    scene.set_poses(np.concatenate([np.eye(4)[None], matrices]))
    queries = {output: ab.Query(scene, output, pairs=pairs) for output in ("any", "faces")}
    about = {"device": device.name, "workload": name, "faces": f"{len(a[1])} x {len(b[1])}", "poses": pose_count}
    return about, queries, matrices, (a, b)


def run_workload(about, queries, matrices, meshes, repeats):
    """Yield one row a peer."""
    found = {output: query.run() for output, query in queries.items()}
    if not np.array_equal(found["any"].any, found["faces"].count > 0):
        raise RuntimeError("outputs 'any' and 'faces' of ours differ")
    about = about | {"meet": int(found["any"].any.sum()), "hits": len(found["faces"].faces)}
    peers, missing, differences = [], {}, {}
    for kind in PEERS:
        try:
            peers.append(kind(*meshes, matrices))
        except ImportError as error:
            missing[kind.name] = str(error)
    for peer in peers:
        differences[peer.name] = compare(peer, found["any"].any, found["faces"].faces, *meshes, matrices)
    times = {}
    # Of one thread the time that it ran, whatever else the machine does; a GPU works while the thread waits.
    clock = time.thread_time if queries["any"].device.is_cpu else time.perf_counter
    for output, query in queries.items():
        launches = {"ours": run_to_host(query)} | {peer.name: getattr(peer, output) for peer in peers}
        with no_garbage_collection():  # on every device as on the CPU: results are read back
            measured = time_in_turn(launches, wp.get_device("cpu"), repeats, clock)
        times |= {(who, output): values for who, values in measured.items()}
        if not np.array_equal(query.result().any, found["any"].any):
            raise RuntimeError(f"the timed answer of {output!r} differs from the checked one")
    for kind in PEERS:
        row = about | {"peer": kind.name}
        if kind.name in missing:
            row["skipped"] = missing[kind.name]
        else:
            row |= differences[kind.name]
        for output in queries:
            ours = times["ours", output]
            row |= {f"ours_{output}_per_s": rate(ours, len(matrices))} | summarise(f"ours_{output}", ours)
            if kind.name not in missing:
                theirs = times[kind.name, output]
                row |= {f"peer_{output}_per_s": rate(theirs, len(matrices))} | summarise(f"peer_{output}", theirs)
                row[f"{output}_ratio"] = round(float(np.median(theirs) / np.median(ours)), 2)
        yield row


def rate(times, count):
    """Return queries a second of a batch whose times [ms] are given."""
    return round(1e3 * count / float(np.median(times)))


def time_cores(queries, repeats):
    """Return columns of ours on all cores of this process and how many times faster than on one that is."""
    row = {"cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()}
    for output, query in queries.items():

        def run_on(cores, query=query):
            def run():
                with testing.regime(cpu_threads=cores):
                    query.launch()
                    return query.result()

            return run

        launches = {"all": run_on(None), "one": run_on(1)}
        with no_garbage_collection():
            times = time_in_turn(launches, wp.get_device("cpu"), repeats)
        row |= summarise(f"all_{output}", times["all"]) | summarise(f"one_{output}", times["one"])
        row[f"{output}_ratio"] = round(float(np.median(times["one"]) / np.median(times["all"])), 2)
    return row
