"""Queries that `Scene.intersect` makes, one of each kind, and keeps for the next time."""

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import to_numpy
from warp_abtree.checks.kernel_loading import loading, of_first_query
from warp_abtree.kernels.base.nodes import clear_node_kernel
from warp_abtree.kernels.intersect.broad_phase import pose_box_kernel
from warp_abtree.kernels.io.place_poses import pose_setter
from warp_abtree.query.broad_phase import BroadPhase
from warp_abtree.query.contacts import ContactQuery
from warp_abtree.query.distance import DistanceQuery, check_beyond, check_flags, check_tolerances, prepare_query
from warp_abtree.query.narrow_phase import Query
from warp_abtree.query.request import check_request, check_within, refuse_options, refuse_signed
from warp_abtree.query.result import Result
from warp_abtree.scene.first_contact import FirstContactQuery, check_path
from warp_abtree.state.batch import Batch
from warp_abtree.state.work_lists import update_kernels


def scene_kernels(device, face_counts, with_broad_phase: bool) -> list:
    """Return the kernels that make tree states, poses and object pairs of a scene, with block sizes; see `loading`."""
    kernels = [pose_box_kernel] if with_broad_phase else []
    kernels += [clear_node_kernel, pose_setter(wp.float64, 7)]
    return [*update_kernels(face_counts, device), *[(kernel, 256) for kernel in kernels]]


@of_first_query
def yes_or_no_kernels(device, face_counts) -> list:
    """Return the kernels of a scene's first `intersect`, as `loading` takes them."""
    return [*Query.kernels(device, "any", "exact", False, False), *scene_kernels(device, face_counts, True)]


class KeptQueries:
    """Queries of a scene, by what they are asked.

    Args:
        scene: `Scene` that they are about.
        find_pairs: Returns given pairs, checked, or where None those of the broad phase up to a distance.

    Attributes:
        kept: The queries, by what they answer.
    """

    def __init__(self, scene, find_pairs: Callable[[Any, float], np.ndarray]):
        self._scene, self._find_pairs = scene, find_pairs
        self.kept: dict[tuple, Query] = {}
        self._finest: tuple[Batch, BroadPhase] | None = None

    def clear(self):
        """Forget all queries."""
        self.kept.clear()
        self._finest = None

    def find_hits(self, pairs, output, precision, contact_dtype, options: dict, device: bool) -> Result:
        """Answer any output but "distance"; options are those that are given, `Scene.intersect` has them."""
        with_contacts, taken = output == "contacts", ("within", "gap") if output == "contacts" else ("within",)
        refuse_options(output, {name: True for name in options if name not in taken})
        check_request("faces" if with_contacts else output, precision)
        reach = max((self._one_for_all(options[name], name) for name in options), default=0.0)
        key = output, precision, *sorted(options)
        if key not in self.kept:
            kind, told = (ContactQuery, "faces") if with_contacts else (Query, output)
            self._load(kind, pairs is None, told, precision, "gap" in options, "within" in options)
        pairs = self._find_pairs(pairs, reach)
        given = {name: check_within(value, len(pairs), name) for name, value in options.items()}
        within, gap = given.get("within"), given.get("gap")
        query = self.kept.pop(key, None)
        if query is not None:
            if not query.is_asked(pairs, within, gap):
                query.replace_pairs(pairs, within, gap)
        elif with_contacts:
            query = ContactQuery(self._scene, pairs=pairs, precision=precision, within=within, gap=gap)
        else:
            query = Query(self._scene, output, pairs=pairs, precision=precision, within=within)
        if isinstance(query, ContactQuery):
            query.contact_dtype = contact_dtype
        return self._run(key, query, device)

    def find_distances(self, pairs, options: dict, device: bool) -> Result:
        """Answer "distance"; options as for `find_hits`."""
        refuse_options("distance", {name: True for name in options if name in ("within", "gap")})
        signed, of_originals = check_flags(options)
        tolerances = {name: value for name, value in options.items() if name in ("tolerance", "relative")}
        check_tolerances(**tolerances)
        beyond = options.get("beyond")
        reach = 0.0 if beyond is None else self._one_for_all(beyond, "beyond")
        asked, given = self._scene, pairs
        if of_originals:
            asked, broad_phase = self._find_finest()
            # Originals may lie out of the boxes of their LODs.
            pairs = broad_phase.find(reach) if pairs is None else pairs
        elif ("distance", signed, of_originals) not in self.kept:
            self._load(DistanceQuery, pairs is None, "any", "exact", False, False)
        pairs = self._find_pairs(pairs, reach)
        if signed:
            batch = self._scene.batch()
            refuse_signed(signed, batch.has_solid(None if given is None else pairs))
            signed = batch.has_solid(pairs)  # the broad phase may have found surfaces alone
        key, beyond = ("distance", signed, of_originals), check_beyond(beyond, len(pairs))
        query = prepare_query(self.kept.pop(key, None), asked, pairs, beyond, tolerances, signed)
        return self._run(key, query, device)

    def _find_finest(self) -> tuple[Batch, BroadPhase]:
        """Return the objects at their finest LODs, as posed, with tree states that are made once; and their pairs."""
        batch = self._scene.batch()
        if self._finest is None:
            finest = batch.with_own_states(follows_poses=True)
            finest.add_finest(range(len(finest.models.lod_max)))
            self._finest = finest, BroadPhase(finest)
        finest, _ = self._finest
        if finest.excluded is not batch.excluded:
            finest.exclude(batch.excluded)
            self._finest = finest, BroadPhase(finest)
        return self._finest

    def find_first_contacts(self, pairs, end_poses, tolerance, screw, linear, device: bool) -> Result:
        """Answer `Scene.first_contact`; pairs are checked."""
        check_path(screw, linear)
        key = "first contact", bool(linear), pairs is None
        query = self.kept.pop(key, None)
        if isinstance(query, FirstContactQuery):
            query.set_options(tolerance, screw)
            query.set_end_poses(end_poses)
            if pairs is not None and not query.is_asked(pairs, None):
                query.replace_pairs(pairs, None)
        else:
            query = FirstContactQuery(self._scene, end_poses, pairs, tolerance=tolerance, screw=screw, linear=linear)
        return self._run(key, query, device)

    @staticmethod
    def _one_for_all(distance, name: str) -> float:
        """Return a distance that is one for all pairs, checked; 0 where each pair has its own."""
        distance = to_numpy(distance, name)
        return float(check_within(distance, name=name)) if distance.ndim == 0 else 0.0

    def _load(self, kind, with_broad_phase: bool, *request):
        """Load what the first query of a kind launches, all at the same time: from the tree states to the answers."""
        scene = self._scene
        if not scene.object_count:
            return
        with_states = scene_kernels(scene.device, [model.face_count for model in scene.models], with_broad_phase)
        with loading(scene.device, [*kind.kernels(scene.device, *request), *with_states]):
            pass

    def _run(self, key: tuple, query: Query, device: bool) -> Result:
        """Run a query and keep it for the next time; one that fails, for lack of memory, gives its own back."""
        result = query.run(device)
        self.kept[key] = query
        return result
