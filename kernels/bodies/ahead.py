"""Speculative contact gaps of rigid bodies: the motion of a step, but little beyond the nearest faces.

Two fine surfaces that come together fast have very many pairs of faces within the motion of a step, of which the
nearest are what they meet with. So the gap of such an object pair is cut to its distance and half the size of a face.
"""

import warp as wp

from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.poses import PairBatch, active_faces
from warp_abtree.kernels.bodies.bodies import DYNAMIC, Bodies
from warp_abtree.kernels.distance.report import Distances

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

FACES_LEAST = wp.constant(wp.int32(4))
# Half of the root of the area of a ball of unit radius.
HALF_ROOT = wp.constant(wp.float64(1.7725))


@wp.struct
class Chosen:
    """Pairs whose distances are wanted, in any order."""

    count: wp.array(dtype=wp.int32)  # how many, shape [1]
    pairs: wp.array(dtype=wp.vec2i)  # their objects, shape [chosen]
    place: wp.array(dtype=wp.int32)  # index of each among all pairs, shape [chosen]
    beyond: wp.array(dtype=wp.float64)  # their gaps, how far a distance is searched [world units], shape [chosen]


@wp.func
def half_face_size(trees: Trees, state: wp.int32, radius: wp.float64):
    """Estimate half the width of a body's faces at its LOD, as if it were a ball [world units]."""
    return HALF_ROOT * radius / wp.sqrt(wp.float64(wp.max(active_faces(trees, state), FACES_LEAST)))


@wp.func
def band_of(trees: Trees, bodies: Bodies, a: wp.int32, b: wp.int32):
    """Return how far beyond their distance contacts of two objects are looked for: half a face's size [world units]."""
    band = wp.float64(wp.inf)
    if bodies.motion_type[a] == DYNAMIC:
        band = half_face_size(trees, trees.objects.state[a], bodies.bounding_radius[a])
    if bodies.motion_type[b] == DYNAMIC:
        band = wp.min(band, half_face_size(trees, trees.objects.state[b], bodies.bounding_radius[b]))
    return band


@wp.kernel
def choose_fast_kernel(
    trees: Trees, batch: PairBatch, gap: wp.array(dtype=wp.float64), bodies: Bodies, chosen_inout: Chosen
):
    """Choose the pair of a thread if its gap is wide, to find its distance as far as that."""
    p = wp.tid()
    if p >= wp.min(batch.count[0], batch.pairs.shape[0]):
        return
    if gap[p] > band_of(trees, bodies, batch.pairs[p][0], batch.pairs[p][1]):
        slot = wp.atomic_add(chosen_inout.count, 0, 1)
        chosen_inout.pairs[slot] = batch.pairs[p]
        chosen_inout.place[slot] = p
        chosen_inout.beyond[slot] = gap[p]


@wp.kernel
def cut_gap_kernel(
    trees: Trees, chosen: Chosen, distances: Distances, bodies: Bodies, gap_inout: wp.array(dtype=wp.float64)
):
    """Cut the gap of a chosen pair a thread to its distance and half a face's size; to 0 where that is over the gap."""
    i = wp.tid()
    if i < chosen.count[0]:
        upper = distances.bracket[i][1]
        band = band_of(trees, bodies, chosen.pairs[i][0], chosen.pairs[i][1])
        gap_inout[chosen.place[i]] = wp.where(upper < wp.inf, wp.min(chosen.beyond[i], upper + band), wp.float64(0.0))
