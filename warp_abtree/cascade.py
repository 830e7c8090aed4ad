"""Questions about the original meshes that coarse levels of detail settle where they can.

Why the answer is exact. `Model.error_at(lod)` bounds how far any point of the original surface lies from the surface at
that LOD (one-sided, and that is the side needed). If the originals of A and B had a point in common, each coarse
surface would have a point within its error of it, and the two surfaces would be at most error(A) + error(B) apart. So
where they are proved farther apart than that, the originals do not meet. `kernels.distance.pad_distance` covers the
roundings of poses and of x' for both surfaces of each model (the original reaches beyond the coarse one by its error at
most) and rotations that stretch; the sum of the errors is rounded up.

Why it does not pay. A tree at a coarse LOD is the same tree. A node's coarse box, widened by the errors, is hardly
smaller than its original box, so a proof goes about as deep as the originals' own answer or deeper before boxes part,
and then measures distances of faces, which cost more than tests for contact.
"""

from numbers import Real
from typing import cast

import numpy as np
import warp as wp

from warp_abtree.broadphase import BroadPhase
from warp_abtree.intersect import COUNTERS, Query, Result, check_request
from warp_abtree.kernels import cascade
from warp_abtree.refine import set_object_lods
from warp_abtree.scene import Scene
from warp_abtree.state import ObjectArrays, StateArrays

# Of 1, 5 and 20 % of the faces the last settles most, and costs least where pairs are far apart.
RUNGS = (0.2,)


def check_rungs(rungs) -> tuple:
    """Return shares of the faces, coarsest first, as a tuple of floats.

    Raises:
        ValueError: They are no sequence of numbers between 0 and 1 that rise.
    """
    try:
        rungs = tuple(rungs)
    except TypeError:
        raise ValueError(f"rungs: {rungs!r} is no sequence of shares of the faces") from None
    for k, share in enumerate(rungs):
        if isinstance(share, bool) or not isinstance(share, Real) or not 0 < float(share) < 1:
            raise ValueError(f"rungs: {share!r} at {k} is no share of the faces between 0 and 1")
        if k and not share > rungs[k - 1]:
            raise ValueError(f"rungs: {share!r} at {k} does not exceed {rungs[k - 1]!r} before it")
    return tuple(float(share) for share in rungs)


class _Standing:
    """The objects of a scene, posed as they are there, at LODs of their own: what a `Query` asks of a scene."""

    def __init__(self, scene: Scene, states: StateArrays, object_state):
        self.scene = scene
        self.device = scene.device
        self._source = scene.arrays()
        models, _, posed = self._source
        count = len(object_state)
        objects = ObjectArrays(np.zeros(count), np.zeros(count), self.device)
        # The scene's own arrays of poses, so that no pose is ever copied.
        for name in ("world", "is_static", "rotation", "position"):
            setattr(objects.pool, name, getattr(posed.pool, name))
        objects.set_states(object_state)
        self._arrays = (models, states, objects)

    def arrays(self):
        """Return the arrays made for the scene, or the scene's own if it has others by now, which are never equal."""
        current = self.scene.arrays()
        return self._arrays if current is self._source else current

    def check_pairs(self, pairs):
        return self.scene.check_pairs(pairs)

    def excluded_keys(self):
        return self.scene.excluded_keys()


def _stand(scene: Scene, lods) -> list:
    """Return a `_Standing` for each row of LODs, (rungs, models); objects of a model share its states."""
    models = scene.arrays()[0]
    states = StateArrays(models, scene.device)
    rows, count = lods.shape
    holders = ObjectArrays(np.zeros(lods.size), np.zeros(lods.size), scene.device)
    set_object_lods(models, states, holders, np.tile(np.arange(count), rows), lods.reshape(-1))
    object_model = np.array(scene.object_model)
    return [_Standing(scene, states, state[object_model]) for state in holders.state.reshape(rows, count)]


class _Stage(Query):
    """A query about the objects at one rung, whose pairs and results lie in arrays of the cascade."""

    def __init__(self, cascade, standing, output="faces", **options):
        self.cascade = cascade
        super().__init__(standing, output, pairs=np.empty((0, 2), np.int32), unsure_capacity=1, **options)

    def uses_warps(self):
        return self.cascade.uses_warps()

    def has_pairs(self) -> bool:
        """Return whether any pair may be left; known without waiting on the CPU only, outside a captured graph."""
        return self.device.is_cuda or self.device.is_capturing or int(self.pair_count.numpy()[0]) > 0


class CascadeResult(Result):
    """What a cascade found, on the host: a `Result` about the original meshes.

    Attributes:
        rung: The rung that proved each pair apart, 0 the coarsest; the number of rungs where the originals were asked;
            int32 (p,).
        apart: Whether a rung proved the pair apart, bool (p,).
        node_tests, triangle_tests, float64_tests, exact_tests: Work on the originals, 0 where a rung settled the pair.
        proof_node_tests, proof_triangle_tests: Work of the rungs for each pair, int64 (p,).
    """

    def __init__(self, pairs, output, pair_demand, pair_room, hits, proof, rung_count):
        super().__init__(pairs, output, pair_demand, pair_room, hits)
        p = len(pairs)
        self.rung = proof.rung.numpy()[:p].copy()
        self.apart = self.rung < rung_count
        self.proof_node_tests = proof.node_tests.numpy()[:p].copy()
        self.proof_triangle_tests = proof.triangle_tests.numpy()[:p].copy()


class Cascade(Query):
    """Intersection of the original meshes of many object pairs, coarse LODs asked first: allocates once.

    A pair that a rung proves apart is settled; the next rung gets what is left, and the originals, exactly, what the
    last one leaves. Answers are those of a `Query` of the same scene at its finest LODs. The scene's own LODs play no
    part and are left alone; its poses hold at the time of each launch, without a copy.

    On a CPU it was slower than that query on every mesh and at every distance measured (`python -m bench cascade`), so
    ask that one for speed. What it adds is `rung`: which LODs would have been enough for each pair.

    `launch()` only launches and lists the pairs left on the device, so a CUDA graph can capture it as it can `Query`'s.
    `result()` and `run()` wait for the device. Adding objects to the scene asks for a new cascade; changing its LODs
    does not. Making one builds a tree state for each model and rung, and one for each model at its finest LOD.

    Args:
        scene: `Scene` whose poses hold at the time of each launch.
        output, pairs, capacity, pair_capacity, precision, unsure_capacity: As `Query`; with pairs None the broad phase
            takes the boxes of the originals. Proofs hold at any precision.
        rungs: Shares of the faces to ask at, rising, each over 0 and under 1; () asks the originals at once.

    Attributes:
        rungs: The shares.
        lods: LOD of each model of the scene at each rung, the finest last, int (rungs + 1, models).
        hits, pairs, pair_count: As `Query`, entries in the order of the pairs asked.
        proof: Device arrays of what the rungs did (`kernels.cascade.Proof`).

    Raises:
        ValueError: Bad rungs or pairs, an unknown option, or states of more than 2^30 nodes.
    """

    def __init__(
        self,
        scene,
        output="any",
        pairs=None,
        rungs=RUNGS,
        capacity=None,
        pair_capacity=None,
        precision="exact",
        unsure_capacity=None,
    ):
        check_request(output, precision)
        self.rungs = check_rungs(rungs)
        if pairs is not None:
            pairs = scene.check_pairs(pairs)
        scene.arrays()
        self.device = scene.device
        self.lods = np.array(
            [[model.lod_for(fraction=share) for model in scene.models] for share in self.rungs]
            + [[model.lod_max for model in scene.models]]
        )
        standing = _stand(scene, self.lods)
        self._errors = [self._upload_errors(scene, lods) for lods in self.lods[:-1]]
        self._errors.append(wp.empty(0, dtype=wp.float64, device=scene.device))
        self._stages = [_Stage(self, posed, "any", within=0.0) for posed in standing[:-1]]
        self._stages.append(_Stage(self, standing[-1], output, precision=precision, capacity=1))
        self._list_counts = wp.zeros(len(self._stages), dtype=wp.int32, device=scene.device)
        self._lists = [cascade.PairList() for _ in self._stages]
        for k, (stage, open_pairs) in enumerate(zip(self._stages, self._lists, strict=True)):
            open_pairs.count = stage.pair_count = self._list_counts[k : k + 1]
        self.proof = cascade.Proof()
        super().__init__(standing[-1], output, pairs, capacity, pair_capacity, precision, None, unsure_capacity)
        for name in ("total", "unsure_total", "hard_total"):
            setattr(self._stages[-1].hits, name, getattr(self.hits, name))

    @staticmethod
    def _upload_errors(scene, lods):
        errors = np.array([model.error_at(lod) for model, lod in zip(scene.models, lods, strict=True)])
        return wp.array(errors[scene.object_model], dtype=wp.float64, device=scene.device)

    def _pair_arrays(self, room: int) -> list:
        made = super()._pair_arrays(room)
        device = self.device
        pair_poses = next(array for _, name, array in made if name == "pair_poses")
        within = wp.empty(room if self.rungs else 0, dtype=wp.float64, device=device)
        # One stage is at work at a time, so all share what only a launch needs.
        results = [("any_hit", wp.int32), *((name, wp.int64) for name in ("count", *COUNTERS))]
        shared = [(name, wp.zeros(room, dtype=dtype, device=device)) for name, dtype in results]
        for stage, open_pairs in zip(self._stages, self._lists, strict=True):
            pairs = wp.empty(room, dtype=wp.vec2i, device=device)
            made += [(stage, "pair_poses", pair_poses), (stage, "pairs", pairs), (open_pairs, "pair", pairs)]
            made.append((open_pairs, "origin", wp.empty(room, dtype=wp.int32, device=device)))
            made += [(stage, "within", within), (open_pairs, "within", within)]
            hits = stage.hits if stage.near is None else stage.near
            made += [(hits, name, array) for name, array in shared]
        made.append((self.proof, "rung", wp.zeros(room, dtype=wp.int32, device=device)))
        for name in ("node_tests", "triangle_tests"):
            made.append((self.proof, name, wp.zeros(room, dtype=wp.int64, device=device)))
        return made

    def _lend(self, stage):
        """Hand a stage how to run, and the lists that may have been made anew."""
        for name in ("cores", "parts_max", "stack_room"):
            setattr(stage, name, getattr(self, name))
        for name in ("face", "unsure", "hard"):
            if stage.near is None:
                setattr(stage.hits, name, getattr(self.hits, name))

    def prove_apart(self):
        """Ask every rung in turn for what those before it left open. Launches only."""
        room = len(self.pairs)
        if room == 0:
            return
        inputs = [len(self.rungs), self.pair_count, self.pairs, self._errors[0], self._list_counts]
        inputs += [self._lists[0], self.proof, self.hits]
        wp.launch(cascade.open_pair_kernel, dim=room, inputs=inputs, device=self.device)
        for rung, stage in enumerate(self._stages[:-1]):
            if not stage.has_pairs():
                return
            self._lend(stage)
            stage.prove_apart()
            inputs = [rung, self._lists[rung], stage.near, self._errors[rung + 1], self.proof, self._lists[rung + 1]]
            wp.launch(cascade.keep_pair_kernel, dim=room, inputs=inputs, device=self.device)

    def traverse(self):
        """Ask the originals of the pairs that are left, and put the answers in place. Launches only."""
        stage, asked = self._stages[-1], self._lists[-1]
        room = len(self.pairs)
        if room == 0 or not stage.has_pairs():
            return
        self._lend(stage)
        stage.traverse()
        inputs = [asked, stage.hits, self.hits]
        wp.launch(cascade.place_answer_kernel, dim=room, inputs=inputs, device=self.device)
        if len(self.hits.face):
            wp.launch(cascade.place_face_kernel, len(self.hits.face), inputs=[asked, self.hits], device=self.device)

    def result(self) -> CascadeResult:
        """Return the results of the last launch on the host, sorted. Waits for the device."""
        pairs, demand = self._asked()
        room, rung_count = len(self.pairs), len(self.rungs)
        return CascadeResult(pairs, self.output, demand, room, self.hits, self.proof, rung_count)


def intersect_originals(scene, pairs=None, output="any", precision="exact", rungs=RUNGS) -> CascadeResult:
    """Test the original meshes of object pairs for intersection, whatever LODs the objects stand at. Waits.

    Makes a `Cascade` for this one question, tree states included; keep one to ask again.

    Args:
        pairs: (p, 2) object indices; None takes the broad phase of the originals' boxes, sorted.
        output, precision, rungs: As `Cascade`.

    Raises:
        ValueError: As `Cascade`.
    """
    query = Cascade(scene, output, np.empty((0, 2), np.int32) if pairs is None else pairs, rungs, precision=precision)
    if pairs is None and scene.object_count > 1:
        query.set_pairs(BroadPhase(*query.arrays, scene.excluded_keys()).find())
    return cast(CascadeResult, query.run())
