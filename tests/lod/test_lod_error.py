"""The certified error of a LOD to its last bit: distances in fractions, and covers on fewer faces than they want."""

from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from helpers.samples import grid
from oracles.distance import exact_distance_sq

from warp_abtree.kernels.progressive.polygon import CORNERS, STACK, Scratch
from warp_abtree.kernels.progressive.triangle_cover import FLOOR, SLOTS, Replay, cover_triangle
from warp_abtree.kernels.progressive.vertex_forest import Rings, link_rings_kernel
from warp_abtree.model.progressive import build_progressive

wp.set_module_options({"enable_backward": False})


def bumpy_sheet(seed):
    """Nine vertices about a plane, eight faces."""
    vertices, faces = grid(2)
    vertices += np.random.default_rng(seed).uniform(-0.3, 0.3, (9, 3))
    return SimpleNamespace(vertices=vertices, faces=faces.astype(np.int32))


def exact(points):
    return [[Fraction(x) for x in point] for point in points.tolist()]


def test_no_vertex_lies_beyond_the_error():
    """The vertex that decides the error is measured with roundings, and would lie beyond it by some of them."""
    close = 0
    for seed in range(6):
        progressive = build_progressive(bumpy_sheet(seed), base_faces=1)
        original = exact(progressive.vertex_pos[: progressive.vertex_count])
        for lod in range(progressive.lod_max):
            vertices, faces, _ = progressive.mesh_at(lod)
            farthest = max(exact_distance_sq(p, vertices[faces]) for p in original)
            bound = Fraction(float(progressive.lod_error[lod])) ** 2
            assert farthest <= bound
            close += farthest > bound * (1 - Fraction(2) ** -36)
    assert close > 10, "elsewhere no vertex decides the error"


# --- covers on few faces ---------------------------------------------------------------------------------------------


@wp.kernel
def cover_triangle_kernel(
    room: int,
    replay: Replay,
    used_out: wp.array(dtype=int),
    bound_sq_out: wp.array(dtype=wp.float64),
):
    """Cover the current triangle, beginning at the one face in scratch.near (serial, dim=1)."""
    for k in range(3):
        replay.scratch.polygon[k] = replay.triangle_pos[0, k]
    bound_sq, used = cover_triangle(replay, 1, 1, 1, room, FLOOR * FLOOR)
    used_out[0] = used
    bound_sq_out[0] = bound_sq


@pytest.mark.parametrize("room", [1, 2, 5, int(SLOTS)])
def test_a_cover_on_fewer_faces_than_it_wants_is_measured_again(device, room):
    """Pieces that find no room stand on a face that is used already, perhaps a far one, and the bound must say so."""
    vertices, faces = grid(10)
    vertices[:, :2] = vertices[:, :2] / 10 - 0.5
    vertices[:, 2] = 0.02 * np.sin(40 * vertices[:, 0])
    triangle = np.array([[-0.45, -0.4, 0.0], [0.45, -0.3, 0.0], [0.0, 0.45, 0.0]])

    def array(values, dtype):
        return wp.array(values, dtype=dtype, device=device)

    def filled(count, value):
        return wp.full(count, value, dtype=int, device=device)

    rings = Rings()
    rings.head, rings.degree = filled(len(vertices), -1), filled(len(vertices), 0)
    rings.next, rings.corner_node = filled(faces.size, -1), filled(faces.size, -1)
    wp.launch(link_rings_kernel, 1, [len(faces), array(faces, int), rings], device=device)
    replay = Replay()
    replay.triangle_pos = array(triangle[None], wp.vec3d)
    replay.face_pos = array(vertices[faces], wp.vec3d)
    replay.face_box = array(np.stack([vertices[faces].min(1), vertices[faces].max(1)], 1), wp.vec3d)
    replay.face_stamp = filled(len(faces), -1)
    scratch = Scratch()
    scratch.near, scratch.used = filled(len(faces), len(faces) // 4), filled(int(SLOTS), -1)
    scratch.stack = wp.zeros((int(STACK), int(CORNERS)), dtype=wp.vec3d, device=device)
    scratch.stack_count = filled(int(STACK), 0)
    scratch.polygon = wp.zeros(int(CORNERS), dtype=wp.vec3d, device=device)
    scratch.clipped = wp.zeros(int(CORNERS), dtype=wp.vec3d, device=device)
    replay.scratch, replay.rings = scratch, rings
    used, bound_sq = filled(1, 0), wp.zeros(1, dtype=wp.float64, device=device)
    wp.launch(cover_triangle_kernel, 1, [room, replay], [used, bound_sq], device=device)
    count, bound = int(used.numpy()[0]), float(np.sqrt(bound_sq.numpy()[0]))
    assert count == room if room <= 5 else count > 5, "there is no want of room here"
    surface = vertices[faces[scratch.used.numpy()[:count]]]
    weights = [(i, j, 6 - i - j) for i in range(7) for j in range(7 - i)]
    points = np.array(weights) @ triangle / 6
    limit = Fraction(bound + 2.0**-43) ** 2
    assert all(exact_distance_sq(p, surface) <= limit for p in exact(points))
