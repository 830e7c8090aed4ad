"""One core, library beside library: yes or no, all face pairs and distances of two meshes at 60 poses [us a pose].

Half of the poses of the first two questions intersect; distances are at poses that do not. All are asked pose by pose
but ours and py-parry3d, which take all poses in one call. Times are those that all threads of the process ran, which
share one core, in turn. Answers are compared first: face pairs on which a library differs from ours are judged by the
exact oracle of the tests. Libraries that are not installed (extra `peers`) are named in `skipped`. Each has the methods
of `fcl.Fcl` that it can answer.
"""

import time

import numpy as np

import warp_abtree as ab

from ..cases.baselines import half_in_contact, measure
from ..meshes import real_meshes
from ..shapes import knot
from ..timing import one_core
from .fcl import ALL_CONTACTS, Fcl

REAL = {name: (name, name) for name in ("cow", "stanford-bunny", "fandisk")}
FULL = {"poses": 60, "repeats": 5, "judged": 400}
QUICK = {"poses": 6, "repeats": 1, "judged": 50}


class Coal:
    """coal, the successor of hpp-fcl: a BVHModelOBBRSS of each mesh."""

    name = "coal"

    def __init__(self, a, b, matrices):
        import coal

        self.coal, self.origin = coal, coal.Transform3s.Identity()
        self.a = self._make_tree(*a)
        self.b = self.a if b is a else self._make_tree(*b)
        self.poses = [coal.Transform3s(matrix[:3, :3], matrix[:3, 3]) for matrix in matrices]
        self.yes_no = coal.CollisionRequest()
        self.all = coal.CollisionRequest(coal.CollisionRequestFlag.CONTACT, ALL_CONTACTS)

    def _make_tree(self, vertices, faces):
        tree = self.coal.BVHModelOBBRSS()
        tree.beginModel(len(faces), len(vertices))
        tree.addVertices(np.asarray(vertices, np.float64))
        tree.addTriangles(np.asarray(faces, np.int64))
        tree.endModel()
        return tree

    def _collide(self, request, pose):
        result = self.coal.CollisionResult()
        self.coal.collide(self.a, self.origin, self.b, pose, request, result)
        return result

    def any(self):
        return [self._collide(self.yes_no, pose).isCollision() for pose in self.poses]

    def faces(self):
        return [self._collide(self.all, pose) for pose in self.poses]

    @staticmethod
    def face_pairs(answer):
        return [(contact.b1, contact.b2) for contact in answer.getContacts()]

    def distances(self):
        ask, request = self.coal.distance, self.coal.DistanceRequest()
        return np.array([ask(self.a, self.origin, self.b, p, request, self.coal.DistanceResult()) for p in self.poses])


class MeshLib:
    """MeshLib: AABB trees of both meshes, vertices and poses in float32. Its trees are built by the first call."""

    name = "MeshLib"

    def __init__(self, a, b, matrices):
        import meshlib.mrmeshnumpy as arrays
        import meshlib.mrmeshpy as mr

        self.mr = mr
        self.meshes = [arrays.meshFromFacesVerts(np.asarray(f, np.int32), np.asarray(v, float)) for v, f in (a, b)]
        self.a, self.b = map(mr.MeshPart, self.meshes)
        self.poses = [
            mr.AffineXf3f(mr.Matrix3f(*(mr.Vector3f(*row) for row in matrix[:3, :3])), mr.Vector3f(*matrix[:3, 3]))
            for matrix in np.asarray(matrices, float)
        ]

    def any(self):
        return [len(self.mr.findCollidingTriangles(self.a, self.b, pose, True)) > 0 for pose in self.poses]

    def faces(self):
        return [self.mr.findCollidingTriangles(self.a, self.b, pose) for pose in self.poses]

    @staticmethod
    def face_pairs(answer):
        return [(int(pair.aFace), int(pair.bFace)) for pair in answer]

    def distances(self):
        return np.array([self.mr.findDistance(self.a, self.b, pose).distSq for pose in self.poses]) ** 0.5


class Trueform:
    """trueform (licence: noncommercial use): trees of both meshes, float64."""

    name = "trueform"

    def __init__(self, a, b, matrices):
        import trueform

        self.trueform = trueform
        self.a, self.b = (trueform.Mesh(np.asarray(f, np.int32), np.asarray(v, np.float64)) for v, f in (a, b))
        for mesh in (self.a, self.b):
            mesh.build_tree()
        self.poses = [np.ascontiguousarray(matrix, np.float64) for matrix in matrices]

    def _ask(self, question):
        answers = []
        for pose in self.poses:
            self.b.transformation = pose
            answers.append(question(self.a, self.b))
        return answers

    def any(self):
        return self._ask(self.trueform.intersects)

    def faces(self):
        return self._ask(self.trueform.gather_intersecting_ids)

    @staticmethod
    def face_pairs(answer):
        return answer.tolist()

    def distances(self):
        return np.array(self._ask(self.trueform.distance))


class Parry:
    """Parry by py-parry3d: yes or no of all poses in one call, by triangle meshes in float32; it tells no faces."""

    name = "py-parry3d"

    def __init__(self, a, b, matrices):
        import py_parry3d as parry

        parry.set_num_threads(1)
        meshes = (parry.TriMesh(np.asarray(v, np.float64), np.asarray(f, np.uint32)) for v, f in (a, b))
        groups = [parry.CollisionGroup(name, [mesh]) for name, mesh in zip("ab", meshes)]
        self.world = parry.CollisionWorld(groups)
        poses = np.ascontiguousarray(matrices, np.float64)
        self.poses = {"a": np.tile(np.eye(4), (len(poses), 1, 1)), "b": poses}

    def any(self):
        return self.world.check(self.poses, [("a", "b", 0.0)]).ravel()


def run(device, quick=False):
    """Yield a row a workload and library: times [us a pose], and its answers that are not ours."""
    sizes, kinds = QUICK if quick else FULL, (Fcl, Coal, MeshLib, Trueform, Parry)
    poses, given = sizes["poses"], (sizes["repeats"], time.process_time, sizes["judged"])
    knots = ab.Model.from_arrays(*knot(300 if quick else 5000), name="knot")
    for name, models in {"knot": (knots, knots), **({} if quick else real_meshes(REAL))}.items():
        matrices = half_in_contact(models, 2 * poses)
        meet, free = (np.flatnonzero(ab.sweep(*models, matrices, device=device) == hit) for hit in (True, False))
        chosen = np.concatenate([meet[: poses // 2], free[: poses - poses // 2]])
        places = {"any": chosen, "faces": chosen, "distances": free[:poses]}
        with one_core() as core:
            answers, rows, times = measure(models, device, kinds, matrices, places, *given)
        about = {"workload": name, "core": core, "faces": models[0].face_count, "poses": poses}
        about["hits"] = len(answers["faces"].faces)
        for library, row in {"ours": {}, **rows}.items():
            if "any_missed" in row:
                row["any_differ"] = row["any_missed"] + row["any_invented"]
            asked = {question: taken[library] for question, taken in times.items() if library in taken}
            row |= {f"{question}_us": round(1e3 * float(np.median(ms)) / poses, 2) for question, ms in asked.items()}
            yield about | {"library": "warp_abtree" if library == "ours" else library} | row
