"""The scene of the viewer in the browser: only what changed is sent."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_abtree.app import scene_geometry as geometry
from warp_abtree.app.render_data import RenderData
from warp_abtree.app.styles import BOX_COLOUR, COLOURS, CONTACT_COLOUR, NEAREST_COLOUR, SEE_THROUGH, to_bytes

SINGLE_LIMIT = 24  # objects up to which each has its own mesh; with more, those of a model and LOD are instances of one
READY_SECONDS = 0.25  # that a browser takes to draw instances of a new mesh
LINE = {"thickness": 2.5, "thickness_units": "screen"}
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
        self._labels: list[_Node] = []
        # The key of the mesh that each object shows, and of the one that it waits for; -1 is none.
        self._now, self._next = np.full(count, -1, np.int64), np.full(count, -1, np.int64)

    def show(self, data: RenderData):
        """Send what differs from what was sent before."""
        few = len(data.shown) <= SINGLE_LIMIT
        self._show_single(data, data.shown if few else data.shown[:0])
        self._show_instances(data, data.shown[:0] if few else data.shown)
        for owner in range(len(self.cache.scene.models)):
            corners = data.intersecting.get(owner, ())
            self._show_triangles(f"/intersecting/{owner}", corners, COLOURS[owner % len(COLOURS)][1])
        self._show_segments("/distances", data.nearest, NEAREST_COLOUR)
        self._show_segments("/boxes", data.boxes, BOX_COLOUR)
        self._show_points("/contacts", () if data.contacts is None else data.contacts)
        self._show_labels(data)

    def _update(self, node: _Node, **arrays):
        """Assign the arrays that differ from those sent last."""
        for name, array in arrays.items():
            before = node.sent.get(name)
            if before is None or before.shape != array.shape or not np.array_equal(before, array):
                setattr(node.handle, name, array)
                node.sent[name] = array
                self.sent += array.nbytes

    def _set(self, node: _Node, name: str, value):
        """Assign a value if another was sent last."""
        if node.sent[name] != value:
            setattr(node.handle, name, value)
            node.sent[name] = value

    def _added(self, handle, arrays, visible=True, **values) -> _Node:
        """Keep what was just added, with arrays and other values."""
        self.sent += sum(array.nbytes for array in arrays.values())
        return _Node(handle, {**arrays, "visible": visible, **values}, self.clock())

    def _mesh_arrays(self, key):
        vertices, faces, _ = self.cache.mesh(*geometry.split_key(key))
        return {"vertices": vertices.astype(np.float32), "faces": faces.astype(np.uint32)}

    # Objects that have a mesh each.

    def _show_single(self, data, objects):
        for i in set(self._single) - set(objects.tolist()):
            self._set(self._single[i], "visible", False)
        for i in objects.tolist():
            pose, key = data.poses[i], int(data.keys[i])
            look = {"color": tuple(data.colours[i].tolist()), **_material(data)}
            place = {"position": pose[:3].copy(), "wxyz": pose[[6, 3, 4, 5]]}
            node = self._single.get(i)
            if node is None:
                arrays = {**self._mesh_arrays(key), **place}
                handle = self.api.add_mesh_simple(f"/objects/{i}", **arrays, **look, **PLAIN)
                handle.on_click(lambda _, i=i: self.pick(i))
                self._single[i] = self._added(handle, arrays, key=key, **look)
                continue
            if node.sent["key"] != key:
                self._update(node, **self._mesh_arrays(key))
                node.sent["key"] = key
            for name, value in look.items():
                self._set(node, name, value)
            self._update(node, **place)
            self._set(node, "visible", True)

    # Instances.

    def _show_instances(self, data, objects):
        self._choose_meshes(data, objects)
        groups = geometry.group_objects(self._now, objects)
        coming = geometry.group_objects(self._next, objects[self._next[objects] >= 0])
        for key, before in self._meshes.items():
            if key not in groups:
                self._set(before, "visible", False)
        for key, members in (*groups.items(), *coming.items()):
            poses = data.poses[members].astype(np.float32)
            arrays = {
                "batched_positions": poses[:, :3],
                "batched_wxyzs": poses[:, [6, 3, 4, 5]],
                "batched_colors": _linear(data.colours[members]),
            }
            node = self._meshes.pop(key, None)
            if node is None:
                node = self._add_instances(key, arrays, visible=key in groups, **_material(data))
            elif key in groups:
                for name, value in _material(data).items():
                    self._set(node, name, value)
                self._update(node, **arrays)
                self._set(node, "visible", True)
            node.members = members
            self._meshes[key] = node  # the last used stand last
        hidden = [key for key in self._meshes if key not in groups and key not in coming]
        for key in hidden[: max(len(hidden) - HIDDEN_MESHES, 0)]:
            self._meshes.pop(key).handle.remove()

    def _choose_meshes(self, data, objects):
        """Decide which mesh every object shows now, and which it waits for."""
        wanted = data.keys
        ready_since = self.clock() - READY_SECONDS
        ready = np.array([key for key, node in self._meshes.items() if node.since <= ready_since], np.int64)
        outside = np.ones(len(self._now), bool)
        outside[objects] = False
        self._now[outside] = self._next[outside] = -1
        new = ~outside & (self._now < 0)
        self._now[new] = wanted[new]
        came = np.isin(self._next, ready)
        self._now[came] = self._next[came]
        there = ~outside & np.isin(wanted, ready)
        self._now[there] = wanted[there]
        settled = came | (self._now == wanted)
        self._next[settled] = -1
        late = ~outside & (self._now != wanted)
        asks = late & (self._next < 0)
        self._next[asks] = wanted[asks]
        self.waits = bool(late.any())

    def _add_instances(self, key, arrays, **look) -> _Node:
        arrays = {**self._mesh_arrays(key), **arrays}
        name = "/meshes/{}/{}".format(*geometry.split_key(key))
        handle = self.api.add_batched_meshes_simple(name, **arrays, lod="off", **look, **PLAIN)
        node = self._added(handle, arrays, **look)
        handle.on_click(lambda event: self.pick(int(node.members[event.instance_index])))
        return node

    def _show_triangles(self, name, corners, colour):
        """Show triangles as a node of their own; without any hide it."""
        node, arrays = self._layers.get(name), {}
        if len(corners):
            vertices = corners.reshape(-1, 3)
            arrays = {"vertices": vertices, "faces": np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)}
        if node is None and arrays:
            handle = self.api.add_mesh_simple(name, **arrays, color=to_bytes(colour), **PLAIN)
            self._layers[name] = self._added(handle, arrays)
        elif node is not None:
            self._update(node, **arrays)
            self._set(node, "visible", bool(arrays))

    def _show_points(self, name, points):
        """Show points (k, 3) as a node of their own; without any hide it."""
        node, arrays = self._layers.get(name), {"points": np.asarray(points, np.float32)} if len(points) else {}
        if node is None and arrays:
            look = {"colors": to_bytes(CONTACT_COLOUR), "point_size": POINT_SIZE * min(self.cache.diagonals)}
            shape = {"point_shape": "circle", "point_shading": "flat", "precision": "float32"}
            self._layers[name] = self._added(self.api.add_point_cloud(name, **arrays, **look, **shape), arrays)
        elif node is not None:
            self._update(node, **arrays)
            self._set(node, "visible", bool(arrays))

    def _show_segments(self, name, ends, colour):
        """Show segments (k, 2, 3) as a node of their own; without any hide it."""
        node, count = self._layers.get(name), len(ends)
        if node is not None and count and count != len(node.sent["points"]):
            node.handle.remove()  # points and colours go together
            node = None
        if node is None and count:
            colour = np.array(to_bytes(colour), np.uint8)
            arrays = {"points": ends.astype(np.float32), "colors": np.tile(colour, (count, 2, 1))}
            handle = self.api.add_line_segments(name, **arrays, **LINE)
            self._layers[name] = self._added(handle, arrays)
        elif node is not None:
            self._update(node, **({"points": ends.astype(np.float32)} if count else {}))
            self._set(node, "visible", count > 0)

    def _show_labels(self, data):
        """Show the least distances in numbers at the middles of their segments."""
        told = data.labels()
        for k, (point, text) in enumerate(told):
            place = {"position": point}
            if k == len(self._labels):
                handle = self.api.add_label(f"/distance/{k}", text=text, anchor="center-center", **place)
                self._labels.append(self._added(handle, place, text=text))
                continue
            node = self._labels[k]
            self._set(node, "text", text)
            self._update(node, **place)
            self._set(node, "visible", True)
        for node in self._labels[len(told) :]:
            self._set(node, "visible", False)


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
