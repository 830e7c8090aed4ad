"""Queries about the parts of a robot at a chunk of configurations, among themselves and with what surrounds them."""

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.device_memory import DeviceMemory
from warp_abtree.checks.upload import zeros_of
from warp_abtree.kernels.intersect.broad_phase import PosedBounds, pose_box_kernel
from warp_abtree.kernels.robot import answers, forward, link_pairs
from warp_abtree.kernels.robot.link_pairs import ASK_ANY, ASK_DISTANCE, ASK_PADDED, ASK_WITHIN
from warp_abtree.query.request import Buffers
from warp_abtree.query.stages.distance import DistanceQuery
from warp_abtree.query.stages.intersect import Query
from warp_abtree.state.batch import Batch

NO_PAIRS = np.zeros((0, 2), np.int32)


@dataclass
class LinkRequest:
    """Request of a chunk's query: a robot's chain and parts, and the objects of the batch."""

    chain: forward.Chain
    parts: link_pairs.Parts
    stages: list[tuple[int, int]]  # (first, end) of the entries of `parts` that are asked one after the other
    around: int  # objects of the surroundings, which come first
    room: int  # configurations
    is_padded: bool = False  # whether a part has padding


class LinkQuery(DeviceMemory):
    """A query given no pairs: a launch poses the parts, writes the pairs of each stage, a part first, and asks it.

    Stages that a configuration needs no more are empty.

    Args:
        query: `Query` or `DistanceQuery` of the batch, without pairs.
        request: `LinkRequest`.
        modes: Of `link_pairs`, what is asked of each stage, one after the other.
        distances: Up to where each pair matters, device float64 (pair,); None where that is 0.

    Attributes:
        query: As given.
        active: Configurations that are posed, the room by default.
        configurations: Device float64 (room, width).
        chunk: `link_pairs.Chunk` of device arrays.
        demand: Pairs of a stage at most, and face pairs that waited, device int32 (2,).
    """

    nearest: Any = None  # `answers.NearestParts`, where distances are asked

    def __init__(self, query, request: LinkRequest, modes: tuple, distances: str | None = None):
        self.query, self.request, self.modes, self.active = query, request, modes, request.room
        self.batch, self.device, self._distances, batch = query.batch, query.device, distances, query.batch
        device, room = batch.device, request.room
        rows = room, len(request.chain.lower)
        self.frames = zeros_of(forward.Frames, room, len(request.chain.parent), device)
        spread, within = (rows, room) if ASK_WITHIN in modes else ((0, 0), 0)
        most = room if ASK_DISTANCE in modes else 0
        self.chunk = link_pairs.Chunk()
        sizes: dict[str, Any] = dict(count=1, half=spread, size=spread, hit=room, near=within, best=most)
        for name, shape in sizes.items():
            dtype = link_pairs.Chunk.vars[name].type.dtype
            setattr(self.chunk, name, wp.zeros(shape, dtype=dtype, device=device))
        self.configurations = wp.zeros(rows, dtype=wp.float64, device=device)
        self.demand = wp.zeros(2, dtype=wp.int32, device=device)
        self.boxes, around = link_pairs.LinkBoxes(), request.around
        for name in ("lower", "upper"):
            setattr(self.boxes, name, wp.zeros(batch.object_count, dtype=wp.vec3, device=device))
        self._bounds = PosedBounds()
        self._bounds.lower, self._bounds.upper = self.boxes.lower, self.boxes.upper
        self._bounds.pair_count = wp.zeros(1, dtype=wp.int32, device=device)
        self.bvh = wp.Bvh(self.boxes.lower[:around], self.boxes.upper[:around]) if around else None
        self.boxes.bvh = wp.uint64(0) if self.bvh is None else self.bvh.id

    def place(self):
        """Pose the parts of all configurations, and box all objects. Launches only."""
        request, device = self.request, self.device
        parts, around = request.parts.frame, request.around
        inputs = [request.chain, self.configurations, self.frames]
        wp.launch(forward.forward_kernel, self.active, inputs, device=device)
        inputs = [around, parts, self.frames, self.batch.objects.pool]
        wp.launch(forward.place_part_kernel, (self.active, len(parts)), inputs, device=device)
        inputs = [self.batch.trees, self.query.guard.record(), 0.0, None, self._bounds]
        wp.launch(pose_box_kernel, around + self.active * len(parts), inputs, device=device)
        if self.bvh is not None:
            self.bvh.rebuild()
        self.chunk.hit.zero_()
        self.chunk.near.zero_()

    def launch(self):
        """Launch all stages. Launches only."""
        query = self.query
        query.check_scene()
        with query.guard.launching(self):
            self._begin()
            self.place()
            for stage, mode in product(self.request.stages, self.modes):
                query.pair_count.zero_()
                self._find_pairs(stage, mode)
                query.search()
                self._note([self.request.around, len(self.request.parts.frame), query.pair_batch], mode)

    def _find_pairs(self, stage, mode: int):
        request, query = self.request, self.query
        distances = None if self._distances is None else query.distances_of(self._distances)
        inputs = [mode, wp.vec2i(*stage), request.around, request.chain, request.parts, self.frames]
        inputs += [self.boxes, self.chunk, query.pair_batch, distances]
        wp.launch(link_pairs.find_link_pair_kernel, self.active, inputs, device=self.device)

    def _begin(self):
        """Forget the answers of the last launch. Launches only."""
        self.demand.zero_()

    def _note(self, found: list, mode: int):
        """Reduce the answers of a stage's pairs to those of configurations. Launches only."""
        raise NotImplementedError

    def make_room_for(self, pairs: int, uncertain: int) -> bool:
        """Make room for a demand, and return whether there was too little."""
        rooms, wanted = self.query.rooms, {}
        if pairs > rooms.pairs:
            wanted["pairs"] = pairs + pairs // 4
        if 0 < rooms.uncertain < uncertain:
            wanted["uncertain"] = 2 * uncertain
        if wanted:
            self.query.make_room(**wanted)
        return bool(wanted)


class LinkHits(LinkQuery):
    """Which configurations have parts that meet; with proofs, also which have all proved apart by a reach and paddings.

    Parts that are padded meet where they are not proved apart by their paddings: that is asked first.
    """

    def __init__(self, batch: Batch, request: LinkRequest, capacity: int, proves: bool):
        asked = [(ASK_PADDED, request.is_padded), (ASK_WITHIN, proves), (ASK_ANY, not (request.is_padded or proves))]
        modes = tuple(mode for mode, is_asked in asked if is_asked)
        near = None if ASK_ANY in modes else "within"
        query = Query(batch, "any", NO_PAIRS, Buffers(pairs=capacity), within=None if near is None else 0.0)
        super().__init__(query, request, modes, near)
        self._padded = link_pairs.Chunk()  # where what is near meets
        for name in link_pairs.Chunk.vars:
            setattr(self._padded, name, getattr(self.chunk, "hit" if name == "near" else name))

    def _note(self, found, mode):
        query, chunk = self.query, self._padded if mode == ASK_PADDED else self.chunk
        inputs = [*found, query.hits, None if query.near is None else query.near.any_hit, chunk, self.demand]
        wp.launch(answers.note_hit_kernel, len(query.pairs), inputs, device=self.device)


class LinkPairs(LinkHits):
    """Which parts intersect at each configuration: read by the host after each stage, so that no graph captures it.

    Attributes:
        found: Pairs of objects that intersect, a part first, arrays (k, 2).
    """

    found: list[np.ndarray]

    def __init__(self, batch: Batch, request: LinkRequest, capacity: int):
        super().__init__(batch, request, capacity, False)

    def _begin(self):
        super()._begin()
        self.found = []

    def _note(self, found, mode):
        super()._note(found, mode)
        self.chunk.hit.zero_()  # later stages are asked, too
        pairs = self.query.pairs.numpy()[: self.query.pair_count.numpy()[0]]
        for hits in (self.query.hits, self.query.near):
            if hits is not None:
                self.found.append(pairs[hits.any_hit.numpy()[: len(pairs)] != 0])


class LinkDistances(LinkQuery):
    """How far apart the nearest parts of each configuration are, or a part and its surroundings, and where.

    Attributes:
        most: What is farther apart is infinitely far.
    """

    most = np.inf

    def __init__(self, batch: Batch, request: LinkRequest, capacity: int):
        self.nearest = zeros_of(answers.NearestParts, request.room, 0, batch.device)
        query = DistanceQuery(batch, NO_PAIRS, Buffers(pairs=capacity))
        super().__init__(query, request, (ASK_DISTANCE,), "beyond")

    def _begin(self):
        super()._begin()
        self.chunk.best.fill_(self.most)
        self.nearest.distance.fill_(np.inf)
        self.nearest.points.fill_(np.nan)
        self.nearest.faces.fill_(wp.vec2i(-1, -1))
        self.nearest.pair.fill_(wp.vec2i(-1, -1))

    def _note(self, found, mode):
        query = self.query
        self.nearest.winner.fill_(int(answers.NO_PAIR))
        for kernel, inputs in (
            (answers.note_distance_kernel, [query.hits, query.distances, self.chunk, self.demand]),
            (answers.find_winner_kernel, [query.distances, self.chunk, self.nearest]),
            (answers.write_nearest_kernel, [query.distances, self.nearest, self.chunk]),
        ):
            wp.launch(kernel, len(query.pairs), [*found, *inputs], device=self.device)
        query.forget()
