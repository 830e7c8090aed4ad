"""Questions of one's own about face pairs: `FaceQuery`, and the Warp types and functions that a visit is written in."""

import ast
from typing import Any

import warp as wp
from warp.types import types_equal

from warp_abtree.checks.arguments import flag
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.distance.within import DISTANCE_HEADERS, Question, face_distance
from warp_abtree.query.operator import Operator
from warp_abtree.query.stage import Array, Rooms
from warp_abtree.query.stages.intersect import VisitStage
from warp_abtree.query.stages.traversal import Traversal

__all__ = ["FaceQuery", "PairPose", "Trees", "face_distance"]


class FaceStage(VisitStage):
    """Visit face pairs as what an operator is asked for; none is listed."""

    def attach(self, operator: Operator):
        """Take the operator, and give it the hits."""
        super().attach(operator)
        operator.hits, operator.traversal = self.hits, Traversal(self.operator, self.question.for_any)

    def arrays(self, rooms: Rooms) -> list[Array]:
        """Return those of visits and of the traversal, and an empty list."""
        traversal: Any = self.operator.traversal
        return [*super().arrays(rooms), *traversal.arrays(rooms), Array(self.hits, "face", wp.vec3i, 0)]


def _check_visit(visit, own):
    """Return the type of `own`; raise TypeError where a visit cannot be called with it."""
    given = getattr(own, "_cls", None)
    if given is None:
        raise TypeError(f"own: an instance of a Warp struct is expected, not a {type(own).__name__}")
    if not isinstance(visit, wp.Function):
        raise TypeError(f"visit: a Warp function (@wp.func) is expected, not a {type(visit).__name__}")
    asked = visit.input_types
    if len(asked) != 5:
        raise TypeError(f"visit {visit.key}: takes ({', '.join(asked)}), not (pair, faces, trees, pose, own)")
    known = [wp.int32, wp.vec2i, Trees, PairPose, given]
    for (name, kind), expected in zip(asked.items(), known):
        if kind is not Any and not types_equal(kind, expected):
            kinds = (getattr(k, "key", getattr(k, "__name__", k)) for k in (kind, expected))
            raise TypeError("visit {}: {} is a {}, given is a {}".format(visit.key, name, *kinds))
    native, source = visit.native_snippet is not None, visit.adj
    if not ("return" in source.arg_types if native else _returns(source.tree.body[0].body)):
        raise TypeError(f"visit {visit.key}: ends without a value; return a bool everywhere, whether the pair is a hit")
    return given


def _returns(body) -> bool:
    """Return whether each way through a block returns a value."""
    for line in body:
        if isinstance(line, ast.Return):
            return ast.unparse(line) not in ("return", "return None")
        if isinstance(line, ast.If) and _returns(line.body) and _returns(line.orelse):
            return True
        if isinstance(line, ast.While) and isinstance(line.test, ast.Constant):
            return True
    return False


class FaceQuery(Operator):
    """Visits of the face pairs that may be near, as an operator: allocates once, launches many times.

    Every face pair is visited that is not proved farther apart than a distance, once and in any order, by many threads
    at a time: what a visit writes must not depend on the order. The library's own proofs of `within` are such visits.

    Args:
        scene: `Scene` or `Batch` whose poses and LODs hold at the time of each launch.
        visit: Warp function (pair: int32, faces: vec2i, trees: `Trees`, pose: `PairPose`, own) -> bool, whether a face
            pair is a hit. `faces` are (of A, of B), A the object with the smaller index; the pair names B first where
            `pose.swapped` is 1. `face_distance(trees, pose, faces)` is their distance.
        own: Warp struct that visits are given. Its arrays may be written at any time, not replaced.
        pairs, capacity, sort_pairs: As for `Query`.
        within: Distances [world units], one for all pairs or (p,) beside given pairs.
        for_any: Whether one hit is enough: a pair is visited until there is one.

    Raises:
        TypeError: visit is no Warp function of these arguments, or does not always return a value; or own is no Warp
            struct of its last one's type.
        ValueError: Bad pairs or distances, an empty scene.
        RuntimeError: A graph is being captured.
    """

    def __init__(self, scene, visit, own: Any, pairs=None, within=0.0, for_any=False, capacity=None, sort_pairs=False):
        for_any = flag(for_any, "for_any")
        question = Question(visit, _check_visit(visit, own), for_any, DISTANCE_HEADERS)
        stage, output = FaceStage(within, question, own), "any" if for_any else "count"
        super().__init__(scene, [stage], pairs, capacity, output, sort_pairs)
