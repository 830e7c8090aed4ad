"""Warp arrays on the CPU, and launches there: models are built on the host."""

import numpy as np
import warp as wp

from warp_abtree.kernels.build import polygon, vertex_forest


def cpu_array(values, dtype):
    """Return a Warp array on the CPU."""
    return wp.array(values, dtype=dtype, device="cpu")


def filled(shape, value):
    """Return an int32 array on the CPU, in memory of NumPy's: that lies on huge pages where the system has them."""
    return wp.array(np.full(shape, value, np.int32), dtype=int, device="cpu", copy=False)


def unwritten(shape, dtype=int):
    """Return an array on the CPU with no values yet; what is never written takes no memory."""
    memory = np.empty((*shape, 3), np.float64) if dtype is wp.vec3d else np.empty(shape, np.int32)
    return wp.array(memory, dtype=dtype, device="cpu", copy=False)


def launch(kernel, *inputs):
    """Launch a serial kernel on the CPU."""
    wp.launch(kernel, dim=1, inputs=inputs, device="cpu")


def find_frame(vertices):
    """Return the centre and a power of two that bounds the extent, so that scaling back and forth rounds nothing."""
    lower, upper = vertices.min(axis=0), vertices.max(axis=0)
    extent = float(np.max(upper / 2 - lower / 2))
    exponent = np.frexp(extent)[1] + 1 if extent > 0 else 0
    return lower / 2 + upper / 2, float(np.ldexp(1.0, int(np.clip(exponent, -1000, 1000))))


def linked_rings(faces, node_capacity):
    """Return `vertex_forest.Rings` of the original mesh, its faces on the CPU, with room for so many nodes."""
    rings = vertex_forest.Rings()
    rings.head, rings.degree = filled(node_capacity, -1), filled(node_capacity, 0)
    rings.next, rings.corner_node = filled(3 * len(faces), -1), filled(3 * len(faces), -1)
    launch(vertex_forest.link_rings_kernel, len(faces), faces, rings)
    return rings


def make_scratch(candidates, faces, rows):
    """Return `polygon.Scratch` for so many candidate faces, covering faces and polygons on the stack."""
    scratch, corners = polygon.Scratch(), int(polygon.POLYGON_CORNERS)
    scratch.near, scratch.used = unwritten(candidates), unwritten(faces)
    scratch.stack, scratch.stack_count = unwritten((rows, corners), wp.vec3d), unwritten(rows)
    scratch.polygon = unwritten((corners,), wp.vec3d)
    return scratch
