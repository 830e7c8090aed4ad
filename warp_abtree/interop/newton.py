"""Contacts for Newton's solvers: `NewtonContacts` fills a `newton.Contacts` from intersecting meshes.

Replace `model.collide(state, contacts)` by `collide` here: the poses of bodies are copied to a scene's objects,
`ManifoldQuery` finds the contact points, and these are written in Newton's conventions: shapes, points and offsets in
body frames, normals from the first shape to the second, margins. Everything stays on the device, in the order of pairs,
and is deterministic.

Only intersecting meshes have contacts, so Newton's `gap` is ignored: there are no contacts ahead of touch. Depths and
normals are those of `warp_abtree.query.manifold`. Soft contacts are not changed. Tested with Newton 1.8 (extra
`newton`), which calls its contacts experimental.
"""

import numpy as np
import warp as wp

from warp_abtree.kernels import newton as kernels
from warp_abtree.model.model import Model
from warp_abtree.query.manifold import POINTS_MAX, ManifoldQuery
from warp_abtree.query.request import CapacityError
from warp_abtree.scene.scene import Scene

FIELDS = ("shape0", "shape1", "point0", "point1", "offset0", "offset1", "normal", "margin0", "margin1")


def _excluded_pairs(model, shapes):
    """Return the object pairs that Newton never tests: filtered, of one body, or of groups that do not collide."""
    i, j = np.triu_indices(len(shapes), 1)
    a, b = shapes[i], shapes[j]
    body = model.shape_body.numpy()
    group = model.shape_collision_group.numpy()
    low, high = np.minimum(group[a], group[b]), np.maximum(group[a], group[b])
    # Positive groups collide with themselves and negative ones, negative ones with all but themselves, 0 with none.
    collide = (low != 0) & (high != 0) & np.where(low > 0, low == high, low != high)
    filtered = {tuple(sorted(pair)) for pair in model.shape_collision_filter_pairs}
    listed = np.array([tuple(sorted(pair)) in filtered for pair in zip(a.tolist(), b.tolist())], bool)
    excluded = ~collide | listed | ((body[a] == body[b]) & (body[a] >= 0))
    return np.stack([i, j], axis=1)[excluded]


class NewtonContacts:
    """Contacts of Newton's mesh shapes: allocates once, collides many times.

    Args:
        model: `newton.Model`. Shapes that are no meshes are ignored, with their contacts.
        models: `Model` by shape index, to replace the shape's mesh, for example by one built before; in the shape's
            frame, scaled. Shapes of one mesh and scale share a model.
        capacity: As for `ManifoldQuery`; `collide` makes more room, `launch` does not.

    Attributes:
        scene: `Scene` of the shapes, at their finest LODs; `scene.set_lods` changes these.
        shapes: Newton's shape of each object, int32 (n,).
        query: `ManifoldQuery`.

    Raises:
        ImportError: Newton is not installed.
        ValueError: Fewer than two mesh shapes.
    """

    def __init__(self, model, models=None, capacity=None):
        import newton

        self.newton = newton
        self.model = model
        self.device = model.device
        kind, flags = model.shape_type.numpy(), model.shape_flags.numpy()
        collide = (flags & int(newton.ShapeFlags.COLLIDE_SHAPES)) != 0
        found = np.flatnonzero((kind == int(newton.GeoType.MESH)) & collide)
        if len(found) < 2:
            raise ValueError(f"the model has {len(found)} shapes that are meshes and collide, not two")
        self.shapes = found.astype(np.int32)
        self.scene = Scene(str(self.device))
        scale, body, world = model.shape_scale.numpy(), model.shape_body.numpy(), model.shape_world.numpy()
        known = {}
        for shape in found.tolist():
            source = model.shape_source[shape]
            own = None if models is None else models.get(shape)
            if own is None:
                key = (id(source), tuple(scale[shape].tolist()))
                if key not in known:
                    vertices = np.asarray(source.vertices, np.float64) * scale[shape]
                    known[key] = Model.from_arrays(vertices, np.asarray(source.indices).reshape(-1, 3))
                own = known[key]
            self.scene.add(own, world=int(world[shape]), static=bool(body[shape] < 0))
        self.scene.filter(_excluded_pairs(model, self.shapes))
        self._ids = wp.array(self.shapes, dtype=wp.int32, device=self.device)
        self._no_body = wp.empty(0, dtype=wp.transform, device=self.device)
        self._place(model.body_q)
        self.query = ManifoldQuery(self.scene, None, capacity)
        self._grow()

    def _grow(self):
        room = len(self.query.pairs)
        self._count = wp.zeros(room, dtype=wp.int32, device=self.device)
        self._end = wp.zeros(room, dtype=wp.int32, device=self.device)

    def contacts(self, rigid_contact_max=None):
        """Return an empty `newton.Contacts` for rigid contacts; by default with room for 8 of each pair."""
        room = POINTS_MAX * len(self.query.pairs) if rigid_contact_max is None else rigid_contact_max
        return self.newton.Contacts(room, 0, device=self.device)

    def collide(self, state, contacts):
        """Replace the contents of `contacts` by the contacts at a state's poses, see `check`. Waits for the device."""
        self._place(state.body_q)
        self.query.grow()
        if len(self._count) != len(self.query.pairs):
            self._grow()
        self._write(state.body_q, contacts)
        self.check(contacts)

    def launch(self, state, contacts):
        """Do the same within the present capacity. Launches only, so that a CUDA graph can capture it."""
        with self.query.guard.launching(self):
            self._place(state.body_q)
            self.query.launch()
            self._write(state.body_q, contacts)

    def check(self, contacts):
        """Raise an error if the last contacts did not fit. Waits for the device.

        Raises:
            CapacityError: The message names the demand.
        """
        found = int(contacts.rigid_contact_count.numpy()[0])
        room = len(contacts.rigid_contact_shape0)
        if found > room:
            raise CapacityError(f"{found} rigid contacts, newton.Contacts has room for {room}")
        self.query.result().check()

    def _place(self, body_q):
        body_q = self._no_body if body_q is None else body_q
        inputs = [self._ids, body_q, self.model.shape_body, self.model.shape_transform, self.scene.batch().objects.pool]
        wp.launch(kernels.pose_object_kernel, len(self.shapes), inputs, device=self.device)

    def _write(self, body_q, contacts):
        contacts.clear()
        rigid = kernels.RigidContacts()
        rigid.count = contacts.rigid_contact_count
        for name in FIELDS:
            setattr(rigid, name, getattr(contacts, f"rigid_contact_{name}"))
        query, room = self.query, len(self._count)
        body_q = self._no_body if body_q is None else body_q
        inputs = [query.pair_count, query.manifolds, self._count]
        wp.launch(kernels.count_point_kernel, room, inputs, device=self.device)
        with wp.ScopedDevice(self.device):
            wp.utils.array_scan(self._count, self._end, inclusive=True)
        inputs = [self.model.shape_margin, self._ids, body_q, self.model.shape_body]
        inputs += [query.pairs, query.manifolds, self._end, self._count, rigid]
        wp.launch(kernels.write_contact_kernel, room, inputs, device=self.device)
