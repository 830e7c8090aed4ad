"""Queries about the parts of a robot at a chunk of configurations, among themselves and with what surrounds them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.kernels.intersect.broad_phase import pose_box_kernel
from warp_abtree.kernels.robot import answers, forward, link_pairs
from warp_abtree.query.broad_phase import BroadPhase
from warp_abtree.query.request import Buffers
from warp_abtree.query.stages.distance import DistanceQuery
from warp_abtree.query.stages.intersect import Query
from warp_abtree.state.batch import Batch
from warp_abtree.state.generation import LaunchGuard

CHECK_MODES = {
    "any": int(link_pairs.ASK_ANY),
    "within": int(link_pairs.ASK_WITHIN),
    "distance": int(link_pairs.ASK_DISTANCE),
}


@dataclass
class LinkRequest:
    """Request of a chunk's query: a robot's chain and parts, and the objects of the batch.

    Attributes:
        stages: (first, end) of the entries of `parts` that are asked one after the other.
        around: Objects of the surroundings, which come first.
        room: Configurations.
        width: Numbers of a configuration.
        frame_count, part_count: Of the robot.
    """

    chain: forward.Chain
    parts: link_pairs.Parts
    stages: list[tuple[int, int]]
    around: int
    room: int
    width: int
    frame_count: int
    part_count: int


class LinkPairs:
    """Broad phase of a robot's parts: poses them by their configurations, and finds the pairs of a stage.

    Attributes:
        pairs, pair_count, guard, wide: As of `BroadPhase`; a pair names a part first.
        active: Configurations that are posed, the room by default.
        configurations: Device float64 (room, width).
        chunk: `link_pairs.Chunk` of device arrays.
        query: Query that the pairs are for.
    """

    check_found = staticmethod(BroadPhase.check_found)
    guard: LaunchGuard
    wide = 0.0
    pairs: wp.array

    def __init__(self, query, request: LinkRequest, mode: int, capacity: int):
        self.query, self.request, self.mode, self.batch = query, request, mode, query.batch
        self.device = device = self.batch.device
        self.active = request.room
        room, frames, count = request.room, forward.Frames(), self.batch.object_count

        def make(dtype, shape):
            return wp.zeros(shape, dtype=dtype, device=device)

        frames.rotation, frames.position = (make(t, (room, request.frame_count)) for t in (wp.mat33d, wp.vec3d))
        self.frames, self.lower, self.upper = frames, make(wp.vec3, count), make(wp.vec3, count)
        self.configurations = make(wp.float64, (room, request.width))
        self.chunk = chunk = link_pairs.Chunk()
        spread = (room, request.width) if mode == CHECK_MODES["within"] else (0, 0)
        chunk.count, chunk.half, chunk.size = make(wp.int32, 1), make(wp.float64, spread), make(wp.float64, spread)
        chunk.hit = make(wp.uint8, room)
        chunk.near = make(wp.uint8, room if mode == CHECK_MODES["within"] else 0)
        chunk.best = make(wp.float64, room if mode == CHECK_MODES["distance"] else 0)
        self._no_reach, self._no_distance = make(wp.vec4d, 0), make(wp.float64, 0)
        self.pair_count = make(wp.int32, 1)
        self.pairs = wp.empty(capacity, dtype=wp.vec2i, device=device)
        self.bvh = wp.Bvh(self.lower[: request.around], self.upper[: request.around]) if request.around else None

    def make_room(self, pairs: wp.array) -> list:
        """Return (owner, attribute, new array) of a list of pairs."""
        return [(self, "pairs", pairs)]

    def place(self):
        """Pose the parts of all configurations, and box all objects. Launches only."""
        request, device = self.request, self.device
        inputs = [request.chain, self.configurations, self.frames]
        wp.launch(forward.forward_kernel, self.active, inputs, device=device)
        inputs = [request.around, request.parts.frame, self.frames, self.batch.objects.pool]
        wp.launch(forward.place_part_kernel, (self.active, request.part_count), inputs, device=device)
        inputs = [self.batch.trees, self.guard.record(), 0.0, self._no_reach, self.lower, self.upper]
        wp.launch(pose_box_kernel, request.around + self.active * request.part_count, inputs, device=device)
        if self.bvh is not None:
            self.bvh.rebuild()
        self.chunk.hit.zero_()
        self.chunk.near.zero_()

    def launch(self, stage: tuple[int, int]):
        """Find the pairs of a stage. Launches only."""
        request, distances = self.request, self._no_distance
        if self.mode == CHECK_MODES["within"]:
            distances = self.query.within
        elif self.mode == CHECK_MODES["distance"]:
            distances = self.query.beyond
        self.pair_count.zero_()
        bvh = wp.uint64(0) if self.bvh is None else self.bvh.id
        inputs = [self.mode, wp.vec2i(*stage), request.around, bvh, request.chain, request.parts, self.frames]
        inputs += [self.lower, self.upper, self.chunk, self.pair_count, self.pairs, distances]
        wp.launch(link_pairs.find_link_pair_kernel, self.active, inputs, device=self.device)


class StagedQuery(Query):
    """A query whose launch goes through the stages of `LinkPairs`; those that a configuration needs no more are empty.

    Attributes:
        links: `LinkPairs`.
        demand: Pairs of a stage at most, and face pairs that waited, device int32 (2,).
    """

    links: LinkPairs

    def _prepare(self, batch: Batch, request: LinkRequest, mode: str):
        self.request, self.mode = request, CHECK_MODES[mode]
        self.nearest: Any = None  # `answers.NearestParts`, where distances are asked
        self.demand = wp.zeros(2, dtype=wp.int32, device=batch.device)

    def _make_broad_phase(self, capacity, sorts):
        self.links = LinkPairs(self, self.request, self.mode, capacity)
        return self.links

    def _fill_within(self):
        """Distances are written where pairs are found."""

    def _launch(self, between=None):
        self.demand.zero_()
        self.links.place()
        for stage in self.request.stages:
            self.links.launch(stage)
            self.prove_apart()
            self.traverse()
            self._note()

    def _note(self):
        raise NotImplementedError

    def run_stages(self):
        """Launch, and again with more room until nothing is lost. Waits for the device."""
        while True:
            self.launch()
            pairs, uncertain = self.demand.numpy().tolist()
            if not self.make_room_for(pairs, uncertain):
                return

    def make_room_for(self, pairs: int, uncertain: int) -> bool:
        """Make room for a demand, and return whether there was too little."""
        short = pairs > len(self.pairs), len(self.hits.uncertain) and uncertain > len(self.hits.uncertain)
        if short[0]:
            self._take_pairs(wp.empty(pairs + pairs // 4, dtype=wp.vec2i, device=self.device))
        if short[1]:
            self._resize_uncertain(2 * uncertain)
        return bool(short[0] or short[1])


class LinkHits(StagedQuery):
    """Which configurations have parts that intersect; with proofs, also which have all proved apart by a reach."""

    def __init__(self, batch: Batch, request: LinkRequest, capacity: int, proves: bool):
        self._prepare(batch, request, "within" if proves else "any")
        self._no_near = wp.empty(0, dtype=wp.int32, device=batch.device)
        super().__init__(batch, "any", capacity=Buffers(pairs=capacity), within=0.0 if proves else None)

    def _note(self):
        near = self._no_near if self.near is None else self.near.any_hit
        links, request = self.links, self.request
        inputs = [request.around, request.part_count, self.pair_batch, self.hits, near, links.chunk]
        inputs.append(self.demand)
        wp.launch(answers.note_hit_kernel, len(self.pairs), inputs, device=self.device)


class LinkDistances(DistanceQuery, StagedQuery):
    """How far apart the nearest parts of each configuration are, or a part and its surroundings, and where."""

    def __init__(self, batch: Batch, request: LinkRequest, capacity: int):
        self._prepare(batch, request, "distance")
        self.most = np.inf
        self.nearest = nearest = answers.NearestParts()
        for name, dtype in (
            ("winner", wp.int64),
            ("distance", wp.float64),
            ("points", answers.two_points),
            ("faces", wp.vec2i),
            ("pair", wp.vec2i),
        ):
            setattr(nearest, name, wp.empty(request.room, dtype=dtype, device=batch.device))
        super().__init__(batch, capacity=Buffers(pairs=capacity))

    @property
    def beyond(self) -> wp.array:
        """Distance that ends the search of each pair."""
        return self._found.beyond

    def _launch(self, between=None):
        nearest: Any = self.nearest
        self.links.chunk.best.fill_(self.most)
        nearest.distance.fill_(np.inf)
        nearest.points.fill_(np.nan)
        nearest.faces.fill_(wp.vec2i(-1, -1))
        nearest.pair.fill_(wp.vec2i(-1, -1))
        super()._launch(between)

    def _note(self):
        links, request = self.links, self.request
        nearest: Any = self.nearest
        nearest.winner.fill_(int(answers.NO_PAIR))
        given = [request.around, request.part_count, self.pair_batch]
        for kernel, inputs in (
            (answers.note_distance_kernel, [self.hits, self.distances, links.chunk, self.demand]),
            (answers.find_winner_kernel, [self.distances, links.chunk, nearest]),
            (answers.write_nearest_kernel, [self.distances, nearest, links.chunk]),
        ):
            wp.launch(kernel, len(self.pairs), [*given, *inputs], device=self.device)
        self.forget()
