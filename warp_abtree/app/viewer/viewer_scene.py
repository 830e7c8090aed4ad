"""The scene of the viewer in the browser: only what changed is sent."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_abtree.app import scene_geometry as geometry
from warp_abtree.app.render_data import LABELS, RenderData
from warp_abtree.app.styles import BOX_COLOUR, COLOURS, CONTACT_COLOUR, NEAREST_COLOUR, SEE_THROUGH, to_bytes

SINGLE_LIMIT = 24  # objects up to which each has its own mesh; with more, those of a model and LOD are instances of one
READY_SECONDS = 0.25  # that a browser takes to draw instances of a new mesh
LINE = {"thickness": 2.5, "thickness_units": "screen"}
POINT = {"colors": to_bytes(CONTACT_COLOUR), "point_shape": "circle", "point_shading": "flat", "precision": "float32"}
POINT_SIZE = 1 / 60  # of contact points, of the diagonal of the smallest model
CAMERA_DISTANCE = 1.8  # of the first camera, in radii of what is shown
LIGHT = 0.6
HIDDEN_MESHES = 48  # kept by the browser, invisible, for when their LOD comes back
PLAIN = {"flat_shading": True, "side": "double", "cast_shadow": False, "receive_shadow": False}


@dataclass(eq=False)
class _Node:
    """A node of the browser's scene: its handle, what was sent last, when it was added [s], and its objects."""

    handle: Any  # of viser
    sent: dict
    since: float = 0.0
    members: Any = ()  # objects that are its instances


class ViewerScene:
    """The browser's scene, updated by the differences from what was sent before.

    A few objects have a mesh each, whose vertices follow the LOD. Many are instances: an object changes to another mesh
    only after the browser has had the time to prepare that; otherwise it would vanish for a few frames.

    Attributes:
        pick: Called with the object that a user clicks, in a thread of the server.
        sent: Bytes of arrays sent so far.
        waits: Whether objects still show an earlier LOD, so that `show` should be called again soon.
    """

    def __init__(self, api, cache, clock=time.monotonic, pick=lambda i: None):
        self.api, self.cache, self.clock, self.pick = api, cache, clock, pick
        self.sent, self.waits = 0, False
        count = cache.scene.object_count
        self._single: dict[int, _Node] = {}
        self._meshes: dict[int, _Node] = {}
        self._layers: dict[str, _Node] = {}
        # The key of the mesh that each object shows, and of the one that it waits for; -1 is none.
        self._now, self._next = np.full(count, -1, np.int64), np.full(count, -1, np.int64)

    def show(self, data: RenderData):
        """Send what differs from what was sent before."""
        few = len(data.shown) <= SINGLE_LIMIT
        self._show_single(data, data.shown if few else data.shown[:0])
        self._show_instances(data, data.shown[:0] if few else data.shown)
        for owner in range(len(self.cache.scene.models)):
            vertices = np.reshape(data.intersecting.get(owner, ()), (-1, 3))
            arrays = {"vertices": vertices, "faces": np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)}
            look = {"color": to_bytes(COLOURS[owner % len(COLOURS)][1]), **PLAIN}
            self._show_layer(f"/intersecting/{owner}", self.api.add_mesh_simple, arrays, look)
        for name, ends, colour in (("/distances", data.nearest, NEAREST_COLOUR), ("/boxes", data.boxes, BOX_COLOUR)):
            if name in self._layers and len(ends) not in (0, len(self._layers[name].sent["points"])):
                self._layers.pop(name).handle.remove()  # points and colours go together
            colours = np.tile(np.array(to_bytes(colour), np.uint8), (len(ends), 2, 1))
            arrays = {"points": ends.astype(np.float32), "colors": colours}
            self._show_layer(name, self.api.add_line_segments, arrays, LINE)
        points = np.reshape(() if data.contacts is None else data.contacts, (-1, 3)).astype(np.float32)
        look = {**POINT, "point_size": POINT_SIZE * min(self.cache.diagonals)}
        self._show_layer("/contacts", self.api.add_point_cloud, {"points": points}, look)
        told = data.labels()
        for k in range(LABELS):
            point, text = told[k] if k < len(told) else (None, "")
            label = {"text": text, "position": point}
            self._show_layer(f"/distance/{k}", self.api.add_label, label, {"anchor": "center-center"})

    def _show_layer(self, name, add, arrays, look):
        """Show arrays, or a text, as a node of their own, which `add` makes; where the first is empty, hide it."""
        node, some = self._layers.get(name), len(next(iter(arrays.values()))) > 0
        if node is None and some:
            self._layers[name] = self._added(add(name, **arrays, **look), **arrays)
        elif node is not None:
            self._update(node, **(arrays if some else {}), visible=some)

    def _update(self, node: _Node, **values):
        """Assign the values that differ from those sent last."""
        for name, value in values.items():
            if not np.array_equal(node.sent[name], value):
                setattr(node.handle, name, value)
                node.sent[name] = value
                self.sent += getattr(value, "nbytes", 0)

    def _added(self, handle, visible=True, **sent) -> _Node:
        """Keep what was just added, with the values that were sent."""
        self.sent += sum(getattr(value, "nbytes", 0) for value in sent.values())
        return _Node(handle, {**sent, "visible": visible}, self.clock())

    def _mesh_arrays(self, key):
        vertices, faces, _ = self.cache.mesh(*geometry.split_key(key))
        return {"vertices": vertices.astype(np.float32), "faces": faces.astype(np.uint32)}

    # Objects that have a mesh each.

    def _show_single(self, data, objects):
        for i in set(self._single) - set(objects.tolist()):
            self._update(self._single[i], visible=False)
        for i in objects.tolist():
            pose, key = data.poses[i], int(data.keys[i])
            look = {"color": tuple(data.colours[i].tolist()), **_material(data)}
            place = {"position": pose[:3].copy(), "wxyz": pose[[6, 3, 4, 5]]}
            node = self._single.get(i)
            if node is None:
                sent = {**self._mesh_arrays(key), **place, **look}
                handle = self.api.add_mesh_simple(f"/objects/{i}", **sent, **PLAIN)
                handle.on_click(lambda _, i=i: self.pick(i))
                self._single[i] = self._added(handle, key=key, **sent)
                continue
            mesh = {} if node.sent["key"] == key else self._mesh_arrays(key)
            node.sent["key"] = key
            self._update(node, **mesh, **look, **place, visible=True)

    # Instances.

    def _show_instances(self, data, objects):
        self._choose_meshes(data, objects)
        groups = geometry.group_objects(self._now, objects)
        coming = geometry.group_objects(self._next, objects[self._next[objects] >= 0])
        for key, before in self._meshes.items():
            if key not in groups:
                self._update(before, visible=False)
        for key, members in (*groups.items(), *coming.items()):
            poses = data.poses[members].astype(np.float32)
            arrays = {
                "batched_positions": poses[:, :3],
                "batched_wxyzs": poses[:, [6, 3, 4, 5]],
                "batched_colors": _linear(data.colours[members]),
            }
            node = self._meshes.pop(key, None)
            if node is None:
                node = self._add_instances(key, {**arrays, "visible": key in groups, **_material(data)})
            elif key in groups:
                self._update(node, **_material(data), **arrays, visible=True)
            node.members = members
            self._meshes[key] = node  # the last used stand last
        hidden = [key for key in self._meshes if key not in groups and key not in coming]
        for key in hidden[: max(len(hidden) - HIDDEN_MESHES, 0)]:
            self._meshes.pop(key).handle.remove()

    def _choose_meshes(self, data, objects):
        """Decide which mesh every object shows now, and which it waits for."""
        wanted, now, coming = data.keys[objects], self._now[objects], self._next[objects]
        ready_since = self.clock() - READY_SECONDS
        ready = np.array([key for key, node in self._meshes.items() if node.since <= ready_since], np.int64)
        came = np.isin(coming, ready)
        now = np.where(came, coming, np.where(now < 0, wanted, now))
        now = np.where(np.isin(wanted, ready), wanted, now)
        late = now != wanted
        coming = np.where(came | ~late, -1, coming)
        self._now[:], self._next[:] = -1, -1
        self._now[objects], self._next[objects] = now, np.where(late & (coming < 0), wanted, coming)
        self.waits = bool(late.any())

    def _add_instances(self, key, look) -> _Node:
        sent = {**self._mesh_arrays(key), **look}
        name = "/meshes/{}/{}".format(*geometry.split_key(key))
        handle = self.api.add_batched_meshes_simple(name, **sent, lod="off", **PLAIN)
        node = self._added(handle, **sent)
        handle.on_click(lambda event: self.pick(int(node.members[event.instance_index])))
        return node


def _material(data) -> dict:
    """Return what all objects have in common, as viser takes it."""
    return {"wireframe": data.wireframe, "opacity": None if data.contacts is None else SEE_THROUGH}


def light_scene(api, eye, up):
    """Put a soft light in the place of viser's own, which bleach colours beside its environment."""
    api.set_up_direction(tuple(up))
    api.configure_default_lights(False)
    direction = up - np.cross(up, eye) + 0.6 * eye
    api.add_light_directional("/light", position=tuple(direction), intensity=LIGHT, cast_shadow=False)


def place_camera(first, ball, eye, up) -> np.ndarray:
    """Put the first camera of a server where it sees a ball, (centre, radius); return the position."""
    centre, radius = ball
    position = centre + CAMERA_DISTANCE * radius * eye
    first.position, first.look_at, first.up = tuple(position), tuple(centre), tuple(up)
    first.near, first.far = radius / 500, 200 * radius
    return position


def _linear(colours) -> np.ndarray:
    """Return sRGB colours as the browser takes those of instances: linear in light, uint8."""
    part = colours / 255.0
    linear = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
    return np.round(255 * linear).astype(np.uint8)
