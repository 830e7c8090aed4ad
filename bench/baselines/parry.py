"""Parry by py-parry3d: yes or no of all poses in one call, by triangle meshes in float32; it tells no faces."""

import numpy as np


class Parry:
    """py-parry3d; as the baselines of `fcl.py`, yes or no alone."""

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
