"""Warp's own mesh queries, asked for gradients of overlaps: corners of each mesh against the other, in float32."""

import numpy as np
import warp as wp
from trimesh.transformations import rotation_matrix


@wp.func
def least_height(corners: wp.array(dtype=wp.vec3), of: wp.mat44, mesh: wp.uint64, to: wp.mat44):
    """Return the least signed distance of the corners of one mesh from another one."""
    least, into = wp.float32(1.0e6), wp.inverse(to) * of
    for v in range(corners.shape[0]):
        point = wp.transform_point(into, corners[v])
        found = wp.mesh_query_point(mesh, point, 1.0e6)
        least = wp.min(least, found.sign * wp.length(wp.mesh_eval_position(mesh, found.face, found.u, found.v) - point))
    return least


@wp.kernel
def measure_overlap_kernel(
    pairs: wp.array(dtype=wp.vec2i),
    meshes: wp.array(dtype=wp.uint64),
    poses: wp.array(dtype=wp.mat44),
    moved: wp.array2d(dtype=wp.mat44),
    distance_out: wp.array2d(dtype=wp.float32),
):
    """Measure pairs whose second object is moved in some ways, (pair, way)."""
    p, way = wp.tid()
    a, b, here, there = meshes[pairs[p][0]], meshes[pairs[p][1]], poses[pairs[p][0]], moved[p, way]
    least = least_height(wp.mesh_get(b).points, there, a, here)
    distance_out[p, way] = wp.min(least, least_height(wp.mesh_get(a).points, here, b, there))


def move_six_ways(matrices, step):
    """Return matrices (n, 4, 4) moved by a step along each axis and turned about each [rad], (n, 6, 4, 4)."""
    moved = np.repeat(matrices[:, None], 6, 1)
    moved[:, range(3), range(3), 3] += step
    for k, axis in enumerate(np.eye(3)):
        moved[:, 3 + k, :3, :3] = rotation_matrix(step, axis)[:3, :3] @ moved[:, 3 + k, :3, :3]
    return moved


class WarpMeshSlopes:
    """As `FclSlopes`, by `wp.mesh_query_point`: where two edges are nearest, it takes objects for farther apart."""

    def __init__(self, meshes, matrices, device):
        self.device, self.matrices, self.made = device, np.asarray(matrices), {}
        for vertices, faces in {id(mesh): mesh for mesh in meshes}.values():
            self.made[id(vertices)] = wp.Mesh(self._array(vertices, wp.vec3), self._array(faces.ravel(), wp.int32))
        self.ids = self._array([self.made[id(mesh[0])].id for mesh in meshes], wp.uint64)

    def _array(self, values, dtype):
        return wp.array(values, dtype=dtype, device=self.device)

    def _measure(self, pairs, moved):
        inputs = [self._array(pairs, wp.vec2i), self.ids, self._array(self.matrices, wp.mat44)]
        out = wp.empty(moved.shape[:2], dtype=wp.float32, device=self.device)
        wp.launch(measure_overlap_kernel, out.shape, [*inputs, self._array(moved, wp.mat44), out], device=self.device)
        return out.numpy().astype(float)

    def slopes(self, pairs, margin, step=1e-3):
        """Return distances (p,), and how each changes by the motions of the second object (p, 6), 0 beyond margin."""
        second, slopes = self.matrices[pairs[:, 1]], np.zeros((len(pairs), 6))
        distances = self._measure(pairs, second[:, None])[:, 0]
        near = np.flatnonzero(distances < margin)
        slopes[near] = (self._measure(pairs[near], move_six_ways(second[near], step)) - distances[near, None]) / step
        return distances, slopes
