"""Contacts for Newton's solvers: `NewtonContacts` fills a `newton.Contacts` from meshes that are near or intersect.

Its `collide` stands in the place of that of a `newton.CollisionPipeline`: the poses of bodies are copied to a scene's
objects, `ManifoldQuery` finds the contact points, and these are written in Newton's conventions: points and offsets in
body frames, normals from the first shape to the second, contacts where shapes are nearer than both margins and gaps.
Everything stays on the device, in the order of pairs, and is deterministic. Pairs of which one is no mesh, and
particles, are passed to a pipeline of Newton's, whose contacts come first. Tested with Newton 1.8 (extra `newton`).
"""

from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.device_memory import DeviceMemory
from warp_abtree.checks.upload import struct_of
from warp_abtree.kernels.io import newton as kernels
from warp_abtree.model.model import Model
from warp_abtree.model.winding import keep_outside
from warp_abtree.query.request import CapacityError
from warp_abtree.query.stages.points import POINTS_MAX, ManifoldQuery
from warp_abtree.scene.scene import Scene
from warp_abtree.state.poses import IDENTITY_POSE

# Pairs of other shapes that there is room for by default.
OTHERS_MAX = 2**16
# Names that end those of Newton's arrays: `model.shape_gap` and so on, `contacts.rigid_contact_count` and so on.
SETTINGS, CONTACT_FIELDS = tuple(kernels.ShapeSettings.vars), tuple(kernels.RigidContacts.vars)


def pairs_between(rows, others):
    """Return all pairs of two lists of objects, (k, 2)."""
    return np.stack(np.meshgrid(rows, others, indexing="ij"), 2).reshape(-1, 2)


def same_body_pairs(body):
    """Return the pairs of objects of one body."""
    order = np.argsort(body, kind="stable")
    order = order[body[order] >= 0]
    parts = np.split(order, np.flatnonzero(np.diff(body[order])) + 1)
    return [pairs_between(part, part) for part in parts if len(part) > 1]


def groups_collide(a, b):
    """Return whether groups collide: positive ones with themselves and negative ones, those with others, 0 never."""
    return (a != 0) & (b != 0) & np.where((a > 0) & (b > 0), a == b, a != b)


def group_pairs(group, world):
    """Return the pairs of objects that may share a world, of groups that do not collide."""
    found = []
    if len(np.unique(group)) == 1 and group[0] > 0:
        return found
    for place in np.unique(world):
        here = np.flatnonzero((world == place) | (world < 0))
        names = np.unique(group[here]).tolist()
        for k, low in enumerate(names):
            for high in names[k:]:
                if not groups_collide(low, high):
                    found.append(pairs_between(here[group[here] == low], here[group[here] == high]))
    return found


def _filtered_pairs(model):
    """Return the pairs of shapes that a model filters, (k, 2)."""
    return np.array(sorted(model.shape_collision_filter_pairs), np.int64).reshape(-1, 2)


def _excluded_pairs(model, shapes):
    """Return the object pairs that Newton never tests: filtered, of one body, or of groups that do not collide."""
    object_of = np.full(int(model.shape_count), -1)
    object_of[shapes] = np.arange(len(shapes))
    group, world = (values.numpy()[shapes] for values in (model.shape_collision_group, model.shape_world))
    bodies = same_body_pairs(model.shape_body.numpy()[shapes])
    pairs = np.concatenate([object_of[_filtered_pairs(model)], *bodies, *group_pairs(group, world)])
    pairs = np.sort(pairs, axis=1)
    return np.unique(pairs[(pairs[:, 0] >= 0) & (pairs[:, 0] < pairs[:, 1])], axis=0)


def _other_pairs(model, is_mesh, collide):
    """Return the pairs of shapes that collide and are not both meshes, as Newton's own list has, (k, 2), sorted."""
    names = ("shape_body", "shape_collision_group", "shape_world")
    body, group, world = (np.asarray(getattr(model, name).numpy(), np.int64) for name in names)
    found = [np.empty((0, 2), np.int64)]
    for place in np.unique(world[collide & ~is_mesh]):
        rows = np.flatnonzero(collide & ~is_mesh & (world == place))
        here = collide if place < 0 else collide & ((world == place) | (world < 0))
        found.append(pairs_between(rows, np.flatnonzero(here)))
    pairs = np.sort(np.concatenate(found), axis=1)
    low, high = np.maximum(body[pairs], -1).T
    pairs, count = pairs[groups_collide(*group[pairs].T) & (low != high)], int(model.shape_count)
    keys = np.setdiff1d(pairs @ [count, 1], np.sort(_filtered_pairs(model), axis=1) @ [count, 1])
    return np.stack(np.divmod(keys, count), 1).astype(np.int32)


def _find_solids(shapes, solids):
    """Return whether each mesh shape is a solid, of what `NewtonContacts` takes for it."""
    if isinstance(solids, bool):
        return solids
    solids = np.asarray(solids).reshape(-1)
    if len(solids) and solids.dtype.kind not in "iu":  # a mask would be read as indices 0 and 1
        raise ValueError(f"solids: {solids.tolist()} is neither a bool nor indices of shapes")
    others = np.setdiff1d(solids, shapes)
    if len(others):
        raise ValueError(f"solids: shape {others[0]} is no mesh that collides")
    return np.isin(shapes, solids)


class NewtonContacts(DeviceMemory):
    """Contacts of Newton's mesh shapes: allocates once, collides many times.

    Read at every call: poses of bodies, `shape_transform`, and what Newton's own pipeline reads of shapes that are no
    meshes. Read once: meshes (`shape_source`), `shape_scale`, `shape_margin` and `shape_gap` of mesh shapes, and of all
    shapes `shape_type`, `shape_body`, `shape_world`, `shape_collision_group`, `shape_flags` and
    `shape_collision_filter_pairs`. Where these are others than they were, `collide` and `check` raise RuntimeError.
    What a mesh changes in place, such as its vertices, is not noticed. A captured graph reads the arrays that it was
    captured with: change `shape_transform` in place.

    Contacts that have match indices (`newton.Contacts(contact_matching=True)`, as those of `contacts` have where all
    shapes are meshes) are told which contact of their last contents each is, for solvers that warm start by these;
    `remember` must be on. Contacts of Newton's own pipeline count as new ones.

    Args:
        model: `newton.Model`.
        models: `Model` by shape index, to replace the shape's mesh, for example by one built before; in the shape's
            frame, scaled. Shapes of one mesh and scale share a model.
        capacity: As for `ManifoldQuery`; `collide` makes more room, `launch` does not.
        points: Most points of a pair, as for `ManifoldQuery`: 8 hold up what rests, nested parts such as a nut on its
            bolt want 32.
        solids: Mesh shapes that are solids, by index, or True for all: what lies inside one has points as deep as it
            is far from the surface, also once no face crosses. Of closed models, see `Scene.add`.
        remember: As for `ManifoldQuery`: pairs that hardly move are not searched again. `query.forget()` where the
            contacts are not to depend on the calls before, such as at the start of an episode.
        originals: As for `ManifoldQuery`: points on the shapes' own meshes, of a scene at coarser LODs.

    Attributes:
        scene: `Scene` of the shapes, at their finest LODs; `scene.set_lods` changes these.
        shapes: Newton's shape of each object, int32 (n,).
        query: `ManifoldQuery`.
        others: `newton.CollisionPipeline` of pairs of which one is no mesh, and particles; None without, or before use.

    Raises:
        ImportError: Newton is not installed.
        ValueError: Fewer than two mesh shapes; a mesh whose surface moves (`enable_surface_velocity`); or a solid or a
            key of `models` that is no index of a mesh shape.
        MeshError: A solid whose mesh is not closed; the message names edges.
    """

    def __init__(
        self, model, models=None, capacity=None, points=POINTS_MAX, solids=False, remember=True, originals=False
    ):
        import newton

        self.newton = newton
        self.model = model
        self.device = model.device
        kind, flags = model.shape_type.numpy(), model.shape_flags.numpy()
        collide = (flags & int(newton.ShapeFlags.COLLIDE_SHAPES)) != 0
        is_mesh = (kind == int(newton.GeoType.MESH)) & collide
        found = np.flatnonzero(is_mesh)
        if len(found) < 2:
            raise ValueError(f"the model has {len(found)} shapes that are meshes and collide, not two")
        self.shapes = found.astype(np.int32)
        self.scene = Scene(str(self.device))
        static, world = model.shape_body.numpy()[found] < 0, model.shape_world.numpy()[found]
        inside = _find_solids(found, solids)
        own = self._find_models(found.tolist(), models or {})
        self.scene.add_many(own, [IDENTITY_POSE] * len(found), worlds=world, statics=static, solids=inside)
        self.scene.filter(_excluded_pairs(model, self.shapes))
        self._pairs_of_others = _other_pairs(model, is_mesh, collide)
        self._has_others = len(self._pairs_of_others) > 0 or model.particle_count > 0
        self.others: Any = None
        reach = np.zeros((len(found), 4))
        reach[:, 3] = (model.shape_margin.numpy() + model.shape_gap.numpy())[found]
        bad = found[~(np.isfinite(reach[:, 3]) & (reach[:, 3] >= 0))]
        if len(bad):
            raise ValueError(f"gap: margin and gap of shape {bad[0]} make no finite distance of 0 or more")
        self._ids = wp.array(self.shapes, dtype=wp.int32, device=self.device)
        self._no_body = wp.empty(0, dtype=wp.transform, device=self.device)
        self._keep_settings()
        self._place(model.body_q)
        gap = wp.array(reach, dtype=wp.vec4d, device=self.device)
        self.query = ManifoldQuery(
            self.scene, None, capacity, gap=gap, points=points, remember=remember, originals=originals
        )
        self._first = wp.zeros(1, dtype=wp.int32, device=self.device)
        zeros = {name: [0] for name in ("buffer", "written", "generation", "written_generation")}
        self._matching, self._written = struct_of(kernels.Matching, self.device, **zeros), None
        self._grow()

    def _find_models(self, shapes, given):
        """Return the model of each shape; shapes of one mesh and scale share theirs."""
        known, scale, models = {}, self.model.shape_scale.numpy(), []
        for shape in given:
            if shape not in shapes:
                raise ValueError(f"models: {shape!r} is no index of a mesh shape that collides; these are {shapes}")
        for shape in shapes:
            source = self.model.shape_source[shape]
            if getattr(source, "enable_surface_velocity", False):
                raise ValueError(f"the surface of shape {shape} moves (enable_surface_velocity): not supported")
            key, own = (id(source), tuple(scale[shape].tolist())), given.get(shape)
            if own is None and key not in known:
                vertices = np.asarray(source.vertices, np.float64) * scale[shape]
                faces = np.asarray(source.indices).reshape(-1, 3)
                faces = keep_outside(faces, np.diag(scale[shape]))
                known[key] = Model.from_arrays(vertices, faces, name=f"shape {shape}")
            models.append(known[key] if own is None else own)
        return models

    def _keep_settings(self):
        """Keep what is read once, for `_refuse_changes`."""
        self._sources, self._filters = list(self.model.shape_source), self.model.shape_collision_filter_pairs
        self._filter_count = len(self._filters)
        own = np.zeros(int(self.model.shape_count), np.int32)
        own[self.shapes] = 1
        self._is_own = wp.array(own, dtype=wp.int32, device=self.device)
        self._changed = wp.full(1, len(own), dtype=wp.int32, device=self.device)
        self._kept = self._settings(wp.clone)

    def _settings(self, take=lambda array: array):
        """Return what `take` makes of the settings of all shapes."""
        arrays = {name: take(getattr(self.model, f"shape_{name}")) for name in SETTINGS}
        return struct_of(kernels.ShapeSettings, self.device, **arrays)

    def _refuse_changes(self):
        """Raise where settings are others than they were. Waits for the device."""
        # Not within `launch`: a graph would go on with arrays that others have replaced.
        now = self._settings()
        inputs = [int(self.newton.ShapeFlags.COLLIDE_SHAPES), self._is_own, self._kept, now, self._changed]
        wp.launch(kernels.find_changed_kernel, len(self._is_own), inputs, device=self.device)
        what, shape = "", int(self._changed.numpy()[0])
        filters = self.model.shape_collision_filter_pairs
        if shape < len(self._is_own):
            self._changed.fill_(len(self._is_own))
            both = [[getattr(these, name).numpy()[shape].tolist() for name in SETTINGS] for these in (now, self._kept)]
            names = [f"shape_{name}" for name, a, b in zip(SETTINGS, *both) if a != b]
            what = f"{', '.join(names) or 'settings'} of shape {shape}"
        elif self.model.shape_source != self._sources:
            what = "shape_source"
        elif len(filters) != self._filter_count or (filters is not self._filters and filters != self._filters):
            what = "shape_collision_filter_pairs"
        if what:
            raise RuntimeError(f"{what} changed since NewtonContacts read it, once; make a new one")

    def _grow(self):
        room = len(self.query.pairs)
        self._count, self._end = (wp.zeros(room, dtype=wp.int32, device=self.device) for _ in range(2))
        matching, before = self._matching, self._matching.start
        matching.start, matching.next_start = (wp.zeros(room, dtype=wp.int32, device=self.device) for _ in range(2))
        if before is not None:
            wp.copy(matching.start, before, count=min(room, len(before)))

    def contacts(self, rigid_contact_max=None):
        """Return an empty `newton.Contacts`; by default with room for all points of each pair."""
        room, others = rigid_contact_max, min(len(self._pairs_of_others), OTHERS_MAX)
        if room is None:
            room = self.query.point_max * len(self.query.pairs) + POINTS_MAX * others
        if not self._has_others:
            matching = self.query.memory is not None
            asked = self.model.get_requested_contact_attributes()
            return self.newton.Contacts(
                room, 0, device=self.device, requested_attributes=asked, contact_matching=matching
            )
        self._make_others(room)
        return self.others.contacts()

    def _make_others(self, room):
        """Make the pipeline of what is not two meshes, for contacts of some size."""
        pairs = wp.array(self._pairs_of_others, dtype=wp.vec2i, device=self.device)
        self.others = self.newton.CollisionPipeline(
            self.model,
            broad_phase="explicit",
            shape_pairs_filtered=pairs,
            rigid_contact_max=room,
            deterministic=self.device.is_cuda,  # the CPU has one order anyway
        )

    def _fits(self, contacts):
        return not self._has_others or (
            self.others is not None and self.others.rigid_contact_max == len(contacts.rigid_contact_shape0)
        )

    def collide(self, state, contacts):
        """Replace the contents of `contacts` by the contacts at a state's poses, see `check`.

        Waits for the device. While a graph is captured it does no more than `launch`.
        """
        if self.device.is_capturing:
            self.launch(state, contacts)
            return
        if not self._fits(contacts):
            self._make_others(len(contacts.rigid_contact_shape0))
        self._place(state.body_q)
        self.query.grow()
        if len(self._count) != len(self.query.pairs):
            self._grow()
        self._write(state, contacts)
        self.check(contacts)

    def launch(self, state, contacts):
        """Do the same within the present capacity. Launches only, after a `collide`, so that a graph can capture it.

        Raises:
            ValueError: `contacts` have another size than those of `collide`, where Newton's own pipeline is needed.
        """
        if not self._fits(contacts):
            raise ValueError("contacts have another size than those of the last collide()")
        with self.query.guard.launching(self):
            self._place(state.body_q)
            self.query.launch()
            self._write(state, contacts)

    def check(self, contacts):
        """Raise an error if the last contacts did not fit. Waits for the device.

        Raises:
            CapacityError: The message names the demand.
            RuntimeError: The model's shapes are others than those read at first, see the class.
        """
        self._refuse_changes()
        found = int(contacts.rigid_contact_count.numpy()[0])
        room = len(contacts.rigid_contact_shape0)
        if found > room:
            raise CapacityError(f"{found} rigid contacts, newton.Contacts has room for {room}")
        self.query.result(with_points=False).check()

    def _place(self, body_q):
        body_q = self._no_body if body_q is None else body_q
        inputs = [self._ids, body_q, self.model.shape_body, self.model.shape_transform, self.scene.batch().objects.pool]
        wp.launch(kernels.pose_object_kernel, len(self.shapes), inputs, device=self.device)

    def _write(self, state, contacts):
        # Contacts of Newton 1.6 have match indices without generations: all of them stay new ones.
        matches = self.query.memory is not None and hasattr(contacts, "rigid_contact_match_generation")
        index = contacts.rigid_contact_match_index if matches else None
        if index is not None:
            wp.copy(self._matching.generation, contacts.contact_generation)
        if self.others is None:
            contacts.clear()
        else:
            self.others.collide(state, contacts)
        wp.copy(self._first, contacts.rigid_contact_count, count=1)
        arrays = {name: getattr(contacts, f"rigid_contact_{name}") for name in CONTACT_FIELDS}
        rigid = struct_of(kernels.RigidContacts, self.device, **arrays)
        query, room = self.query, len(self._count)
        body_q = self._no_body if state.body_q is None else state.body_q
        inputs = [query.pair_batch, query.manifolds, self._count]
        wp.launch(kernels.count_point_kernel, room, inputs, device=self.device)
        with wp.ScopedDevice(self.device):
            wp.utils.array_scan(self._count, self._end, inclusive=True)
        inputs = [self._first, self.model.shape_margin, self._ids, body_q, self.model.shape_body]
        inputs += [query.pair_batch, query.manifolds, self._end, self._count, rigid]
        wp.launch(kernels.write_contact_kernel, room, inputs, device=self.device)
        self._match(contacts, index)

    def _match(self, contacts, index):
        """Write which contacts are those of the launch before, where these have match indices."""
        matching = self._matching
        if index is None:
            matching.buffer.zero_()
            return
        query, room = self.query, len(self._count)
        memory: Any = query.memory
        matching.row, matching.launches = memory.row, memory.memory.launches
        # Held, so that no other buffer gets its address.
        self._written = contacts.rigid_contact_shape0
        buffer = self._written.ptr
        inputs = [buffer, self._first, query.pair_batch, query.manifolds, self._end, self._count, matching, index]
        inputs.append(contacts.rigid_contact_match_generation)
        wp.launch(kernels.match_contact_kernel, room, inputs, device=self.device)
        inputs = [buffer, contacts.contact_generation, matching]
        wp.launch(kernels.keep_start_kernel, room, inputs, device=self.device)
