"""Coal: a BVHModel (OBB tree with RSS) of each mesh, scaled up because of its absolute tolerance of 1e-6."""

import numpy as np

from .fcl import ALL_CONTACTS
from .interface import PoseLoop

SIZE = 2.0**12  # what the longest side of A is scaled to, or up to twice that


class Coal(PoseLoop):
    name = "coal"

    def __init__(self, a, b, matrices):
        import coal

        self.coal = coal
        self.scale = SIZE / 2.0 ** np.floor(np.log2(np.ptp(a[0], axis=0).max()))
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
