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

* Faces that do not intersect: their distance, above 0, computed as `warp_abtree.query.distance` does. p0 and p1 are the
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
* travel: an estimate of how far the second object would have to move along the normal to come free. The contact curve
  encloses an area, seen along the normal; its faces say how fast that area shrinks with such a motion; travel is their
  quotient, at most the overlap of the two root boxes along the normal, which it is too where the area does not shrink.
  Without an area (points, shared planes) it is the overlap along the normal of the faces that touch. For a box pressed
  straight into a larger one it is exact up to the rounding of the root boxes, float32 and outwards: 3e-7 for boxes of 4
  units, so that boxes that only touch have that travel. At most (2 r + d) / 2 d times the truth for balls of radius r
  at distance d, less where the root boxes cap it; half of it for the tip of a cone. It is no depth, and no bound
  on one: where a curve runs over the edge of an object the mean normal leans over, and travel can be several times too
  large; for separate regions of contact, such as a peg in its hole, and for open surfaces it is merely a length. Depths
  of solids are measured by `signed` distances (`warp_abtree.query.distance`).

A pair without contacts has travel 0 and NaN as point and normal, of the bits 0x7ff8000000000000. The results are the
same, bit for bit, on CPU and CUDA. For a pair named the other way the contacts differ in nothing but order, exchanged
ends and signs; sums follow the order of the faces as named, so that its summary may differ in the last bits too.
"""

import numpy as np
import warp as wp

from warp_abtree.checks.regime import current_regime
from warp_abtree.kernels.base.lanes import WARP_SIZE
from warp_abtree.kernels.contacts import chunks, contact, separation, simd, summary
from warp_abtree.kernels.io import contact_results as pack
from warp_abtree.kernels.io import sort_hits
from warp_abtree.query.narrow_phase import Query
from warp_abtree.query.request import CapacityError
from warp_abtree.query.result import VECTORS, Found, contact_dtypes
from warp_abtree.query.sorting import first_sort
from warp_abtree.query.staging import first_rows
from warp_abtree.state.batch import Batch

# Warps that a multiprocessor runs at a time, by their registers, of those that find deferred contacts, and of those
# that find contacts of faces that are apart.
DEFERRED_WARPS, LISTED_WARPS = 8, 16


class ContactQuery(Query):
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
    _key: wp.array
    _order: wp.array
    _places = 0

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
        contact_dtypes(contact_dtype)
        self.contact_dtype, self._asked_gap = contact_dtype, gap
        self.contacts, self.pair_contacts = contact.Contacts(), summary.PairContacts()
        self._sums, self._deferred, self._near = summary.ChunkSums(), contact.Deferred(), contact.Deferred()
        for model in () if isinstance(scene, Batch) else scene.models:
            model.warn_of_winding("the normals of its contacts depend on the winding", stacklevel=5)
        # As many of one and of the other as there are contacts at most: one array has room for both.
        self._listed_totals = wp.zeros(2, dtype=wp.int32, device=scene.device)
        self._deferred.total, self._near.total = self._listed_totals[:1], self._listed_totals[1:]
        super().__init__(scene, "faces", pairs, capacity, precision, within, sort_pairs)

    def set_pairs(self, pairs, within=None, gap=None):
        """Query other pairs from now on, in the room there is if they fit; within and gap None keep the distances.

        Raises:
            ValueError: Bad pairs or distances, a query that runs the broad phase, or distances for one made without.
        """
        self._set_pairs(pairs, within, gap)

    @classmethod
    def kernels(cls, device, output, precision, with_gap: bool, with_distances: bool) -> list:
        searching = super().kernels(device, "contacts", precision, with_gap, with_distances)
        if not current_regime().uses_warps(device):
            kernels = [(simd.find_pair_contacts_kernel, WARP_SIZE), (contact.find_deferred_kernel, WARP_SIZE)]
            return [*kernels, *searching, (sort_hits.sort_by_pair_kernel, 256)]
        kernels = [(contact.find_contact_kernel, WARP_SIZE), (summary.sum_loop_kernel, WARP_SIZE)]
        return [*kernels, *searching, *first_sort(device)]

    def resize(self, capacity: int):
        """Make room for a number of contacts.

        Raises:
            CapacityError: 2^30 contacts or more.
        """
        if capacity >= 2**30:
            raise CapacityError(f"{capacity} face pairs asked, a contact query has room for fewer than 2^30")
        self._replace([*self._place_arrays(capacity), (self, "_places", capacity)])

    def _place_arrays(self, capacity: int) -> list:
        """Return (owner, attribute, new array) of whatever has an entry a contact."""
        made = [(self.hits, "face", self._empty(capacity, wp.vec3i)), (self, "faces", self._empty(capacity, wp.vec3i))]
        made += [(self.contacts, name, self._empty(capacity, wp.vec3d)) for name in VECTORS]
        made.append((self.contacts, "coplanar", self._empty(capacity, wp.int32)))
        if self._gap is not None:
            made.append((self.contacts, "separation", self._empty(capacity, wp.float64)))
        places = self._empty(capacity, wp.int32)
        made += [(self._deferred, "place", places), (self._near, "place", places)]
        # The sort takes as much again as scratch.
        made.append((self, "_key", self._empty(2 * capacity, wp.int64)))
        made.append((self, "_order", self._empty(2 * capacity, wp.int32)))
        return made + self._chunk_arrays(self._chunk_count(capacity, len(self.pairs)))

    def _pair_arrays(self, room: int) -> list:
        made = super()._pair_arrays(room)
        made.append((self, "start", wp.zeros(room + 1, dtype=wp.int32, device=self.device)))
        for owner, name, dtype in (
            (self.pair_contacts, "point", wp.vec3d),
            (self.pair_contacts, "normal", wp.vec3d),
            (self.pair_contacts, "travel", wp.float64),
            (self._sums, "middle", wp.vec3d),
        ):
            made.append((owner, name, self._empty(room, dtype)))
        return made + self._chunk_arrays(self._chunk_count(self._places, room))

    def _chunk_arrays(self, count: int) -> list:
        """Return (owner, attribute, new array) of whatever has an entry a chunk."""
        made = [(self._sums, "span", self._empty(count, wp.vec3i))]
        made += [(self._sums, name, self._empty(count, wp.vec3d)) for name in ("point", "normal")]
        names = ("length", "crossed", "area", "change", "front", "back")
        return made + [(self._sums, name, self._empty(count, wp.float64)) for name in names]

    def _empty(self, count, dtype):
        return wp.empty(count, dtype=dtype, device=self.device)

    @staticmethod
    def _chunk_count(places: int, pairs: int) -> int:
        """Return how many chunks there may be: `first_chunk` of the pair after the last, if all places are taken."""
        return places // int(chunks.CHUNK) + pairs

    def finish(self, count: int | None = None):
        """Make the contacts of the hits in place. Launches only."""
        if len(self.pairs):
            self.find_contacts(count)

    def find_contacts(self, count: int | None = None):
        """Sort the hits in place, whatever their order, make their contacts and sum them. Launches only.

        Args:
            count: How many hits there are; None looks at all places.
        """
        count = self._places if count is None else min(count, self._places)
        self._sort(count)
        self._find(count)
        self._reduce(count)

    def _launch_kernel(self, kernel, dim, inputs, block_dim=256):
        """Launch a kernel of which only dim differs while the query's arrays stand."""
        self._repeat((), kernel, dim, inputs, block_dim)

    def _launch_once(self, kernel, dim, inputs):
        wp.launch(kernel, dim=dim, inputs=inputs, device=self.device)

    def _expected_hits(self, n: int) -> int:
        """Return none: rows come of launches that follow."""
        return 0

    def _launch_warps(self, kernel, count, inputs):
        """Launch a kernel with a warp for each of so many items, on the CPU a thread."""
        lanes = WARP_SIZE if self.device.is_cuda else 1
        self._launch_kernel(kernel, count * lanes, inputs, WARP_SIZE)

    def _sort(self, count: int):
        room, hits = len(self.pairs), self.hits
        if not self.uses_warps():
            inputs = [count, hits.total, hits.face, self._key, self.faces, *self._sorted_ends()[:2]]
            self._repeat((count,), sort_hits.sort_by_pair_kernel, 1, inputs)
            return
        if count == 0:
            self.start.zero_()
            self._listed_totals.zero_()
        if count == 0 or not self._sort_into(count, self._order, self._key, self.faces):
            inputs = [self.start, self._sums.span]
            self._launch_kernel(chunks.locate_chunk_kernel, self._chunk_count(count, room), inputs)

    def _sorted_ends(self) -> tuple:
        return self.start, self._listed_totals, self._sums.span

    def _find(self, count: int):
        posed = [self.batch.trees, self.pair_batch]
        proven = self.precision == "exact"
        inputs = [*posed, proven, self.start, self.faces, self._deferred, self.contacts]
        if self._gap is not None:
            marked = [self.start, self.faces, self._near, self.contacts]
            self._launch_kernel(separation.mark_near_kernel, -(-count // WARP_SIZE) * WARP_SIZE, marked)
        if self.uses_warps():
            self._launch_kernel(contact.find_contact_kernel, count, inputs, WARP_SIZE)
        else:
            self._launch_kernel(simd.find_pair_contacts_kernel, len(self.pairs), inputs)
        step = LISTED_WARPS * self.device.sm_count * WARP_SIZE if self.device.is_cuda else 1
        if self._gap is not None:
            if self.uses_warps():
                inputs = [*posed, self.start, self.faces, self.contacts]
                self._launch_kernel(separation.find_separation_kernel, count, inputs, WARP_SIZE)
            inputs = [step, *posed, self.faces, self._near, not self.uses_warps(), self.contacts]
            self._launch_kernel(separation.find_near_contact_kernel, step, inputs, WARP_SIZE)
        step = DEFERRED_WARPS * self.device.sm_count * WARP_SIZE if self.device.is_cuda else 1
        inputs = [step, *posed, self.faces, self._deferred, self.contacts]
        self._launch_kernel(contact.find_deferred_kernel, step, inputs, WARP_SIZE)

    def _reduce(self, count: int):
        room = len(self.pairs)
        count = self._chunk_count(count, room)
        start, contacts, sums, means = self.start, self.contacts, self._sums, self.pair_contacts
        posed = [self.batch.trees, self.pair_batch]
        if not self.uses_warps():
            self._launch_kernel(simd.sum_pair_kernel, room, [*posed, start, self.faces, contacts, means])
            return
        self._launch_warps(summary.sum_length_kernel, count, [start, contacts, sums])
        self._launch_warps(summary.sum_mean_kernel, count, [start, contacts, sums])
        self._launch_warps(summary.sum_loop_kernel, count, [*posed, start, self.faces, contacts, sums, means])
        self._launch_warps(summary.measure_travel_kernel, room, [*posed, start, self.faces, contacts, sums, means])

    def _read_rows(self, found: Found, count: int, device: bool):
        if device:
            self._copy_contacts(found, count)
        elif self._packs():
            self._transfer_contacts(found, count)
        else:
            self._share_contacts(found, count)

    def _share_contacts(self, found: Found, count: int):
        """Copy from arrays that are the host's memory."""
        pairs = len(found.pairs)
        face_type, pair_type = self._dtypes()
        found.contacts, found.pair_contacts = np.zeros(count, face_type), np.zeros(pairs, pair_type)
        found.faces = self.faces.numpy()[:count].reshape(-1, 3).copy()
        found.pair_contacts["count"] = found.count
        with np.errstate(over="ignore"):
            for name in ("point", "normal", "travel"):
                found.pair_contacts[name] = getattr(self.pair_contacts, name).numpy()[:pairs]
            for name in face_type.names[2:]:
                found.contacts[name] = getattr(self.contacts, name).numpy()[:count]
        found.contacts["pair"], found.contacts["faces"] = found.faces[:, 0], found.faces[:, 1:]

    def _transfer_contacts(self, found: Found, count: int):
        """Pack rows on the device, and bring them over."""
        staging, pairs = self._staging, len(found.pairs)
        real, (face_type, pair_type), with_gap = self._real(), self._dtypes(), self._gap is not None
        memory = staging.row_pool.take(12 * count + pairs * pair_type.itemsize + count * face_type.itemsize)

        def pack_pairs(first, some, target):
            inputs = [first, self.hits.count, self.pair_contacts, target]
            self._launch_once(pack.pair_packer(real), (some, pack.PAIR_NUMBERS), inputs)

        def pack_contacts(first, some, target):
            inputs = [first, self.faces, self.contacts, target]
            numbers = pack.CONTACT_NUMBERS + with_gap
            self._launch_once(pack.contact_packer(real, with_gap), (some, numbers), inputs)

        found.faces, memory = staging.send_rows(memory, self.faces, count)
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
        means["travel"] = self._empty(pairs, real)
        self._launch_once(pack.contact_copier(real), count, [self.faces, self.contacts, *found.contacts.values()])
        if self._gap is not None:
            separation = found.contacts["separation"] = self._empty(count, real)
            self._launch_once(pack.number_copier(real), count, [self.contacts.separation, separation])
        self._launch_once(pack.summary_copier(real), pairs, [self.pair_contacts, *means.values()])
        found.pair_contacts = {"count": found.count, **means}
        found.faces = wp.clone(first_rows(self.faces, count))

    def _dtypes(self):
        return contact_dtypes(self.contact_dtype, self._gap is not None)

    def _real(self):
        return wp.float64 if np.dtype(self.contact_dtype) == np.float64 else wp.float32
