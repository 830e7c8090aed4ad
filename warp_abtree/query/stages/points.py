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

from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import whole_number
from warp_abtree.kernels.base.lanes import WARP_SIZE
from warp_abtree.kernels.contacts import contact, loops, manifold, near_points
from warp_abtree.kernels.contacts import points as point_kernels
from warp_abtree.kernels.inside import inside_points, nearest_contacts
from warp_abtree.query.operator import Operator
from warp_abtree.query.result import VECTORS, Found, Result
from warp_abtree.query.stage import Array, Rooms, Stage, fields
from warp_abtree.query.stages.contacts import ContactStage, plan_contacts, warn_of_winding
from warp_abtree.query.stages.slots import SlotStage
from warp_abtree.query.staging import first_rows

POINTS_MAX = int(manifold.POINTS)
CANDIDATES = int(manifold.COLUMN_CORNERS)
POINT_FIELDS = {"point": wp.vec3d, "normal": wp.vec3d, "depth": wp.float64}


def make_twists() -> np.ndarray:
    """Return the twists by which points are chosen, by component, float32 (6 TWIST_COUNT,).

    Random unit vectors of six components, then directions in a plane, of turns about lines at the rim of candidates.
    """
    random, turns = point_kernels.RANDOM_TWISTS, (point_kernels.TWIST_COUNT - point_kernels.RANDOM_TWISTS) // 2
    twists = np.zeros((point_kernels.TWIST_COUNT, 6))
    # The legacy generator, whose numbers are the same for good.
    twists[:random] = np.random.RandomState(0).normal(size=(random, 6))
    twists[:random] /= np.linalg.norm(twists[:random], axis=1)[:, None]
    angles = np.tile(np.arange(turns) * 2 * np.pi / turns, 2)
    twists[random:, :2] = np.stack([np.cos(angles), np.sin(angles)], 1)
    return twists.T.astype(np.float32).ravel()


class PointStage(Stage):
    """Reduce the contacts of each pair to points.

    Args:
        slots: `SlotStage`, the stage that has reduced what is near.
        contacts: `ContactStage`, the stage before, of what crosses, whose scratch serves on.
        with_gap: Whether faces that are apart have contacts, too.
        point_max: As `ManifoldQuery.point_max`.

    Attributes:
        manifolds, curves, witnesses: Device arrays of `kernels.contacts.manifold`: points of pairs, loops of contacts,
            and candidates.
        near: Contacts of those witnesses that are apart, `kernels.contacts.contact.Contacts`.
    """

    def __init__(self, slots: SlotStage, contacts: ContactStage, with_gap: bool, point_max: int):
        self._slots, self._contacts, self._with_gap, self.point_max = slots, contacts, with_gap, point_max
        self.manifolds, self.curves = manifold.Manifolds(), manifold.Curves()
        self.witnesses, self.near = manifold.Witnesses(), contact.Contacts()

    def attach(self, operator: Operator):
        """Take the operator."""
        super().attach(operator)
        self._twists = wp.array(make_twists(), dtype=wp.float32, device=operator.device)
        self._no_gap = wp.empty(0, dtype=wp.float64, device=operator.device)

    def arrays(self, rooms: Rooms) -> list[Array]:
        """Return what has an entry a contact, a witness or a pair."""
        witnesses, room = self.witnesses, self._slots.room(rooms)
        near = fields(self.near, room, **dict.fromkeys(VECTORS, wp.vec3d), coplanar=wp.int32, separation=wp.float64)
        return [
            *fields(self.curves, rooms.hits, parent=wp.int32, loop=wp.int32, loop_normal=wp.vec3d, has_area=wp.int32),
            *fields(witnesses, (room, CANDIDATES), point=wp.vec3d, depth=wp.float64),
            *fields(witnesses, room, normal=wp.vec3d, nearest_only=wp.int32),
            Array(witnesses, "wrench", wp.vec4, 2 * CANDIDATES * room),
            *(near if self._with_gap else []),
            Array(self.manifolds, "count", wp.int32, rooms.pairs, 0),
            *fields(self.manifolds, (rooms.pairs, self.point_max), **POINT_FIELDS),
        ]

    def report(self, count: int | None):
        """Reduce the contacts of the hits in place. Launches only."""
        operator, launch, contacts = self.operator, self.operator.launch_kernel, self._contacts.contacts
        gap = operator.hits.gap if self._with_gap else self._no_gap
        posed = [operator.batch.trees, operator.pair_batch, gap]
        self._offer_crossing(self._contacts.places(count), posed)
        self._slots.list_witnesses()
        room, found = self._slots.room(operator.rooms), [operator.hits, self._slots.rows]
        some = room if count is None else min(room, count)
        inputs = [*posed, self._contacts.faces, contacts, self.curves, *found, self.witnesses]
        launch(manifold.find_crossing_kernel, some, inputs, WARP_SIZE)
        if self._with_gap:
            launch(near_points.find_near_witness_kernel, some, [*posed, *found, self.near, self.witnesses], WARP_SIZE)
            inputs = [*posed[:2], *found, self.near, self.witnesses]
            launch(nearest_contacts.keep_nearest_kernel, some, inputs, WARP_SIZE)
        self._choose_points([operator.batch.objects.pool, operator.pair_batch, self._twists, gap])
        self._add_inside_points()

    def _offer_crossing(self, count: int, posed):
        """Find the loops of what crosses, and offer its candidates to the slots. Launches only."""
        of, operator, curves, launch = self._contacts, self.operator, self.curves, self.operator.launch_kernel
        start, faces, contacts, sorted_by = of.start, of.faces, of.contacts, (of.order, of.key)
        launch(loops.begin_loop_kernel, count, [start, faces, curves, *sorted_by])
        self._sort_keys(count, 31 + operator.rooms.pairs.bit_length())
        launch(loops.link_loop_kernel, count, [start, faces, contacts, *sorted_by, curves])
        launch(loops.name_loop_kernel, count, [start, curves, *sorted_by])
        self._sort_keys(count, 31)
        inputs = [*posed[:2], start, faces, contacts, of.order, curves]
        launch(loops.average_loop_kernel, -(-count // WARP_SIZE) * WARP_SIZE, inputs, WARP_SIZE)
        inputs = [*posed, start, faces, of.order, contacts, curves, self._slots.slots]
        launch(manifold.offer_crossing_kernel, -(-count // WARP_SIZE) * WARP_SIZE, inputs)

    def _choose_points(self, given):
        """Choose the points of each pair. Launches only."""
        operator, room = self.operator, self.operator.rooms.pairs
        block = point_kernels.TWIST_COUNT if operator.device.is_cuda else 1
        inputs = [*given, self._slots.rows, self.witnesses, self.manifolds]
        chooser = point_kernels.point_chooser(self.point_max)
        operator.launch_kernel(chooser, room * block, inputs, point_kernels.TWIST_COUNT)

    def _add_inside_points(self):
        """Add points of what is inside, where there are solids. Launches only."""
        operator, solids = self.operator, self.operator.batch.solids
        if solids is not None:
            inputs = [operator.traversal.stack_length(), operator.batch.trees, solids.pool, operator.pair_batch]
            inputs += [operator.hits, self.manifolds]
            operator.launch_warps(inside_points.add_inside_point_kernel, operator.rooms.pairs, inputs)

    def _sort_keys(self, count, bits):
        with wp.ScopedDevice(self.operator.device):
            wp.utils.radix_sort_pairs(self._contacts.key, self._contacts.order, count, end_bit=bits)

    def read(self, found: Found, device: bool, with_rows: bool):
        """Read the points."""
        if not with_rows:
            return
        pairs = len(found.pairs)
        arrays = {name: first_rows(getattr(self.manifolds, name), pairs) for name in ("count", *POINT_FIELDS)}
        if device:
            found.points = {name: wp.clone(array) for name, array in arrays.items()}
            return
        points = arrays.pop("count").numpy()
        used = np.arange(self.point_max) < points[:, None]
        found.points = {"pair": np.repeat(np.arange(pairs), points)}
        for name, array in arrays.items():
            found.points[name] = array.numpy()[used]


class ManifoldQuery(Operator):
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
    faces: wp.array
    start: wp.array

    def __init__(self, scene, pairs=None, capacity=None, precision="exact", gap=None, points=POINTS_MAX):
        self.point_max = whole_number(points, "points", 1, 64)
        stages = plan_contacts(precision, None, gap, sums=False)
        contacts: Any = stages[-1]
        slots: Any = next(stage for stage in stages if isinstance(stage, SlotStage))
        found = PointStage(slots, contacts, gap is not None, self.point_max)
        self.contacts, self.manifolds, self.curves = contacts.contacts, found.manifolds, found.curves
        self.witnesses, self.witness_rows, self.near_contacts = found.witnesses, slots.rows, found.near
        warn_of_winding(scene)
        super().__init__(scene, [*stages, found], pairs, capacity, "faces", sort_pairs=True)

    def set_pairs(self, pairs, within=None, gap=None):
        """Query other pairs from now on, as `ContactQuery.set_pairs`; there is no within."""
        self.ask_pairs(pairs, within=within, gap=gap)

    def result(self, device: bool = False, with_points: bool = True) -> Result:
        """Return the counts and, unless told otherwise, the contact points of the last launch, as `Query.result`."""
        return self.readout.read(device, with_points)
