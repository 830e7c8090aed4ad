"""Queries that `Scene.intersect` makes, one of each kind, and keeps for the next time."""

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import to_numpy
from warp_abtree.checks.kernel_loading import loading, of_first_query
from warp_abtree.kernels.base.nodes import clear_node_kernel
from warp_abtree.kernels.io.place_poses import pose_setter
from warp_abtree.query.broad_phase import broad_phase_kernels
from warp_abtree.query.operator import Operator
from warp_abtree.query.readout import operator_kernels
from warp_abtree.query.request import SCENE_OPTIONS, check_options, check_within, refuse_signed
from warp_abtree.query.result import Result
from warp_abtree.query.stages.contacts import ContactQuery
from warp_abtree.query.stages.distance import DistanceQuery, check_beyond, check_distance_options
from warp_abtree.query.stages.intersect import Query
from warp_abtree.query.stages.motion import FirstContactQuery
from warp_abtree.query.stages.originals import Originals
from warp_abtree.state.work_lists import update_kernels


def scene_kernels(device, face_counts, with_broad_phase: bool) -> list:
    """Return the kernels that make tree states, poses and object pairs of a scene, with block sizes; see `loading`."""
    found = broad_phase_kernels(device) if with_broad_phase else []
    return [*update_kernels(face_counts, device), *found, (clear_node_kernel, 256), (pose_setter(wp.float64, 7), 256)]


@of_first_query
def yes_or_no_kernels(device, face_counts) -> list:
    """Return the kernels of a scene's first `intersect`, as `loading` takes them."""
    return [*operator_kernels(device, Query.plan("any"), "any"), *scene_kernels(device, face_counts, True)]


# Operators by output, and what they are told of a question beside its distances; `Query` answers all others.
OPERATORS: dict[str, tuple[Any, tuple]] = {"contacts": (ContactQuery, ("precision",)), "distance": (DistanceQuery, ())}
OF_HITS = Query, ("output", "precision")


class KeptQueries:
    """Operators of a `Scene`, kept by what they are asked.

    `find_pairs` returns given pairs, checked, or where None those of the broad phase up to a distance.
    """

    def __init__(self, scene, find_pairs: Callable[[Any, float], np.ndarray]):
        self._scene, self._find_pairs = scene, find_pairs
        self.kept: dict[tuple, Any] = {}
        self._last: tuple = (), ()  # question of `find`, and the key of the operator that is asked it
        self._originals: Originals | None = None

    def clear(self):
        """Forget all operators."""
        self.kept.clear()
        self._originals = None

    def find(self, pairs, output, precision, contact_dtype, options: dict, device: bool) -> Result:
        """Answer `Scene.intersect`; a question without options that repeats the last one is not checked again."""
        question: tuple = ()
        if type(pairs) is np.ndarray and all(value is None for value in options.values()):
            if isinstance(output, str) and isinstance(precision, str):
                question = output, precision, pairs.dtype, pairs.shape, pairs.tobytes()
        last, key = self._last
        query = self.kept.pop(key, None) if question and question == last else None
        if query is None:
            self._last = (), ()
            key, query = self._take(pairs, output, precision, options)
            self._last = question, key
        if isinstance(query, ContactQuery):
            query.contact_dtype = contact_dtype
        return self._run(key, query, device)

    def _take(self, pairs, output, precision, options: dict) -> tuple[tuple, Operator]:
        """Return the operator that is to answer a question, with its key, taken out of those kept."""
        given = check_options(SCENE_OPTIONS, output, precision, options)
        tolerances, signed, of_originals = check_distance_options(given) if output == "distance" else ({}, False, False)
        distances = {name: to_numpy(given[name], name) for name in ("within", "gap", "beyond") if name in given}
        # One for all pairs widens the boxes of the broad phase.
        ones = [float(check_within(value, name=name)) for name, value in distances.items() if value.ndim == 0]
        reach, asked, found = max(ones, default=0.0), self._scene, pairs
        key = output, precision, of_originals, *sorted({*distances} - {"beyond"})
        kind, names = OPERATORS.get(output, OF_HITS)
        told: dict = {name: value for name, value in (("output", output), ("precision", precision)) if name in names}
        if of_originals:
            originals = self._find_originals()
            asked, found = originals.batch, originals.broad_phase.find(reach) if pairs is None else pairs
        elif (*key, signed) not in self.kept:
            stages = kind.plan(**told, **{name: given[name] for name in ("within", "gap") if name in given})
            self._load(stages, output, pairs is None)
        found = self._find_pairs(found, reach)
        checked = {name: check_within(value, len(found), name) for name, value in distances.items()}
        if output == "distance":
            checked["beyond"] = check_beyond(given.get("beyond"), len(found))
            if signed:
                batch = self._scene.batch()
                refuse_signed(signed, batch.has_solid(None if pairs is None else found))
                signed = batch.has_solid(found)  # the broad phase may have found surfaces alone
            told["signed"] = signed
        key = *key, signed
        query = self.kept.pop(key, None)
        if query is None:
            query = kind(asked, pairs=found, **told, **checked, **tolerances)
        else:
            if isinstance(query, DistanceQuery):
                query.set_tolerance(**tolerances)
            if not query.is_asked(found, **checked):
                query.replace_pairs(found, **checked)
        return key, query

    def _find_originals(self) -> Originals:
        if self._originals is None:
            self._originals = Originals(self._scene.batch())
        self._originals.follow_filter()
        return self._originals

    def find_first_contacts(self, pairs, end_poses, tolerance, screw, linear, device: bool) -> Result:
        """Answer `Scene.first_contact`; pairs are checked."""
        FirstContactQuery.plan(tolerance, screw, linear)  # checks them
        key = "first contact", bool(linear), pairs is None
        query = self.kept.pop(key, None)
        if query is None or query.is_filtered():
            query = FirstContactQuery(self._scene, end_poses, pairs, tolerance=tolerance, screw=screw, linear=linear)
        else:
            query.set_options(tolerance, screw)
            query.set_end_poses(end_poses)
            if pairs is not None and not query.is_asked(pairs):
                query.replace_pairs(pairs)
        return self._run(key, query, device)

    def _load(self, stages: list, output: str, with_broad_phase: bool):
        """Load what a first query launches, all at the same time: from the tree states to the answers."""
        scene, output = self._scene, "faces" if output == "contacts" else output
        if scene.object_count:
            kernels = scene_kernels(scene.device, [model.face_count for model in scene.models], with_broad_phase)
            with loading(scene.device, [*operator_kernels(scene.device, stages, output), *kernels]):
                pass

    def _run(self, key: tuple, query: Operator, device: bool) -> Result:
        """Run an operator and keep it for the next time; one that fails, for lack of memory, gives its own back."""
        result = query.run(device)
        self.kept[key] = query
        return result
