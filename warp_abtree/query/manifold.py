"""Contact points: the contacts of an object pair reduced to a few points that a solver can push on; `ManifoldQuery`.

Meshes meet in curves, and a curve alone has no depth. Here is what is made of it, for each object pair:

* Contacts that share a face of either object form a loop, unless their other faces are two walls that face each other:
  what jams in a slot has a loop at either wall. The normal of a loop is the direction of the area vector of
  its curve, 1/2 sum p x dp: the volume that two closed surfaces share shrinks by that vector times a motion, so it is
  the way out, for edges against edges and for corners too, and it needs the curve alone. A curve without area gives way
  to the mean of its contacts' normals.
* A contact's depth is how far the one face lies behind the other's plane within the column of that face along the
  normal, at the deepest place. Where the normal of either face is within 60 degrees of the loop's and makes that
  depth no larger, it takes the place of the loop's: so a box in a corner is pushed by floor and wall, each its own way.
  So does that of either face, however it looks, where neither is within 60 degrees of the loop's and one looks the
  other way: a contact loop over both flanks of a screw thread has no single separating direction.
* Of all candidates of the pair an outermost one is taken, then those farthest, in place and in normal, from the
  segments between those before, and the deepest, up to 8 of them or as many as asked for, in the order in which they
  lie along a fixed direction of the lower object: points that stay keep their order from launch to launch.

With `gap=d` faces that are apart but nearer than d have candidates too, with minus a separation as depth. Where two
faces look at one another within 60 degrees it is measured along the normal that leaves the wider gap: the nearest point
of the one face's part within the column of the other, and one far from it. Where their distance is in another
direction, as across two edges, it is their nearest points. A face behind the other's plane is inside, as deep as it is
far: so what lies up to d inside is not forgotten once it no longer crosses. Across edges and inside, points count only
if no other face of either object is nearer to them: so a box that slides over a floor of many faces is not stopped by
the edges between them. Depths count from the gap on for what is half as deep as what.

Normals come from the winding of the faces, outwards. Depth is exact while every vertex inside has a face that crosses;
once a whole ring of faces is inside it is that ring's, too little, and without a gap an object that lies whole inside
another has no points. Solids (`Scene.add`) have more. Of an object pair that intersects, of which one is a solid:

* Corners of one object inside the other, a solid, have as depth their distance from its surface, and the way there as
  normal. Up to four become points, the deepest first, a quarter of the smaller object's size (the diagonal of its box)
  from one another and at least half as deep as the first, and take the places of the nearest others if there is no
  room.
* They are looked for where they are needed: only corners that are deeper than all other points of the pair by 1/4096 of
  that size count, and pairs whose points are all less deep than that are passed over.
* Their ways out are within 90 degrees of the sum of the other points' normals; of what lies inside whole, of the way
  out of the middle of its box. So they do not hold an object from both sides.

Of two thin surfaces that are through each other the way out is as likely forwards as back.

Source of the area vector as a gradient: Allard et al. 2010, Volume Contact Constraints at Arbitrary Resolution,
section 3; that the boundary curve gives it is Stokes' theorem.
"""

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import whole_number
from warp_abtree.kernels.base.lanes import WARP_SIZE
from warp_abtree.kernels.contacts import contact, loops, manifold, near_points
from warp_abtree.kernels.contacts import points as point_kernels
from warp_abtree.kernels.inside import inside_points
from warp_abtree.query.contacts import ContactQuery
from warp_abtree.query.result import Found, Result
from warp_abtree.query.staging import first_rows

POINTS_MAX = int(manifold.POINTS)


class ManifoldQuery(ContactQuery):
    """Contact points of many object pairs as an operator: `ContactQuery`, then the points of each pair.

    Pairs of the broad phase are sorted by their objects, so that nothing depends on the order in which it found them.

    Args:
        scene, pairs, capacity, precision, gap: As for `ContactQuery`.
        points: Most points of a pair, 1 to 64. Those beyond the eighth lie farthest from any before them.

    Attributes:
        manifolds: Points of each pair, device arrays (pair capacity, points) of `kernels.contacts.manifold.Manifolds`.
        point_max: Most points of a pair.
    """

    growth = 2

    def __init__(self, scene, pairs=None, capacity=None, precision="exact", gap=None, points=POINTS_MAX):
        self.point_max = whole_number(points, "points", 1, 64)
        self.manifolds, self.curves, self._large = manifold.Manifolds(), manifold.Curves(), contact.Deferred()
        self._large.total = wp.zeros(1, dtype=wp.int32, device=scene.device)
        super().__init__(scene, pairs, capacity, precision, sort_pairs=True, gap=gap)
        self._no_gap = wp.empty(0, dtype=wp.float64, device=self.device)

    def _place_arrays(self, capacity: int) -> list:
        made = super()._place_arrays(capacity)
        made += [(self.curves, name, self._empty(capacity, wp.int32)) for name in ("parent", "loop", "listed", "seen")]
        made += [(self.curves, name, self._empty(capacity, wp.vec3d)) for name in ("loop_normal", "normal")]
        made.append((self.curves, "point", self._empty((capacity, 2), wp.vec3d)))
        made += [(self.curves, name, self._empty((capacity, 2), wp.float64)) for name in ("depth", "nearest")]
        return made

    def _pair_arrays(self, room: int) -> list:
        made = super()._pair_arrays(room)
        points = (room, self.point_max)
        made.append((self._large, "place", self._empty(room, wp.int32)))
        made.append((self.manifolds, "count", wp.zeros(room, dtype=wp.int32, device=self.device)))
        for name, dtype in (("point", wp.vec3d), ("normal", wp.vec3d), ("depth", wp.float64)):
            made.append((self.manifolds, name, self._empty(points, dtype)))
        return made

    def find_contacts(self, count: int | None = None):
        """Sort the hits in place, make their contacts, and reduce them to points. Launches only."""
        count = self._places if count is None else min(count, self._places)
        self._sort(count)
        self._find(count)
        room = len(self.pairs)
        start, rows, curves, contacts = self.start, self.faces, self.curves, self.contacts
        gap = self._no_gap if self._gap is None else self.hits.gap
        posed = [self.batch.trees, self.pair_batch]
        listed = self._deferred
        inputs = [start, rows, curves, self._order, self._key, listed.total, self._large.total]
        self._launch_kernel(loops.begin_loop_kernel, count, inputs)
        self._sort_keys(count, 31 + room.bit_length())
        self._launch_kernel(loops.link_loop_kernel, count, [start, rows, contacts, self._order, self._key, curves])
        if self._gap is not None:
            self._find_near(count, posed, gap)
        self._launch_kernel(loops.name_loop_kernel, count, [start, contacts, curves, self._order, self._key])
        self._sort_keys(count, 31)
        inputs = [*posed, start, rows, contacts, self._order, curves]
        self._launch_kernel(loops.average_loop_kernel, -(-count // WARP_SIZE) * WARP_SIZE, inputs, WARP_SIZE)
        inputs = [*posed, gap, self._ordered_rows(), contacts, curves]
        self._launch_kernel(manifold.find_candidate_kernel, count, inputs)
        self._spread_points([self.batch.objects.pool, self.pair_batch, gap, start])
        self._add_inside_points()

    def _ordered_rows(self):
        rows = manifold.Rows()
        rows.start, rows.faces, rows.order, rows.key = self.start, self.faces, self._order, self._key
        return rows

    def _spread_points(self, posed):
        """Choose the points of each pair: on CUDA by a warp, of pairs with many contacts by a block. Launches only."""
        cuda, room = self.device.is_cuda, len(self.pairs)
        largest = int(point_kernels.LARGE_PAIR) if cuda else np.iinfo(np.int32).max
        spread = point_kernels.point_spreader(self.point_max)
        self._launch_warps(spread, room, [largest, *posed, self.curves, self._large, self.manifolds])
        if cuda:
            spread = point_kernels.large_point_spreader(self.point_max)
            blocks, threads = min(room, self.device.sm_count), point_kernels.LARGE_BLOCK
            inputs = [blocks, *posed, self._large, self.curves, self.manifolds]
            self._launch_kernel(spread, blocks * threads, inputs, threads)

    def _find_near(self, count, posed, gap):
        """Find the candidates of faces that are apart. Launches only."""
        both, contacts, listed, curves = self._ordered_rows(), self.contacts, self._deferred, self.curves
        warps, threads = (-(-count // share) for share in (int(near_points.CONTACTS_A_WARP), WARP_SIZE))
        inputs = [self.batch.objects.pool, self.pair_batch, both, contacts, listed, curves]
        self._launch_kernel(near_points.find_near_candidate_kernel, threads * WARP_SIZE, inputs, WARP_SIZE)
        inputs = [*posed, gap, both, contacts, listed, curves]
        self._launch_kernel(near_points.find_facing_candidate_kernel, count, inputs, WARP_SIZE)
        self._launch_warps(near_points.keep_nearest_kernel, warps, [*posed, both, contacts, curves])

    def _add_inside_points(self):
        """Add points of what is inside, where there are solids. Launches only."""
        if self.batch.solids is not None:
            inputs = [self._stack_length(), self.batch.trees, self.batch.solids.pool, self.pair_batch]
            inputs += [self.hits, self.manifolds]
            self._launch_warps(inside_points.add_inside_point_kernel, len(self.pairs), inputs)

    def _sort_keys(self, count, bits):
        with wp.ScopedDevice(self.device):
            wp.utils.radix_sort_pairs(self._key, self._order, count, end_bit=bits)

    def result(self, device: bool = False, with_points: bool = True) -> Result:
        """Return the counts and, unless told otherwise, the contact points of the last launch, as `Query.result`."""
        return self._read(device, with_points)

    def _read_rows(self, found: Found, count: int, device: bool):
        pairs, names = len(found.pairs), ("point", "normal", "depth")
        arrays = {name: first_rows(getattr(self.manifolds, name), pairs) for name in ("count", *names)}
        if device:
            found.points = {name: wp.clone(array) for name, array in arrays.items()}
            return
        points = arrays["count"].numpy()
        used = np.arange(self.point_max) < points[:, None]
        found.points = {"pair": np.repeat(np.arange(pairs), points)}
        for name in names:
            found.points[name] = arrays[name].numpy()[used]
