"""`sweep`: one pair of models at very many relative poses, without objects.

What a pair of models needs on a device is kept for the next call. Poses pass through two
buffer slots: while a GPU works on a chunk, the previous one is read and the next one uploaded.
"""

import weakref
from collections import deque
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import check_device
from warp_abtree.checks.device_lock import device_lock
from warp_abtree.kernels.base.arrays import NONE_REFUSED
from warp_abtree.kernels.io.sweep import pose_placer, report_chunk_kernel
from warp_abtree.query.request import SWEEP_OPTIONS, check_options, check_within, refuse_signed
from warp_abtree.query.stages.distance import DistanceQuery, check_beyond, check_distance_options
from warp_abtree.query.stages.intersect import Query
from warp_abtree.query.stages.motion import FirstContactQuery, HalfTurnError
from warp_abtree.scene.scene import Scene
from warp_abtree.scene.sweep_poses import PoseSlot, find_copy_stream, take_rows
from warp_abtree.state.arrays import ObjectArrays
from warp_abtree.state.batch import Batch
from warp_abtree.state.poses import QUATERNION_TOLERANCE, RIGID_TOLERANCE, raise_bad_pose

# Poses of a launch: enough to fill a GPU, few enough that millions need no more memory; fewer where few are given.
CHUNKS = (1024, 8192, 65536)
# Pairs of models whose device arrays are kept, and rows of their lists that are.
KEPT_PAIRS = 4
KEPT_ROWS = 2**20

# By the numbers of a row: quaternions, and matrices.
POSE_TOLERANCE = {7: QUATERNION_TOLERANCE, 16: RIGID_TOLERANCE}
DISTANCE_ROWS = np.dtype(
    [("distance", np.float64), ("bracket", np.float64, 2), ("points", np.float64, (2, 3)), ("faces", np.int32, 2)]
)
RESULT_NAMES = {"faces": "point_faces"}  # of `Result`, where a row's name is another
CONTACT_ROWS = np.dtype([("time", np.float64), ("clear", bool), ("undecided", bool)])
PACKED_DTYPES = {"any": np.dtype(bool), "count": np.dtype(np.int64)}

_kept: dict[tuple, "_PosedModels"] = {}


class _PosedModels:
    """A pair of models on a device, and chunks of several sizes, each made when first needed."""

    def __init__(self, pair: Scene, owners):
        self.owners = owners  # weak, and taken out of what is kept when a model goes
        self.batch = pair.batch()
        self.chunks: dict[int, _Chunk] = {}

    def find_chunk(self, count):
        """Return the smallest chunk that holds a number of poses, or the largest there is."""
        room = next((room for room in CHUNKS if room >= count), CHUNKS[-1])
        if room not in self.chunks:
            self.chunks[room] = _Chunk(self, room)
        return self.chunks[room]


class _Chunk:
    """A batch of object 0, model A, and objects 1 to `room`, all of them model B."""

    def __init__(self, posed: _PosedModels, room):
        pair, self.room = posed.batch, room
        objects = ObjectArrays(np.zeros(room + 1), np.zeros(room + 1), pair.device)
        objects.set_states(np.repeat(pair.objects.state, [1, room]))
        objects.pool.rotation[:1].assign(np.eye(3)[None])
        solid = () if pair.solids is None else np.repeat(pair.solids.is_solid, [1, room])
        self.batch = Batch(pair.models, pair.states, objects, np.repeat(pair.object_model, [1, room]), solid=solid)
        self.chunk_query: _ChunkQuery | None = None

    def find_query(self, *key):
        """Return the chunk's query if it is of this output and precision, and of the same options, else another."""
        if self.chunk_query is None or self.chunk_query.key != key:
            self.chunk_query = None  # its memory first
            self.chunk_query = _ChunkQuery(self, key)
        return self.chunk_query

    def trim(self):
        """Give long lists back."""
        if self.chunk_query is not None:
            hits = self.chunk_query.query.hits
            if len(hits.face) + len(hits.uncertain) > KEPT_ROWS:
                self.chunk_query = None


class _ChunkQuery:
    """One kind of query about a pair of models, and its buffer slots."""

    def __init__(self, chunk: _Chunk, key):
        self.key = key
        self.output, precision, signed, proves = key
        self.device, self.room, self.objects = chunk.batch.device, chunk.room, chunk.batch.objects
        self.pairs = np.stack([np.zeros(self.room, np.int32), np.arange(1, self.room + 1, dtype=np.int32)], 1)
        if self.output == "distance":
            self.query: Any = DistanceQuery(chunk.batch, self.pairs, signed=signed)
        elif self.output == "first_contact":
            self.query = FirstContactQuery(chunk.batch, None, self.pairs, linear=precision == "linear")
        else:
            within = 0.0 if proves else None
            self.query = Query(chunk.batch, self.output, pairs=self.pairs, precision=precision, within=within)
        self.count = self.room
        self._slots: dict = {}
        self.copies = find_copy_stream(self.device.alias) if self.device.is_cuda else None

    def _find_slots(self, poses):
        """Return the slots of poses of one type, made at the first use."""
        kind = poses.scalar, poses.width
        if kind not in self._slots:
            count = 1 + (self.output in PACKED_DTYPES)
            made = [PoseSlot(self.device, self.room, self.output, *kind) for _ in range(count)]
            if self.device.is_cuda:
                # Another stream may touch what was allocated on this one only once it is there.
                wp.synchronize_device(self.device)
            self._slots[kind] = made
        return self._slots[kind]

    def _load(self, slot, poses, start, count):
        """Bring poses into a slot whose last chunk is over."""
        width = slot.width
        if poses.flat is not None:
            wp.copy(slot.poses_flat, poses.flat, src_offset=width * start, count=width * count)
            return
        np.copyto(slot.poses_host.numpy().reshape(-1, width)[:count], poses.rows[start : start + count])
        if self.copies is not None:
            wp.copy(slot.poses_flat, slot.poses_host, count=width * count, stream=self.copies)
            self.copies.record_event(slot.loaded)
            wp.get_stream(self.device).wait_event(slot.loaded)

    def _place(self, slot, objects=None):
        slot.report.fill_(NONE_REFUSED)
        kernel = pose_placer(slot.poses.dtype, slot.width)
        objects = self.objects.pool if objects is None else objects
        inputs = [wp.float64(POSE_TOLERANCE[slot.width]), slot.poses, objects, slot.report]
        wp.launch(kernel, self.count, inputs, device=self.device)

    def _begin(self, slot, poses, start, count):
        self._load(slot, poses, start, count)
        slot.uncertain_room = len(self.query.hits.uncertain)
        if count != self.count:
            self.query.pair_count.fill_(count)
            self.count = count
        self._place(slot)
        self.query.launch()
        inputs = [self.query.hits, slot.report, slot.answer]
        wp.launch(report_chunk_kernel, self.count, inputs, device=self.device)
        if self.output == "count":
            wp.copy(slot.answer_host, self.query.hits.count, count=count)
        if self.device.is_cuda:
            if self.output == "any":
                wp.copy(slot.answer_host, slot.answer, count=count)
            wp.copy(slot.report_host, slot.report)
            wp.get_stream(self.device).record_event(slot.done)

    def _finish(self, slot, poses, start, count):
        """Wait for a chunk and return its answers."""
        if self.device.is_cuda:
            wp.synchronize_event(slot.done)
        refused, uncertain = slot.report_host.numpy().tolist()
        if refused != NONE_REFUSED:
            raise_bad_pose(poses.row(start + refused), start + refused)
        if uncertain % 2**32 <= slot.uncertain_room:
            return slot.answer_host.numpy()[:count]
        # Room may have grown since: asked again, with room as needed.
        self.query.ask_pairs(self.pairs[:count])
        self.count = count
        self._place(slot)
        return getattr(self.query.run(), self.output)

    def find_answers(self, poses):
        """Return "any" or "count" of all poses."""
        answers = np.empty(len(poses), PACKED_DTYPES[self.output])
        slots, waiting = self._find_slots(poses), deque()

        def finish():
            slot, start, count = waiting.popleft()
            answers[start : start + count] = self._finish(slot, poses, start, count)

        try:
            for turn, start in enumerate(range(0, len(poses), self.room)):
                slot, count = slots[turn % len(slots)], min(self.room, len(poses) - start)
                if len(waiting) == len(slots):
                    finish()
                self._begin(slot, poses, start, count)
                waiting.append((slot, start, count))
            while waiting:
                finish()
        except BaseException:
            # A pose was refused, or an interruption came: slots whose transfers are under way must not go yet.
            wp.synchronize_device(self.device)
            raise
        return answers

    def _ask(self, poses, ends=None, **distances):
        """Yield the poses of each chunk, a slice, and what the query finds of the chunk's first so many pairs."""
        given = [(poses, None, "poses")]
        if ends is not None:
            given.append((ends, self.query.ends, "end_poses"))
        for start in range(0, len(poses), self.room):
            self.count = count = min(self.room, len(poses) - start)
            for rows, objects, what in given:
                slot = self._find_slots(rows)[0]
                self._load(slot, rows, start, count)
                self._place(slot, objects)
                refused = int(slot.report.numpy()[0])
                if refused != NONE_REFUSED:
                    raise_bad_pose(rows.row(start + refused), start + refused, what)
            self.query.ask_pairs(self.pairs[:count], **distances)
            try:
                result = self.query.run()
            except HalfTurnError as error:
                raise HalfTurnError(start + error.row, f"pose {start + error.row}") from None
            yield slice(start, start + count), result

    def find_faces(self, poses):
        """Return the rows of "faces" of all poses."""
        parts = []
        for part, result in self._ask(poses):
            result.faces[:, 0] += part.start
            parts.append(result.faces)
        return np.concatenate(parts)

    def find_rows(self, poses, kind, ends=None, **distances):
        """Return rows of all poses, each field the array of a result that has its name."""
        found = np.empty(len(poses), kind)
        for part, result in self._ask(poses, ends, **distances):
            for name in kind.names:
                found[name][part] = getattr(result, RESULT_NAMES.get(name, name))
        return found


def apart_rows(output) -> np.dtype:
    """Return the type of the answers of a sweep with `within`."""
    return np.dtype([(output, PACKED_DTYPES[output]), ("apart", np.dtype(bool))])


def sweep(
    model_a,
    model_b,
    poses,
    lod_a=None,
    lod_b=None,
    output="any",
    precision="exact",
    device=None,
    solid=False,
    *,
    within=None,
    tolerance=None,
    relative=None,
    beyond=None,
    signed=None,
    originals=None,
    end_poses=None,
    screw=None,
    linear=None,
) -> np.ndarray:
    """Test one pair of models at many poses of B in A's frame. Waits for the device, 1 to 3 times a chunk of 65,536.

    Poses are checked on the device; on CUDA transfers overlap with launches, except for "faces". What the last four
    pairs of models, LODs and devices need stays on the device while both models live: some 190 bytes a face, 0.5 KB for
    each of at most 74,752 poses. Calls of several threads take turns on a GPU.

    Args:
        model_a, model_b: `Model`; may be the same.
        poses: (p, 7) x y z qx qy qz qw [model units of A, unit quaternions, normalised in float64], or rigid (p, 4, 4)
            matrices, taken as they are; float32 or float64, of any framework. What lies on the GPU that asks is read
            where it is, Warp's transforms and matrices (p,) too.
        lod_a, lod_b, device: LODs, None is the finest; and Warp device, None for Warp's default.
        output: "any", "count", "faces", "distance" or "first_contact", of B's motions from poses to end_poses.
        precision: As `Scene.intersect`, exact for A's vertices and the posed ones of B.
        solid: Whether both are solids (`Scene.add`), or a bool for each; what "any" and "distance" answer for one
            inside the other stands in `warp_abtree.state.solids`, "count" and "faces" are of surfaces.
        within, relative, beyond, signed, originals: One value each, as `Scene.intersect` takes them.
        tolerance: Of a "distance" as `DistanceQuery` takes it, of a "first_contact" as `FirstContactQuery` does.
        end_poses, screw, linear: End poses as poses, the rest as `FirstContactQuery`; for "first_contact" alone.

    Returns:
        For "any" bool (p,), for "count" the intersecting face pairs of each pose, int64 (p,), for "faces" rows (pose,
        face of A, face of B), int32 (k, 3), sorted; with within, a structured array (p,) of any or count, and apart,
        whether the surfaces are proved farther apart. For "distance" a structured array (p,) of distance, bracket (2,),
        points (2, 3) [A's frame] and faces (2,), see `query.stages.distance`. For "first_contact" one of time,
        clear and undecided, see `query.stages.motion`.

    Raises:
        TypeError: model_a or model_b is no Model; a "first_contact" without end_poses.
        ValueError: Bad poses, the first named, a LOD out of range, an option that means nothing for the output, an
            unknown device, signed without a solid.
        RuntimeError: A graph is being captured.
    """
    options = {"within": within, "tolerance": tolerance, "relative": relative, "beyond": beyond, "signed": signed}
    options |= {"originals": originals, "end_poses": end_poses, "screw": screw, "linear": linear}
    options = _check_request(output, precision, options)
    pair = Scene(device)
    check_device(pair.device, "ab.sweep")
    with device_lock(pair.device):
        poses = take_rows(poses, pair.device)
        if output == "first_contact":
            options["end_poses"] = ends = take_rows(options["end_poses"], pair.device, "end_poses")
            if len(ends) != len(poses):
                raise ValueError(f"end_poses: {len(ends)} given for {len(poses)} poses")
        for i, (model, lod) in enumerate([(model_a, lod_a), (model_b, lod_b)]):
            pair.add(model, lod=lod, solid=solid[i] if isinstance(solid, tuple | list) and len(solid) == 2 else solid)
        refuse_signed(options.get("signed", False), any(pair.object_solid))
        if options.get("originals"):
            pair.set_lods([model.lod_max for model in (model_a, model_b)])
        return _sweep(pair, poses, (output, precision), options)


def _check_request(output, precision, options) -> dict:
    """Return the options that are given, checked but for the poses."""
    given = check_options(SWEEP_OPTIONS, output, precision, options)
    if output == "first_contact":
        if "end_poses" not in given:
            raise TypeError(f"sweep needs end_poses for output {output!r}")
        FirstContactQuery.plan(**{name: value for name, value in given.items() if name != "end_poses"})
        return given
    check_distance_options(given)
    check_beyond(given.get("beyond"))
    if "within" in given:
        check_within(given["within"], known="a sweep: one distance for all")
    return given


def _sweep(pair, poses, asked, options):
    (output, precision), within = asked, options.get("within")
    if output == "first_contact":
        precision = "linear" if options.pop("linear", False) else "rigid"
    if len(poses) == 0:
        kinds = {**PACKED_DTYPES, "distance": DISTANCE_ROWS, "first_contact": CONTACT_ROWS}
        kind = kinds.get(output) if within is None else apart_rows(output)
        return np.empty((0, 3), np.int32) if output == "faces" else np.empty(0, kind)
    models = [pair.models[i] for i in pair.object_model]
    key = (*map(id, models), *pair.lods.tolist(), *pair.object_solid, pair.device.alias)
    # Taken out while in use: a call from another thread has its own, and one that fails leaves nothing behind.
    posed = _kept.pop(key, None)
    if posed is None:
        owners = [weakref.ref(model, lambda _: _kept.pop(key, None)) for model in models]
        posed = _PosedModels(pair, owners)
    chunk = posed.find_chunk(len(poses))
    query = chunk.find_query(output, precision, options.get("signed", False), within is not None)
    if output == "distance":
        query.query.set_tolerance(**{name: options[name] for name in ("tolerance", "relative") if name in options})
        answers = query.find_rows(poses, DISTANCE_ROWS, beyond=check_beyond(options.get("beyond")))
    elif output == "first_contact":
        ends = options.pop("end_poses")
        query.query.set_options(**options)
        answers = query.find_rows(poses, CONTACT_ROWS, ends)
    elif within is not None:
        answers = query.find_rows(poses, apart_rows(output), within=within)
    else:
        answers = query.find_faces(poses) if output == "faces" else query.find_answers(poses)
    chunk.trim()
    _kept[key] = posed
    for old in list(_kept)[:-KEPT_PAIRS]:
        _kept.pop(old, None)
    return answers
