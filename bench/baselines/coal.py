"""coal, the successor of hpp-fcl: a BVHModelOBBRSS of each mesh."""

import numpy as np

from .fcl import ALL_CONTACTS


class Coal:
    """coal; as the baselines of `fcl.py`, with `distances`."""

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

    def distances(self):
        request, found = self.coal.DistanceRequest(), []
        for pose in self.poses:
            result = self.coal.DistanceResult()
            found.append(self.coal.distance(self.a, self.origin, self.b, pose, request, result))
        return np.array(found)
