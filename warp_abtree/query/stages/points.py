"""Contact points: the contacts of each object pair reduced to a few points that a solver can push on; `ManifoldQuery`.

Face pairs are offered to slots by normal and direction (`kernels.contacts.slots`), which keep 380 witnesses an object
pair at most, whatever the order of offers. Faces that cross are found exactly and have contacts
(`query.stages.contacts`); their candidate points are measured in float64 before the offer. With `gap=d` faces that are
apart but nearer are offered in float32; the winners are measured in float64, and dropped if they are not nearer than d.

* Crossing contacts that share a face of either object form a loop, unless their other faces are two walls that face
  each other: what jams in a slot has a loop at either wall. The normal of a loop is that of the area vector of its
  curve, (1/2) sum p x dp: the volume that two closed surfaces share shrinks by that vector times a motion, so it is the
  way out, for edges and corners too. Without area it is the mean of the contacts' normals.
* Their depth is how far the one face lies behind the other's plane within the column of that face along the normal, at
  each corner there. Where the normal of either face is within 60 degrees of the loop's and makes the depth no larger,
  it takes the place of the loop's: so a box in a corner is pushed by floor and wall, each its own way. So does that of
  either face where neither is and one looks the other way: a contact loop over both flanks of a screw thread has no
  single separating direction.
* Faces that are apart have minus a separation as depth (`kernels.contacts.near_points`). Where they look at one another
  within 60 degrees all corners within the column count, along whichever normal leaves the wider gap, if that is the
  distance; else, as across edges, the middle of the nearest points. A face behind the other's plane is inside, as deep
  as it is far. Nearer than 2^-30 of the sizes, where rounding tells directions, a face's normal serves that has the
  other face in front.
* Edges and what is inside count only if a tree search finds no other face nearer. Contacts at edges that nearer faces
  cover are left out on purpose: edges between the faces of a floor would stop what slides past.

Points are chosen in float32 (`kernels.contacts.points`): the candidate that the most violated of 256 twists takes
deepest, until none is violated by more than 2^-10 of the motion, 2 (gap + depth) + size / 256. The deepest, or one
nearly as deep, is among them. They lie in order along a fixed direction of the lower object, so that those that stay
keep their order.

Normals come from the winding of the faces, outwards. Depth is exact while every vertex inside has a face that crosses;
once a whole ring of faces is inside it is that ring's, too little, and without a gap an object that lies whole inside
another has no points. Solids (`Scene.add`) have more: where the pair intersects, corners of one object inside the
other, a solid, that are deeper than all other points by 1/4096 of the smaller object's size (the diagonal of its box)
have their distance from its surface as depth, and the way there as normal. A pair whose points are all less deep than
that is passed over. Up to four become points, the deepest first, a quarter of that size apart and at least half as deep
as the first, in the places of the nearest others if there is no room. Their ways out are within 90 degrees of the sum
of the other points' normals; of what lies inside whole, of the way out of the middle of its box: they do not hold an
object from both sides. Of two thin surfaces that are through each other the way out is as likely forwards as back.

Source of the area vector as a gradient: Allard et al. 2010, Volume Contact Constraints at Arbitrary Resolution, section
3; that the boundary curve gives it is Stokes' theorem.
"""

from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import flag, whole_number
from warp_abtree.checks.radix_sort import radix_sort
from warp_abtree.kernels.base.lanes import WARP_SIZE
from warp_abtree.kernels.contacts import column, contact, loops, manifold, near_points
from warp_abtree.kernels.contacts import points as point_kernels
from warp_abtree.kernels.inside import inside_points, nearest_contacts
from warp_abtree.query.operator import Operator
from warp_abtree.query.point_parts import PartGaps, PointParts, needs_parts
from warp_abtree.query.request import more_room
from warp_abtree.query.result import VECTORS, Found, Result
from warp_abtree.query.stage import Array, Rooms, Stage, fields
from warp_abtree.query.stages.contacts import ContactStage, plan_contacts, warn_of_winding
from warp_abtree.query.stages.intersect import GapStage
from warp_abtree.query.stages.memory import MemoryStage, check_remember
from warp_abtree.query.stages.originals import OriginalStage
from warp_abtree.query.stages.slots import SlotStage
from warp_abtree.query.staging import first_rows

POINTS_MAX = int(manifold.POINTS)
CANDIDATES = int(column.COLUMN_CORNERS)
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
        memory: `MemoryStage`, or None.
        originals: `OriginalStage`, or None.

    Attributes:
        manifolds, curves, witnesses: Device arrays of `kernels.contacts.manifold`: points of pairs, loops of contacts,
            and candidates.
        near: Contacts of those witnesses that are apart, `kernels.contacts.contact.Contacts`.
    """

    def __init__(
        self, slots: SlotStage, contacts: ContactStage, with_gap: bool, point_max: int, memory=None, originals=None
    ):
        self._memory: MemoryStage | None = memory
        self._originals: OriginalStage | None = originals
        self._kept = {} if originals is None else {"witness": wp.int32}
        self._fields = POINT_FIELDS if memory is None else {**POINT_FIELDS, "before": wp.int32}
        self._slots, self._contacts, self._with_gap, self.point_max = slots, contacts, with_gap, point_max
        self.manifolds, self.curves = manifold.Manifolds(), manifold.Curves()
        self.witnesses, self.near = manifold.Witnesses(), contact.Contacts()

    def attach(self, operator: Operator):
        """Take the operator."""
        super().attach(operator)
        self._twists = wp.array(make_twists(), dtype=wp.float32, device=operator.device)
        self._no_gap = wp.empty(0, dtype=wp.float64, device=operator.device)
        self._face_bits = int(operator.batch.models.face_count.max()).bit_length()

    def arrays(self, rooms: Rooms) -> list[Array]:
        """Return what has an entry a contact, a witness or a pair."""
        witnesses, room = self.witnesses, self._slots.room(rooms)
        near = fields(self.near, room, **dict.fromkeys(VECTORS, wp.vec3d), coplanar=wp.int32, separation=wp.float64)
        return [
            *fields(self.curves, rooms.hits, parent=wp.int32, loop=wp.int32, loop_normal=wp.vec3d, has_area=wp.int32),
            *fields(witnesses, (room, CANDIDATES), point=wp.vec3d, depth=wp.float64),
            *fields(witnesses, room, normal=wp.vec3d, nearest_only=wp.int32),
            Array(witnesses, "nearest_total", wp.int32, 1, 0),
            Array(witnesses, "wrench", wp.vec4, 2 * CANDIDATES * room),
            *fields(witnesses, (rooms.pairs, self.point_max), chosen=wp.int32, place=wp.vec3d),
            *(near if self._with_gap else []),
            Array(self.manifolds, "count", wp.int32, rooms.pairs, 0),
            *fields(self.manifolds, (rooms.pairs, self.point_max), **self._fields, **self._kept),
        ]

    def link(self):
        """Let the sort of loops have the scratch of that of hits."""
        self.curves.order, self.curves.key = self._contacts.order, self._contacts.key

    def search(self):
        """Take what is known of pairs that rest. Launches only."""
        if self._memory is not None:
            self._memory.resume()

    def report(self, count: int | None):
        """Reduce the contacts of the hits in place. Launches only."""
        operator, launch, contacts = self.operator, self.operator.launch_kernel, self._contacts.contacts
        gap = operator.hits.gap if self._with_gap else self._no_gap
        posed = [operator.batch.trees, operator.pair_batch, gap]
        self._offer_crossing(self._contacts.places(count), posed)
        self._slots.list_witnesses()
        room, found = self._slots.room(operator.rooms), [operator.hits, self._slots.rows]
        some = room if count is None else min(room, count)
        inputs = [*posed, contacts, self.curves, *found, self.witnesses]
        launch(manifold.find_crossing_kernel, some, inputs, WARP_SIZE)
        if self._with_gap:
            launch(near_points.find_near_witness_kernel, some, [*posed, *found, self.near, self.witnesses], WARP_SIZE)
            inputs = [*posed[:2], self._slots.rows, self.near, self.witnesses]
            launch(nearest_contacts.keep_nearest_kernel, 2 * some, inputs, WARP_SIZE)
        self._choose_points([operator.batch.objects.pool, operator.pair_batch, self._twists, gap])
        if self._originals is not None:
            self._originals.project(gap, contacts.face, self._slots.rows, self.manifolds)
        self._add_inside_points()
        if self._memory is not None:
            self._memory.keep(self.manifolds)

    def _offer_crossing(self, count: int, posed):
        """Find the loops of what crosses, and offer its candidates to the slots. Launches only."""
        operator, launch, looped = self.operator, self.operator.launch_kernel, [self._contacts.contacts, self.curves]
        launch(loops.begin_loop_kernel, count, [self._face_bits, *looped])
        self._sort_keys(count, self._face_bits + operator.rooms.pairs.bit_length())
        launch(loops.link_loop_kernel, count, looped)
        launch(loops.name_loop_kernel, count, looped)
        self._sort_keys(count, count.bit_length())
        launch(loops.average_loop_kernel, -(-count // WARP_SIZE) * WARP_SIZE, [*posed[:2], *looped], WARP_SIZE)
        inputs = [*posed, *looped, self._slots.slots]
        if operator.uses_warps():
            launch(manifold.offer_crossing_kernel, count, inputs)
        else:
            launch(manifold.offer_pair_crossing_kernel, operator.rooms.pairs, inputs)

    def _choose_points(self, given):
        """Choose the points of each pair. Launches only."""
        operator, room = self.operator, self.operator.rooms.pairs
        block = point_kernels.TWIST_COUNT if operator.device.is_cuda else 1
        inputs = [*given, self._slots.rows, self.witnesses, self.manifolds]
        operator.launch_kernel(point_kernels.choose_point_kernel, room * block, inputs, point_kernels.TWIST_COUNT)

    def _add_inside_points(self):
        """Add points of what is inside, where there are solids. Launches only."""
        operator, solids = self.operator, self.operator.batch.solids
        if solids is not None:
            inputs = [operator.traversal.stack_length(), operator.batch.trees, solids.pool, operator.pair_batch]
            inputs += [operator.hits, self.manifolds]
            operator.launch_warps(inside_points.add_inside_point_kernel, operator.rooms.pairs, inputs)

    def _sort_keys(self, count, bits):
        """Sort contacts by their keys, of so many bits: those of pairs follow one another already. Launches only."""
        operator, curves = self.operator, self.curves
        if operator.uses_warps():
            radix_sort(curves.key, curves.order, count, bits)
        else:
            operator.launch_kernel(loops.sort_loop_kernel, operator.rooms.pairs, [self._contacts.contacts, curves])

    def read(self, found: Found, device: bool, with_rows: bool):
        """Read the points."""
        if not with_rows:
            return
        pairs = len(found.pairs)
        arrays = {name: first_rows(getattr(self.manifolds, name), pairs) for name in ("count", *self._fields)}
        if device:
            found.points = {name: wp.clone(array) for name, array in arrays.items()}
            return
        points = arrays.pop("count").numpy()
        used = np.arange(self.point_max) < points[:, None]
        found.points = {"pair": np.repeat(np.arange(pairs), points)}
        for name, array in arrays.items():
            found.points[name] = array.numpy()[used]


class ManifoldQuery(Operator):
    """Contact points of many object pairs as an operator, see this module's docstring.

    Pairs of the broad phase are sorted by their objects, so that nothing depends on the order in which it found them.

    Args:
        scene, pairs, precision, gap: As for `ContactQuery`.
        capacity: `Buffers`, or the hits that there is room for: contacts of faces that cross, and witnesses. Where
            `run` would need long lists, parts of the pairs take turns in shorter ones (`query.point_parts`).
        points: Most points of a pair, 1 to 64. A pair has fewer where these hold against all twists.
        remember: How far [world units] the points of a pair's smaller object may move, as the other one sees it, until
            the pair is searched again: while it rests it keeps the points of its last search, moved with the objects,
            so that, where objects overlap but little, a point is missing only if it came nearer, or into view, by
            that. True: an eighth of the gap, at
            most 2^-11 of the smaller object's size, half of its box's diagonal. It needs a gap. Results then depend on
            the launches before, in the same way on every device, until `forget`. None: every launch searches every
            pair.
        originals: Whether points found at LODs are moved to the original surfaces: to the middle of those points of
            either that are nearest, with their depth along the normal of the LODs. Whether a pair intersects, and what
            is inside solids, stays that of the LODs.

    Attributes:
        manifolds: Points of each pair, device arrays (pair capacity, points) of `kernels.contacts.manifold.Manifolds`.
            With `remember` also `before`, the place that each point had among its pair's in the launch before, -1 for a
            new one: what warm starting needs. Results have it as `points["before"]`.
        contacts: Contacts of faces that cross, as of `ContactQuery`, without separations; faces and start as there.
            Where parts of the pairs took turns, these and what follows are those of the last part, by places in it.
        curves: Loops of these contacts, device arrays (capacity,) of `kernels.contacts.manifold.Curves`.
        witness_rows: Face pairs that the slots of each pair keep, those of pair p at start[p] to start[p] + count[p],
            of `kernels.contacts.slots.WitnessRows`; an item that begins with -1 is none.
        witnesses: Normals and candidate points of these, `kernels.contacts.manifold.Witnesses`, in the same places.
        near_contacts: Contacts of those that are apart, with separations, in the same places; other places hold
            nothing. Empty without a gap.
        point_max: Most points of a pair.
        memory: `query.stages.memory.MemoryStage`, whose `place` is -1 for a pair that was searched in the last launch;
            None unless pairs are remembered. Of one that rests `hits.count` is 0.
    """

    growth = 2
    faces: wp.array
    start: wp.array

    def __init__(
        self,
        scene,
        pairs=None,
        capacity=None,
        precision="exact",
        gap=None,
        points=POINTS_MAX,
        remember=None,
        originals=False,
    ):
        self.point_max = whole_number(points, "points", 1, 64)
        distance = check_remember(remember, gap)
        self.memory = None if distance is None else MemoryStage(distance, self.point_max)
        self._precision, self._originals = precision, OriginalStage() if flag(originals, "originals") else None
        stages = self._plan(gap, self.memory, self.memory, self._originals)
        self._name_arrays(stages)
        self.manifolds = stages[-1].manifolds
        warn_of_winding(scene)
        super().__init__(scene, stages, pairs, capacity, "faces", sort_pairs=True)
        kinds = GapStage, MemoryStage
        self._before_parts = [stage for stage in stages if isinstance(stage, kinds)]

    def _plan(self, gap, resting, memory, surfaces) -> list[Any]:
        """Return the stages of the query or, with another gap and without memory, of its parts."""
        stages: list[Any] = plan_contacts(self._precision, None, gap, sums=False, memory=resting)
        slots = next(stage for stage in stages if isinstance(stage, SlotStage))
        found = PointStage(slots, stages[-1], gap is not None, self.point_max, memory, surfaces)
        return [*stages, found] if surfaces is None else [*stages, surfaces, found]

    def _name_arrays(self, stages):
        """Take what users read from the stages that contacts are found by."""
        kinds: Any = {type(stage): stage for stage in stages}
        slots, contacts, found = kinds[SlotStage], kinds[ContactStage], kinds[PointStage]
        self.contacts, self.curves, self.witness_rows = contacts.contacts, found.curves, slots.rows
        self.witnesses, self.near_contacts = found.witnesses, found.near

    @property
    def list_rooms(self) -> Rooms:
        """Return the room of the lists that hits are found in, those of one part of the pairs at a time."""
        return self.rooms if self.parts is None else Rooms(self.rooms.pairs, *self.parts.operator.rooms[1:])

    def make_list_room(self, hits=None, uncertain=None):
        """Make room for longer lists; long ones serve parts of the pairs in turn. Waits for the device."""
        needed = None if hits is None else hits + hits // 8, None if uncertain is None else more_room(uncertain)
        pairs = int(self.pair_count.numpy()[0])
        if self.parts is not None:
            self.guard.buffers.advance()
            self.parts.make_room(pairs, *needed)
        elif needs_parts(pairs, needed[0] or 0, needed[1] or 0):
            gap = None if self.hits.gap is None else PartGaps()
            surfaces = None if self._originals is None else OriginalStage(self._originals.finest)
            stages = self._plan(gap, None if self.memory is None else gap, None, surfaces)
            self.parts = PointParts(
                self, stages, pairs, needed[0] or self.rooms.hits, needed[1] or self.rooms.uncertain
            )
            self.make_room(hits=1, uncertain=min(1, self.rooms.uncertain))  # its own are not used any more
        else:
            super().make_list_room(hits, uncertain)
            return
        self._link_parts()

    def _link_parts(self):
        """Take note of new arrays of the parts."""
        self.guard.buffers.advance()
        with self.changing():
            self.parts.lend_lists(self.hits)
            self._name_arrays(self.parts.operator.stages)
            self.faces, self.start = self.parts.operator.faces, self.parts.operator.start

    def _make(self, rooms: Rooms) -> list:
        if self.parts is not None:
            self.parts.fit_pairs(rooms.pairs)
        return super()._make(rooms)

    def _replace(self, made, rooms: Rooms):
        super()._replace(made, rooms)
        if self.parts is not None:
            self._link_parts()

    def search(self):
        """Search the pairs in place; of parts, each is reduced to points before the next. Launches only."""
        if self.parts is None or not self.rooms.pairs:
            super().search()
            return
        if self.parts.fit_states():
            self._link_parts()
        for stage in self._before_parts:
            stage.search()
        self.parts.launch(self, None if self.memory is None else self.memory.asked)
        if self.memory is not None:
            self.memory.resume()

    def report(self, count: int | None = None):
        """Reduce what was found to points. Launches only."""
        if self.parts is None:
            super().report(count)
        elif self.memory is not None and self.rooms.pairs:
            self.memory.keep(self.manifolds)

    def set_pairs(self, pairs, within=None, gap=None):
        """Query other pairs from now on, as `ContactQuery.set_pairs`; there is no within."""
        self.ask_pairs(pairs, within=within, gap=gap)

    def forget(self):
        """Search every pair in the next launch, as if it were the first; nothing without `remember`. Launches only."""
        if self.memory is not None:
            self.memory.forget()

    def result(self, device: bool = False, with_points: bool = True) -> Result:
        """Return the counts and, unless told otherwise, the contact points of the last launch, as `Query.result`."""
        return self.readout.read(device, with_points)
