"""MeshLib: AABB trees of both meshes, vertices and poses in float32."""

import numpy as np


class MeshLib:
    """MeshLib; as the baselines of `fcl.py`, with `distances`. Its trees are built by the first call."""

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
