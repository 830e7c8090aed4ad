"""Contacts of faces that are apart whose points count only where no other face of either object is nearer."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.contacts.contact import Contacts, have_crossed
from warp_abtree.kernels.contacts.manifold import COLUMN_CORNERS, NO_POINT, Curves, Rows
from warp_abtree.kernels.contacts.near_points import NEAREST_ONLY
from warp_abtree.kernels.distance.frame import make_scale
from warp_abtree.kernels.inside.nearest_face import make_solid, nearest_face

wp.set_module_options(native.options())

# Part of a distance under which another face is nearer.
NEARER = wp.constant(wp.float64(0.999))


@wp.kernel
def keep_nearest_kernel(trees: Trees, batch: PairBatch, rows: Rows, contacts: Contacts, curves_inout: Curves):
    """Drop the candidates of a contact a thread if a face of either object is nearer to its points than its faces are.

    By branch and bound over the tree of either object, about the nearest point of the other.
    """
    i = wp.tid()
    if i >= rows.start[rows.start.shape[0] - 1]:
        return
    if have_crossed(contacts, i) or curves_inout.loop[i] != NEAREST_ONLY:
        return
    p = rows.faces[i][0]
    pose = batch.poses[p]
    a, b = wp.min(batch.pairs[p][0], batch.pairs[p][1]), wp.max(batch.pairs[p][0], batch.pairs[p][1])
    scaling = make_scale(trees, pose, a, b)
    back, position = wp.transpose(trees.objects.rotation[a]), trees.objects.position[a]
    near = NEARER * contacts.separation[i]
    k = wp.int32(0)
    while k < 2:
        of_b = k != pose.swapped
        own = trees.objects.state[wp.where(of_b, b, a)]
        point = back * (wp.where(k == 0, contacts.p1[i], contacts.p0[i]) - position)
        solid = make_solid(trees, pose, scaling, of_b, own)
        nearest, _ = nearest_face(trees, pose, solid, point, rows.faces[i][1 + k], near)
        if nearest < near:
            for j in range(COLUMN_CORNERS):
                curves_inout.depth[i, j] = NO_POINT
            k = wp.int32(2)
        k += 1
