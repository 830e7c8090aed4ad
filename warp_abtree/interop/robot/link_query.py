"""Queries about the parts of a robot at a chunk of configurations, among themselves and with what surrounds them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.upload import zeros_of
from warp_abtree.kernels.intersect.broad_phase import pose_box_kernel
from warp_abtree.kernels.robot import answers, forward, link_pairs
from warp_abtree.query.distance import DistanceQuery
from warp_abtree.query.narrow_phase import Query
from warp_abtree.query.request import Buffers
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


class LinkQuery(Query):
    """A query given no pairs, whose launch poses the parts and writes the pairs of each stage, a part first.

    Stages that a configuration needs no more are empty.

    Attributes:
        active: Configurations that are posed, the room by default.
        configurations: Device float64 (room, width).
        chunk: `link_pairs.Chunk` of device arrays.
        demand: Pairs of a stage at most, and face pairs that waited, device int32 (2,).
    """

    nearest: Any = None  # `answers.NearestParts`, where distances are asked

    def _prepare(self, batch: Batch, request: LinkRequest, mode: int):
        """Make what launches need beside the query."""
        self.request, self.mode, self.active = request, mode, request.room
        device, room = batch.device, request.room
        rows = room, len(request.chain.lower)
        self.frames = zeros_of(forward.Frames, room, len(request.chain.parent), device)
        spread, within = (rows, room) if mode == link_pairs.ASK_WITHIN else ((0, 0), 0)
        most = room if mode == link_pairs.ASK_DISTANCE else 0
        self.chunk = link_pairs.Chunk()
        sizes: dict[str, Any] = dict(count=1, half=spread, size=spread, hit=room, near=within, best=most)
        for name, shape in sizes.items():
            dtype = link_pairs.Chunk.vars[name].type.dtype
            setattr(self.chunk, name, wp.zeros(shape, dtype=dtype, device=device))
        self.configurations = wp.zeros(rows, dtype=wp.float64, device=device)
        self.demand = wp.zeros(2, dtype=wp.int32, device=device)
        self.lower, self.upper = (wp.zeros(batch.object_count, dtype=wp.vec3, device=device) for _ in range(2))
        around = request.around
        self.bvh = wp.Bvh(self.lower[:around], self.upper[:around]) if around else None

    def place(self):
        """Pose the parts of all configurations, and box all objects. Launches only."""
        request, pools, device = self.request, self.batch.pools, self.device
        parts, around = request.parts.frame, request.around
        inputs = [request.chain, self.configurations, self.frames]
        wp.launch(forward.forward_kernel, self.active, inputs, device=device)
        inputs = [around, parts, self.frames, pools[2]]
        wp.launch(forward.place_part_kernel, (self.active, len(parts)), inputs, device=device)
        inputs = [*pools, self.guard.record(), 0.0, None, self.lower, self.upper]
        wp.launch(pose_box_kernel, around + self.active * len(parts), inputs, device=device)
        if self.bvh is not None:
            self.bvh.rebuild()
        self.chunk.hit.zero_()
        self.chunk.near.zero_()

    def _launch(self, between=None):
        request, bvh = self.request, wp.uint64(0) if self.bvh is None else self.bvh.id
        self.demand.zero_()
        self.place()
        for stage in request.stages:
            self.pair_count.zero_()
            inputs = [self.mode, wp.vec2i(*stage), request.around, bvh, request.chain, request.parts, self.frames]
            inputs += [self.lower, self.upper, self.chunk, self.pair_count, self.pairs, self._distances()]
            wp.launch(link_pairs.find_link_pair_kernel, self.active, inputs, device=self.device)
            self.prove_apart()
            self.traverse()
            self._note([request.around, len(request.parts.frame), self.pair_count, self.pairs])

    def _distances(self) -> wp.array | None:
        """Return where the distances go up to which pairs matter; None where that is 0."""
        raise NotImplementedError

    def _note(self, found: list):
        """Reduce the answers of a stage's pairs to those of configurations. Launches only."""
        raise NotImplementedError

    def make_room_for(self, pairs: int, uncertain: int) -> bool:
        """Make room for a demand, and return whether there was too little."""
        lists = len(self.hits.uncertain)
        short = pairs > len(self.pairs), 0 < lists < uncertain
        if short[0]:
            self._take_pairs(wp.empty(pairs + pairs // 4, dtype=wp.vec2i, device=self.device))
        if short[1]:
            self._resize_uncertain(2 * uncertain)
        return any(short)


class LinkHits(LinkQuery):
    """Which configurations have parts that intersect; with proofs, also which have all proved apart by a reach."""

    def __init__(self, batch: Batch, request: LinkRequest, capacity: int, proves: bool):
        self._prepare(batch, request, int(link_pairs.ASK_WITHIN if proves else link_pairs.ASK_ANY))
        super().__init__(batch, "any", NO_PAIRS, Buffers(pairs=capacity), within=0.0 if proves else None)

    def _distances(self):
        return None if self.near is None else self.within

    def _note(self, found):
        near = None if self.near is None else self.near.any_hit
        inputs = [*found, self.hits, near, self.chunk, self.demand]
        wp.launch(answers.note_hit_kernel, len(self.pairs), inputs, device=self.device)


class LinkDistances(DistanceQuery, LinkQuery):
    """How far apart the nearest parts of each configuration are, or a part and its surroundings, and where.

    Attributes:
        most: What is farther apart is infinitely far.
    """

    most = np.inf

    def __init__(self, batch: Batch, request: LinkRequest, capacity: int):
        self._prepare(batch, request, int(link_pairs.ASK_DISTANCE))
        self.nearest = zeros_of(answers.NearestParts, request.room, 0, batch.device)
        super().__init__(batch, NO_PAIRS, Buffers(pairs=capacity))

    def _distances(self):
        return self._found.beyond

    def _launch(self, between=None):
        self.chunk.best.fill_(self.most)
        self.nearest.distance.fill_(np.inf)
        self.nearest.points.fill_(np.nan)
        self.nearest.faces.fill_(wp.vec2i(-1, -1))
        self.nearest.pair.fill_(wp.vec2i(-1, -1))
        super()._launch(between)

    def _note(self, found):
        self.nearest.winner.fill_(int(answers.NO_PAIR))
        for kernel, inputs in (
            (answers.note_distance_kernel, [self.hits, self.distances, self.chunk, self.demand]),
            (answers.find_winner_kernel, [self.distances, self.chunk, self.nearest]),
            (answers.write_nearest_kernel, [self.distances, self.nearest, self.chunk]),
        ):
            wp.launch(kernel, len(self.pairs), [*found, *inputs], device=self.device)
        self.forget()
