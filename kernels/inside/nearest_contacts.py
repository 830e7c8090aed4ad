"""Contacts of faces that are apart whose points count only where no other face of either object is nearer."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.contacts.column import COLUMN_CORNERS
from warp_abtree.kernels.contacts.contact import Contacts
from warp_abtree.kernels.contacts.manifold import NO_POINT, Witnesses
from warp_abtree.kernels.contacts.slots import WitnessRows
from warp_abtree.kernels.distance.frame import make_scale
from warp_abtree.kernels.inside.nearest_face import make_solid, nearest_face
from warp_abtree.kernels.intersect.face_pairs import PAIR_MASK
from warp_abtree.kernels.triangle.distance import largest_coordinate

wp.set_module_options(native.options("distance/point_boxes.cuh"))

# Part of a distance under which another face is nearer.
NEARER = wp.constant(wp.float64(0.999))
# Part of sizes and positions that nearest points err by.
POINT_ROUNDING = wp.constant(wp.float64(2.0**-48))


@wp.kernel(cuda_max_registers=128)
def keep_nearest_kernel(
    trees: Trees, batch: PairBatch, rows: WitnessRows, contacts: Contacts, witnesses_inout: Witnesses
):
    """Drop the candidates of a witness if a face of an object is nearer to its points than its faces are.

    Two threads a witness, one for each object: branch and bound over its tree about the nearest point of the other.
    """
    i, k = wp.tid() / 2, wp.tid() % 2
    if i >= witnesses_inout.nearest_total[0]:
        return
    w = witnesses_inout.nearest_only[i]
    # The other thread may have dropped them.
    if wp.isnan(witnesses_inout.depth[w, 0]):
        return
    p = rows.item[w][0] & PAIR_MASK
    pose = batch.poses[p]
    a, b = wp.min(batch.pairs[p][0], batch.pairs[p][1]), wp.max(batch.pairs[p][0], batch.pairs[p][1])
    scaling = make_scale(trees, pose, a, b)
    back, position = wp.transpose(trees.objects.rotation[a]), trees.objects.position[a]
    rounding = POINT_ROUNDING * (wp.float64(1.0) / pose.scale + largest_coordinate(position))
    near = NEARER * contacts.separation[w] - rounding
    of_b = k != pose.swapped
    own = trees.objects.state[wp.where(of_b, b, a)]
    point = back * (wp.where(k == 0, contacts.p1[w], contacts.p0[w]) - position)
    solid = make_solid(trees, pose, scaling, of_b, own)
    nearest, _ = nearest_face(trees, pose, solid, point, rows.item[w][1 + k], near)
    if nearest < near:
        for j in range(COLUMN_CORNERS):
            witnesses_inout.depth[w, j] = NO_POINT
