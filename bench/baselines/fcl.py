"""python-fcl, a BVHModel (OBB tree with RSS) of each mesh or convex solids by GJK; and trimesh, which calls it.

Baselines that answer pose by pose have `any`, whether A at the origin and B intersect at each pose, and `faces`, an
answer a pose from which `face_pairs` reads all intersecting face pairs. Without the library they raise ImportError.
"""

import numpy as np

from .warp_mesh import move_six_ways

ALL_CONTACTS = 2**31 - 1


def make_tree(vertices, faces):
    """Return a BVHModel of a mesh."""
    import fcl

    tree = fcl.BVHModel()
    tree.beginModel(len(vertices), len(faces))
    tree.addSubModel(vertices, faces)
    tree.endModel()
    return tree


class Fcl:
    """python-fcl.

    Args:
        a, b: Vertices float64 (v, 3) and faces int32 (f, 3); one object if both are one mesh.
        matrices: Poses of B, float64 (n, 4, 4).
        convex: Whether the meshes are convex solids.
    """

    name = "python-fcl"

    def __init__(self, a, b, matrices=(), convex=False):
        import fcl

        self.fcl, self.convex = fcl, convex
        shape_a = self._make_shape(*a)
        self.shape_b = shape_a if b is a else self._make_shape(*b)
        self.a = fcl.CollisionObject(shape_a, fcl.Transform())
        self.yes_no = fcl.CollisionRequest()
        self.all = fcl.CollisionRequest(num_max_contacts=ALL_CONTACTS, enable_contact=True)
        self.place(matrices)

    def _make_shape(self, vertices, faces):
        if self.convex:
            corners = np.concatenate([np.full((len(faces), 1), 3), faces], 1).flatten()
            return self.fcl.Convex(vertices, len(faces), corners)
        return make_tree(vertices, faces)

    def place(self, matrices):
        """Make an object of B for each pose."""
        transforms = [self.fcl.Transform(matrix[:3, :3], matrix[:3, 3]) for matrix in matrices]
        self.b = [self.fcl.CollisionObject(self.shape_b, transform) for transform in transforms]

    def _collide(self, request, b):
        result = self.fcl.CollisionResult()
        self.fcl.collide(self.a, b, request, result)
        return result

    def any(self, poses=slice(None)):
        return [self._collide(self.yes_no, b).is_collision for b in self.b[poses]]

    def faces(self, poses=slice(None)):
        return [self._collide(self.all, b) for b in self.b[poses]]

    def distances(self, poses=slice(None)):
        """Return the distance at each of some poses, negative or 0 where A and B intersect."""
        ask, request = self.fcl.distance, self.fcl.DistanceRequest()
        return np.array([ask(self.a, b, request, self.fcl.DistanceResult()) for b in self.b[poses]])

    def first_contacts(self, ends, tolerance=1e-4):
        """Return when A, at rest, and B first touch on B's way to each of some matrices (n, 4, 4), 1 if never.

        By conservative advancement, the origin on a straight line, constant angular velocity.
        """
        fcl, still, answers = self.fcl, self.fcl.Transform(), []
        request = fcl.ContinuousCollisionRequest(toc_err=tolerance, ccd_motion_type=1, ccd_solver_type=1)
        for b, end in zip(self.b, ends, strict=True):
            end, result = fcl.Transform(end[:3, :3], end[:3, 3]), fcl.ContinuousCollisionResult()
            answers.append(fcl.continuousCollide(self.a, still, b, end, request, result))
        return np.array(answers)

    @staticmethod
    def face_pairs(answer):
        """Return the face numbers in one answer, (k, 2)."""
        return [(contact.b1, contact.b2) for contact in answer.contacts]


class FclRobot:
    """python-fcl, asked what an `ab.Robot` is asked about a model around it: a BVHModel a link, pair by pair until two
    intersect."""

    def __init__(self, robot, around):
        import fcl

        self.fcl, self.robot = fcl, robot
        self.around, *self.parts = (
            fcl.CollisionObject(make_tree(*model.mesh_at(model.lod_max)[:2]), fcl.Transform())
            for model in (around, *robot.models)
        )
        moving = [k for k, link in enumerate(robot.model_link) if link not in robot.mounted]
        self.pairs = [(self.parts[k], self.around) for k in reversed(moving)]
        self.pairs += [(self.parts[i], self.parts[j]) for i, j in robot.pairs.tolist()]

    def any(self, poses):
        """Return whether parts meet at each of some link poses (c, links, 4, 4)."""
        return np.array([self._meets(row[self.robot.model_link]) for row in poses])

    def _meets(self, matrices):
        for part, matrix in zip(self.parts, matrices):
            part.setTransform(self.fcl.Transform(matrix[:3, :3], matrix[:3, 3]))
        request = self.fcl.CollisionRequest()
        return any(self.fcl.collide(a, b, request, self.fcl.CollisionResult()) for a, b in self.pairs)


class FclSlopes:
    """python-fcl, asked for gradients of the overlap max(margin - d, 0) of pairs, by differences along one's motions.

    Where meshes intersect, d is minus the depth of the deepest contact: FCL has no signed distance of meshes.

    Args:
        meshes: (vertices, faces) of each object.
        matrices: Poses of the objects, float64 (n, 4, 4).
    """

    def __init__(self, meshes, matrices):
        import fcl

        self.fcl, self.matrices = fcl, matrices
        trees = {id(mesh): make_tree(*mesh) for mesh in meshes}
        self.objects = [fcl.CollisionObject(trees[id(mesh)], fcl.Transform()) for mesh in meshes]
        for thing, matrix in zip(self.objects, matrices):
            self._place(thing, matrix)
        self.all = fcl.CollisionRequest(num_max_contacts=ALL_CONTACTS, enable_contact=True)

    def _place(self, thing, matrix):
        thing.setTransform(self.fcl.Transform(matrix[:3, :3], matrix[:3, 3]))

    def distance(self, i, j):
        """Return the distance of two objects, minus a depth where they intersect."""
        a, b, result = self.objects[i], self.objects[j], self.fcl.CollisionResult()
        distance = self.fcl.distance(a, b, self.fcl.DistanceRequest(), self.fcl.DistanceResult())
        if distance > 0:
            return distance
        self.fcl.collide(a, b, self.all, result)
        return -max((contact.penetration_depth for contact in result.contacts), default=0.0)

    def slopes(self, pairs, margin, step=1e-6):
        """Return distances (p,), and how each changes by the motions of the second object (p, 6), 0 beyond margin."""
        distances, slopes = np.array([self.distance(i, j) for i, j in pairs]), np.zeros((len(pairs), 6))
        near = np.flatnonzero(distances < margin)
        for p, ways in zip(near, move_six_ways(self.matrices[pairs[near, 1]], step)):
            i, j = pairs[p]
            for axis, moved in enumerate(ways):
                self._place(self.objects[j], moved)
                slopes[p, axis] = (self.distance(i, j) - distances[p]) / step
            self._place(self.objects[j], self.matrices[j])
        return distances, slopes


class Trimesh:
    """trimesh: two CollisionManagers of one object each, which hold python-fcl's trees; B is moved for each pose."""

    name = "trimesh"

    def __init__(self, a, b, matrices):
        import fcl  # noqa: F401 - trimesh has its managers from it
        import trimesh
        from trimesh.collision import CollisionManager

        self.a, self.b, self.matrices = CollisionManager(), CollisionManager(), matrices
        self.a.add_object("a", trimesh.Trimesh(*a, process=False))
        self.b.add_object("b", trimesh.Trimesh(*b, process=False))

    def any(self, **wanted):
        answers = []
        for matrix in self.matrices:
            self.b.set_transform("b", matrix)
            answers.append(self.a.in_collision_other(self.b, **wanted))
        return answers

    def faces(self):
        return self.any(return_data=True)

    @staticmethod
    def face_pairs(answer):
        return [(contact.index("a"), contact.index("b")) for contact in answer[1]]
