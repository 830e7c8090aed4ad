"""Contacts: where intersecting faces meet, with which normals, and one summary an object pair; `ContactQuery`.

Everything is computed from the inputs of the exact test, in the frame of the object with the lower index, and then
posed to the world by that object's pose. A face pair's contact, in the order in which the pair names its objects:

* pair, faces: place of the object pair in `Result.pairs`, and the face of its first and of its second object, (2,):
  the columns of `Result.faces`.
* p0, p1: the ends of the segment that the two faces share, along normal_a x normal_b; where the faces are coplanar, the
  two points of the polygon that they share that are farthest apart; where they touch in a point, that point twice.
* normal_a, normal_b: unit normals of the faces by their winding, zero for faces of no area.
* normal: unit, from the first object to the second: the direction of normal_a - normal_b. Where that is shorter than
  2^-20, the faces look the same way, and it is the normal of the lower object's face, turned towards the higher; where
  neither face has an area, the direction from one model's centre to the other's, or the x axis.
* coplanar: whether the faces have area and lie in one plane, exactly.

With `gap=d` face pairs that do not intersect, but are nearer than d, have contacts too, in the same order as the rest,
and every contact has a separation: the widest gap that any direction leaves between the two closed triangles, the
greatest of min n.b - max n.a over unit vectors n, a of the one and b of the other [world units].

* Faces that do not intersect: their distance, above 0, computed as `query.stages.distance` does. p0 and p1 are the
  nearest points, p0 on the first object's face: of a corner over a face the corner and its foot, of two edges where
  their common normal meets them, of parallel faces, edges or a shared plane one pair of equally near points. normal is
  the direction from p0 to p1: the face's normal under a corner, across both edges, else along neither. Where they are
  nearer than 2^-30 of the faces' size it is told by normal_a and normal_b, as for faces that cross. coplanar is False.
* Faces that cross: minus the length of the shortest motion of one of them after which they only touch, along a normal
  of either face or across an edge of each; all else is as without a gap, to the bit. It is off by 2^-26 of the faces'
  size at most, and by rounding alone unless edges are nearly parallel.
* Faces that touch, or overlap in one plane: nothing parts them, and nothing has to. They intersect: their separation is
  -2^-126, the least in magnitude, which stands for 0, so that the sign says whether two faces intersect, exactly.

Which faces are nearer than d is decided by the computed distance, in the frame of the lower object, alone: the proofs
by which boxes and planes are passed over have room for its error. Summaries are those of the faces that intersect,
wherever sums below say contacts; `Result.count` counts all contacts, `Result.any` says whether a pair intersects.

An end is a corner, or lies on an edge, off its exact place by at most 2^-40 of the edge's length and the rounding of
coordinates in both frames. Where the lower object's rotation is a matrix R that is off orthonormal by s, the largest
entry of |R^T R - I|, ends lie on the higher object's posed mesh only to within 3 s of their distance from the lower
object's position. Pairs that a coarser precision reports although they are apart get a point between them.

An object pair's summary is made of sums over its contacts in the order of `Result.faces`, in float64. Each sum adds the
contacts of each chunk of 32, the last chunk perhaps shorter, from left to right, then the chunks from left to right:

* count: contacts, as `Result.count`, with a gap those of faces that are apart too.
* point: mean of the segments' midpoints, weighted by length; unweighted where all lengths vanish. It need not lie on
  either surface.
* normal: mean of the normals, weighted as the points, at unit length. A mean shorter than 2^-20, as of curves that run
  around an object, gives way to the direction between the models' centres.

A pair without contacts has NaN as point and normal, of the bits 0x7ff8000000000000. The results are the
same, bit for bit, on CPU and CUDA. For a pair named the other way the contacts differ in nothing but order, exchanged
ends and signs; sums follow the order of the faces as named, so that its summary may differ in the last bits too.
"""

from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.regime import current_regime
from warp_abtree.kernels.base.lanes import WARP_SIZE
from warp_abtree.kernels.base.sums import six_numbers
from warp_abtree.kernels.contacts import contact, separation, summary
from warp_abtree.kernels.io import contact_results as pack
from warp_abtree.kernels.io import sort_hits
from warp_abtree.query.operator import Operator
from warp_abtree.query.request import CapacityError, check_request
from warp_abtree.query.result import VECTORS, Found, contact_dtypes
from warp_abtree.query.sorting import HitSort, first_sort
from warp_abtree.query.stage import Array, Rooms, Stage, fields
from warp_abtree.query.stages.inside import InsideStage
from warp_abtree.query.stages.intersect import ApartStage, GapStage, IntersectStage
from warp_abtree.query.stages.slots import SlotStage
from warp_abtree.query.staging import first_rows
from warp_abtree.state.batch import Batch, scene_or_batch

# Warps that a multiprocessor runs at a time, by their registers, of those that find deferred contacts, and of those
# that find contacts of faces that are apart.
DEFERRED_WARPS, LISTED_WARPS = 8, 16


class ContactStage(Stage):
    """Sort the hits, and find the contact of each and the summary of each pair.

    Args:
        precision: As for `ContactQuery`.
        with_gap: Whether faces that are apart have contacts, too.
        sums: Whether summaries are made, and results have both; else what follows reduces the contacts.

    Attributes:
        contacts, pair_contacts: As of `ContactQuery`.
        deferred: Contacts that float32 does not tell, `contact.Deferred`; a list that is scratch from then on.
        order, key: Scratch of the sort, which holds twice as many entries.
        dtype: Type of the real numbers of results.
    """

    key: wp.array
    order: wp.array
    sort: HitSort

    def __init__(self, precision="exact", with_gap=False, sums=True, dtype: Any = np.float64):
        self._proven, self._with_gap, self._sums_contacts, self.dtype = precision == "exact", with_gap, sums, dtype
        self.contacts, self.pair_contacts, self._sums = contact.Contacts(), summary.PairContacts(), summary.ChunkSums()
        self.deferred, self._near = contact.Deferred(), contact.Deferred()

    def attach(self, operator: Operator):
        """Take the operator."""
        super().attach(operator)
        # As many of one and of the other as there are contacts at most: one array has room for both.
        self._listed_totals = wp.zeros(2, dtype=wp.int32, device=operator.device)
        self.deferred.total, self._near.total = self._listed_totals[:1], self._listed_totals[1:]
        self.sort = HitSort(self.operator)

    def kernels(self, device) -> list:
        """Return what finds contacts, and what sorts."""
        if not current_regime().uses_warps(device):
            finding = contact.find_pair_contacts_kernel, contact.find_deferred_kernel
            sums = [(summary.sum_pair_kernel, 256)] if self._sums_contacts else []
            return [*((kernel, WARP_SIZE) for kernel in finding), *sums, (sort_hits.sort_by_pair_kernel, 256)]
        finding = contact.find_contact_kernel, summary.sum_mean_kernel
        return [*((kernel, WARP_SIZE) for kernel in finding), *first_sort(device)]

    def arrays(self, rooms: Rooms) -> list[Array]:
        """Return what has an entry a contact, a pair or a chunk of contacts; raise CapacityError for 2^30 contacts."""
        hits, pairs = rooms.hits, rooms.pairs
        if hits >= 2**30:
            raise CapacityError(f"{hits} face pairs asked, a contact query has room for fewer than 2^30")
        return [
            *fields(self.contacts, hits, face=wp.vec3i, **dict.fromkeys(VECTORS, wp.vec3d), coplanar=wp.int32),
            Array(self.deferred, "place", wp.int32, hits),
            # The sort takes as much again as scratch.
            Array(self, "key", wp.int64, 2 * hits),
            Array(self, "order", wp.int32, 2 * hits),
            Array(self.contacts, "start", wp.int32, pairs + 1, 0),
            *fields(self.pair_contacts, pairs, point=wp.vec3d, normal=wp.vec3d),
            *([Array(self.contacts, "separation", wp.float64, hits)] if self._with_gap else []),
            *fields(self._sums, self._chunk_count(hits, pairs), span=wp.vec3i, lengths=six_numbers, means=six_numbers),
        ]

    def link(self):
        """Let both lists of contacts share their array, and give the operator what users read."""
        self._near.place = self.deferred.place
        self.operator.faces, self.operator.start = self.contacts.face, self.contacts.start

    @staticmethod
    def _chunk_count(places: int, pairs: int) -> int:
        """Return how many chunks there may be: `first_chunk` of the pair after the last, if all places are taken."""
        return places // int(summary.CHUNK) + pairs

    def places(self, count: int | None) -> int:
        """Return how many places to look at of so many hits; None: all there are."""
        room = self.operator.rooms.hits
        return room if count is None else min(count, room)

    def report(self, count: int | None):
        """Sort the hits in place, whatever their order, and make their contacts. Launches only."""
        count = self.places(count)
        self._sort(count)
        self._find(count)
        if self._sums_contacts:
            self._reduce(count)

    def _sort(self, count: int):
        operator, hits, found = self.operator, self.operator.hits, self.contacts
        if not operator.uses_warps():
            inputs = [count, hits.total, hits.face, self.key, found.face, found.start, self._listed_totals]
            operator.launch_kernel(sort_hits.sort_by_pair_kernel, 1, inputs, given=(count,))
            return
        ends = found.start, self._listed_totals, self._sums.span
        if count == 0:
            found.start.zero_()
            self._listed_totals.zero_()
        if not self.sort.launch(count, self.order, self.key, found.face, ends=ends):
            inputs = [found.start, self._sums.span]
            operator.launch_kernel(summary.locate_chunk_kernel, self._chunk_count(count, operator.rooms.pairs), inputs)

    def _find(self, count: int):
        operator, launch, contacts = self.operator, self.operator.launch_kernel, self.contacts
        posed, warps = [operator.batch.trees, operator.pair_batch], operator.uses_warps()
        inputs = [*posed, self._proven, self.deferred, contacts]
        if self._with_gap:
            launch(separation.mark_near_kernel, -(-count // WARP_SIZE) * WARP_SIZE, [self._near, contacts])
        if warps:
            launch(contact.find_contact_kernel, count, inputs, WARP_SIZE)
        else:
            launch(contact.find_pair_contacts_kernel, operator.rooms.pairs, inputs)
        processors = operator.device.sm_count * WARP_SIZE if operator.device.is_cuda else 0
        if self._with_gap:
            if warps:
                launch(separation.find_separation_kernel, count, [*posed, contacts], WARP_SIZE)
            step = LISTED_WARPS * processors or 1
            inputs = [step, *posed, self._near, not warps, contacts]
            launch(separation.find_near_contact_kernel, step, inputs, WARP_SIZE)
        step = DEFERRED_WARPS * processors or 1
        launch(contact.find_deferred_kernel, step, [step, *posed, self.deferred, contacts], WARP_SIZE)

    def _reduce(self, count: int):
        operator, room, means = self.operator, self.operator.rooms.pairs, self.pair_contacts
        count, sums = self._chunk_count(count, room), self._sums
        given = [operator.batch.trees, operator.pair_batch, self.contacts]
        if not operator.uses_warps():
            operator.launch_kernel(summary.sum_pair_kernel, room, [*given, means])
            return
        operator.launch_warps(summary.sum_length_kernel, count, [self.contacts, sums])
        operator.launch_warps(summary.sum_mean_kernel, count, [self.contacts, sums])
        operator.launch_warps(summary.average_contacts_kernel, room, [*given, sums, means])

    def read(self, found: Found, device: bool, with_rows: bool):
        """Read contacts and summaries."""
        if not self._sums_contacts or not with_rows:
            return
        count = min(found.totals.hits, self.operator.rooms.hits)
        if device:
            self._copy_contacts(found, count)
        elif self.operator.readout.packs:
            self._transfer_contacts(found, count)
        else:
            self._share_contacts(found, count)

    def _share_contacts(self, found: Found, count: int):
        """Copy from arrays that are the host's memory."""
        pairs = len(found.pairs)
        face_type, pair_type = contact_dtypes(self.dtype, self._with_gap)
        found.contacts, found.pair_contacts = np.zeros(count, face_type), np.zeros(pairs, pair_type)
        found.faces = self.contacts.face.numpy()[:count].reshape(-1, 3).copy()
        found.pair_contacts["count"] = found.count
        with np.errstate(over="ignore"):
            for name in ("point", "normal"):
                found.pair_contacts[name] = getattr(self.pair_contacts, name).numpy()[:pairs]
            for name in face_type.names[2:]:
                found.contacts[name] = getattr(self.contacts, name).numpy()[:count]
        found.contacts["pair"], found.contacts["faces"] = found.faces[:, 0], found.faces[:, 1:]

    def _transfer_contacts(self, found: Found, count: int):
        """Pack rows on the device, and bring them over."""
        staging, pairs = self.operator.readout.staging, len(found.pairs)
        real, with_gap = self._real(), self._with_gap
        face_type, pair_type = contact_dtypes(self.dtype, with_gap)
        memory = staging.row_pool.take(12 * count + pairs * pair_type.itemsize + count * face_type.itemsize)

        def pack_pairs(first, some, target):
            inputs = [first, self.operator.hits.count, self.pair_contacts, target]
            self._launch(pack.pair_packer(real), (some, pack.PAIR_NUMBERS), inputs)

        def pack_contacts(first, some, target):
            inputs = [first, self.contacts, target]
            self._launch(pack.contact_packer(real, with_gap), (some, pack.CONTACT_NUMBERS + with_gap), inputs)

        found.faces, memory = staging.send_rows(memory, self.contacts.face, count)
        found.pair_contacts, memory = staging.send_records(memory, pair_type, pairs, pack_pairs)
        found.contacts, _ = staging.send_records(memory, face_type, count, pack_contacts)
        staging.wait()

    def _copy_contacts(self, found: Found, count: int):
        """Copy rows into arrays that stay on the device."""
        real, pairs = self._real(), len(found.pairs)
        vector = wp.vec3d if real is wp.float64 else wp.vec3
        types = {"pair": wp.int32, "faces": wp.vec2i, **dict.fromkeys(VECTORS, vector), "coplanar": wp.bool}
        found.contacts = {name: self._empty(count, dtype) for name, dtype in types.items()}
        means = {"point": self._empty(pairs, vector), "normal": self._empty(pairs, vector)}
        self._launch(pack.contact_copier(real), count, [self.contacts, *found.contacts.values()])
        if self._with_gap:
            separation = found.contacts["separation"] = self._empty(count, real)
            self._launch(pack.number_copier(real), count, [self.contacts.separation, separation])
        self._launch(pack.summary_copier(real), pairs, [self.pair_contacts, *means.values()])
        found.pair_contacts = {"count": found.count, **means}
        found.faces = wp.clone(first_rows(self.contacts.face, count))

    def _empty(self, count, dtype):
        return wp.empty(count, dtype=dtype, device=self.operator.device)

    def _launch(self, kernel, dim, inputs):
        wp.launch(kernel, dim=dim, inputs=inputs, device=self.operator.device)

    def _real(self):
        return wp.float64 if np.dtype(self.dtype) == np.float64 else wp.float32


def plan_contacts(precision, within, gap, sums: bool, dtype: Any = np.float64, memory=None) -> list[Stage]:
    """Return the stages that find contacts and their summaries, or those that are reduced to points.

    memory is the stage that finds the pairs that rest, the gap itself if it knows, or None. Raises ValueError for an
    unknown precision.
    """
    check_request("faces", precision)
    slots = None if sums else SlotStage(gap is not None)
    intersect = IntersectStage("faces", precision, gap is not None, reads=False, slots=slots, resting=memory)
    apart: list[Stage] = [] if within is None else [ApartStage(within)]
    if gap is not None:
        gaps = gap if isinstance(gap, GapStage) else GapStage(gap)
        gaps.give_to(intersect.hits, precision)
        apart.append(gaps)
    if memory is not None and memory is not gap:
        apart.append(memory)
    reduced: list[Stage] = [] if slots is None else [slots]
    return [*apart, intersect, *reduced, InsideStage(), ContactStage(precision, gap is not None and sums, sums, dtype)]


def warn_of_winding(scene):
    """Warn of models of a scene whose winding is not what normals of contacts take it for."""
    for model in () if isinstance(scene_or_batch(scene), Batch) else scene.models:
        model.warn_of_winding("the normals of its contacts depend on the winding")


class ContactQuery(Operator):
    """Contacts of many object pairs as an operator: `Query` of output "faces", and what this module's docstring says.

    `launch()` only launches, sorting included, so that a CUDA graph can take poses to contacts without the host.

    Args:
        scene, pairs, precision, within: As for `Query`.
        capacity: `Buffers`, or the contacts that there is room for, below 2^30. Room that stays empty takes 180 bytes a
            contact and, in `launch`, time to sort all the same; `run` looks at what was found.
        contact_dtype: Type of the real numbers in `result()`, float64 or float32; those beyond float32 become infinite.
        sort_pairs: As for `Query`.
        gap: Distance [world units]: faces nearer than that have contacts too. One for all pairs, (p,) beside given
            pairs; where the broad phase makes the pairs also (n,), one for each object, which add up for a pair. Or a
            Warp array of vec4d (n,) on the query's device, which each launch reads: x, y, z the motion that an object
            is about to make, w its own part; a pair's gap is both parts and the length of the relative motion. It needs
            precision "exact", and takes 12 bytes more a contact. None for none.

    Attributes:
        faces: The last launch's `Result.faces`, device vec3i (capacity,), sorted.
        contacts: Their contacts, device arrays (capacity,) of `kernels.contacts.contact.Contacts`, float64.
        pair_contacts: Their summaries, device arrays (pair capacity,) of `kernels.contacts.summary.PairContacts`.
        start: Where the rows of pair p start in faces and contacts, device int32 (pair capacity + 1,): they end at
            start[p + 1], and all of them at the last entry. Places behind that hold nothing.
        hits, pairs, pair_count, near: As for `Query`. Where hits.count sums to more than the capacity, contacts are
            missing in all of the above, on a GPU not the same in each launch.
    """

    faces: wp.array
    start: wp.array
    _contacts: Any

    def __init__(
        self,
        scene,
        pairs=None,
        capacity=None,
        precision="exact",
        within=None,
        contact_dtype=np.float64,
        sort_pairs=False,
        gap=None,
    ):
        stages = self.plan(precision, within, contact_dtype, gap)
        *_, self._contacts = stages
        warn_of_winding(scene)
        super().__init__(scene, stages, pairs, capacity, "faces", sort_pairs)
        self.contacts, self.pair_contacts = self._contacts.contacts, self._contacts.pair_contacts

    @staticmethod
    def plan(precision="exact", within=None, contact_dtype=np.float64, gap=None) -> list[Stage]:
        """Return the stages of a query; raise ValueError for a precision or type that there is none of."""
        contact_dtypes(contact_dtype)
        return plan_contacts(precision, within, gap, True, contact_dtype)

    @property
    def contact_dtype(self):
        """Return the type of the real numbers of results, which may be set."""
        return self._contacts.dtype

    @contact_dtype.setter
    def contact_dtype(self, dtype):
        self._contacts.dtype = dtype

    def set_pairs(self, pairs, within=None, gap=None):
        """Query other pairs from now on, as `Query.set_pairs` does; within and gap None keep the distances."""
        self.ask_pairs(pairs, within=within, gap=gap)
