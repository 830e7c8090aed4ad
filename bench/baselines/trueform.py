"""trueform (licence: noncommercial use): trees of both meshes, float64."""

import numpy as np


class Trueform:
    """trueform; as the baselines of `fcl.py`, with `distances`."""

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
