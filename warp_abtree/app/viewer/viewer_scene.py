"""What a moment puts on the stage of the viewer, and how it gets there: only what changed is sent."""

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import trimesh

from warp_abtree.app.pictures.plot import COLOURS
from warp_abtree.app.viewer import render_data as parts

SEGMENT_COLOUR, NORMAL_COLOUR, BOX_COLOUR, CAMERA_COLOUR = (220, 30, 30), (120, 30, 160), (40, 90, 200), (90, 90, 90)
ALONE = 24  # objects that have a mesh each; with more, those of a model and LOD are instances of one
RIPE = 0.25  # seconds that a browser takes to draw instances of a new mesh
HIDDEN_MESHES = 48  # that stay with the browser, out of sight, for when their LOD comes back


@dataclass
class Settings:
    """What people asked to see.

    Attributes:
        world: The one shown; objects of world -1 are in every one.
        struck, contacts, normals: Whether intersecting faces are coloured, contacts and their normals drawn.
        wireframe: Whether meshes are drawn as their edges.
        by_lod: Whether colours tell LODs in the place of models.
        level: Of the boxes of trees, -1 for none.
        every_tree: Whether the boxes are of all objects in the place of the picked one.
        picked: Index of an object, or None.
    """

    world: int = 0
    struck: bool = True
    contacts: bool = True
    normals: bool = False
    wireframe: bool = False
    by_lod: bool = False
    level: int = -1
    every_tree: bool = False
    picked: int | None = None

    @property
    def output(self) -> str:
        """What must be asked of the scene."""
        return "contacts" if self.contacts or self.normals else "faces" if self.struck else "count"


@dataclass(eq=False)
class Drawing:
    """A moment as arrays in the world.

    Attributes:
        poses, keys, colours: Of every object: float64 (n, 7), `mesh_keys`, uint8 (n, 3).
        struck: Intersecting faces by model, float32 (t, 3, 3).
        segments, normals, boxes: Lines, float32 (k, 2, 3).
        shown: Indices of the objects that are shown.
        struck_count, contact_count, box_count: How many there are, drawn or not.
        faces: Active faces of the shown objects together.
        error_mean: Mean certified error of the shown objects [units].
        camera: The scene's own `Camera`, or None.
    """

    poses: np.ndarray
    keys: np.ndarray
    colours: np.ndarray
    struck: dict
    segments: np.ndarray
    normals: np.ndarray
    boxes: np.ndarray
    shown: np.ndarray
    struck_count: int
    contact_count: int
    box_count: int
    faces: int
    error_mean: float
    camera: object = None


class Composer:
    """Makes drawings of the moments of a source.

    Args:
        source: `Source`.
    """

    def __init__(self, source):
        self.source = source
        self.cache = parts.MeshCache(source.scene)

    def shown(self, settings) -> np.ndarray:
        """Return the indices of the objects of the world that is shown."""
        return np.flatnonzero((self.source.worlds == settings.world) | (self.source.worlds == -1))

    def frame_of(self, moment, settings):
        """Return centre and radius of a ball around what is shown [units]."""
        return parts.bounds(self.cache, moment, self.shown(settings))

    def compose(self, moment, settings: Settings) -> Drawing:
        """Return what to draw."""
        scene, result = self.source.scene, moment.result
        shown = self.shown(settings)
        inside = np.zeros(scene.object_count, bool)
        inside[shown] = True
        struck = parts.struck_faces(result, inside)
        segments, normals = parts.contact_lines(result, parts.normal_length(self.cache, shown), inside)
        nothing = np.empty((0, 2, 3), np.float32)
        boxes, box_count = nothing, 0
        if settings.level >= 0:
            objects = shown if settings.every_tree else [i for i in [settings.picked] if i is not None and inside[i]]
            boxes, box_count = parts.tree_lines(scene, moment, objects, settings.level)
        keys = parts.mesh_keys(scene, moment.lods)
        each, times = np.unique(keys[shown], return_counts=True)
        stand = [(*parts.split_key(key), n) for key, n in zip(each.tolist(), times.tolist())]
        pairs = inside[result.pairs].all(axis=1) if len(result.pairs) else np.zeros(0, bool)
        return Drawing(
            poses=moment.poses,
            keys=keys,
            colours=parts.object_colours(scene, moment.lods, settings.picked, settings.by_lod),
            struck=parts.struck_triangles(self.cache, moment, struck) if settings.struck else {},
            segments=segments if settings.contacts else nothing,
            normals=normals if settings.normals else nothing,
            boxes=boxes,
            shown=shown,
            struck_count=len(struck),
            contact_count=int(result.count[pairs].sum()) if result.count is not None else 0,
            box_count=box_count,
            faces=sum(self.cache.count(owner, lod) * n for owner, lod, n in stand),
            error_mean=sum(scene.models[owner].error_at(lod) * n for owner, lod, n in stand) / max(len(shown), 1),
            camera=None if self.source.camera is None else self.source.camera(moment.time),
        )


@dataclass(eq=False)
class _Placed:
    """What the browser has: its handle, the arrays sent last, the objects that it shows, and when it came [s]."""

    handle: Any  # of viser
    sent: dict
    objects: np.ndarray = field(default_factory=lambda: np.empty(0, int))
    since: float = 0.0


class Stage:
    """What the browser has, brought up to date with as little as possible.

    A few objects have a mesh each, whose corners follow the LOD. Many are instances: an object changes to another mesh
    only once the browser has had the time to make that ready, or it would be out of sight for a few frames.

    Args:
        api: `scene` of a viser server.
        cache: `MeshCache`.
        on_pick: Called with the index of an object that is clicked, in a thread of the server.
        clock: Seconds.

    Attributes:
        sent: Bytes of arrays sent so far.
        waits: Whether objects still show a LOD before, so that `show` should be called again soon.
    """

    def __init__(self, api, cache, on_pick=None, clock=time.monotonic):
        self.api, self.cache, self.on_pick, self.clock = api, cache, on_pick, clock
        self.sent, self.waits = 0, False
        count = cache.scene.object_count
        self._alone: dict[int, _Placed] = {}
        self._meshes: dict[int, _Placed] = {}
        self._layers: dict[str, _Placed] = {}
        # The key that each object shows, and the one whose mesh it waits for; -1 is none.
        self._now, self._next = np.full(count, -1, np.int64), np.full(count, -1, np.int64)
        self._wireframe = False

    def show(self, drawing: Drawing, settings: Settings):
        """Send what differs from what was sent before."""
        if settings.wireframe != self._wireframe:
            self._wireframe = settings.wireframe
            for placed in (*self._alone.values(), *self._meshes.values()):
                placed.handle.wireframe = settings.wireframe
        few = len(drawing.shown) <= ALONE
        self._show_alone(drawing, drawing.shown if few else drawing.shown[:0])
        self._show_instances(drawing, drawing.shown[:0] if few else drawing.shown)
        for owner in range(len(self.cache.scene.models)):
            corners = drawing.struck.get(owner)
            self._show_triangles(f"/struck/{owner}", corners, COLOURS[owner % len(COLOURS)][1])
        self._show_lines("/contacts", drawing.segments, SEGMENT_COLOUR, 3.0)
        self._show_lines("/normals", drawing.normals, NORMAL_COLOUR, 1.5)
        self._show_lines("/tree", drawing.boxes, BOX_COLOUR, 1.0)
        self._show_camera(drawing.camera)

    def _update(self, placed: _Placed, **arrays):
        """Assign the arrays that differ from those sent last."""
        for name, array in arrays.items():
            before = placed.sent.get(name)
            if before is None or before.shape != array.shape or not np.array_equal(before, array):
                setattr(placed.handle, name, array)
                placed.sent[name] = array
                self.sent += array.nbytes

    def _visible(self, placed: _Placed, visible: bool):
        if placed.sent.get("visible", True) != visible:
            placed.handle.visible = placed.sent["visible"] = visible

    def _added(self, handle, arrays, objects) -> _Placed:
        """Keep what was just added, and let clicks on it pick."""
        self.sent += sum(array.nbytes for array in arrays.values())
        placed = _Placed(handle, dict(arrays), objects, self.clock())
        if self.on_pick is not None:

            @handle.on_click
            def _(event):
                index = event.instance_index or 0
                if index < len(placed.objects):
                    self.on_pick(int(placed.objects[index]))

        return placed

    def _mesh_options(self):
        plain = {"side": "double", "cast_shadow": False, "receive_shadow": False}
        return {**plain, "wireframe": True} if self._wireframe else {**plain, "flat_shading": True}

    def _mesh_arrays(self, key):
        vertices, faces, _ = self.cache.mesh(*parts.split_key(key))
        return {"vertices": vertices.astype(np.float32), "faces": faces.astype(np.uint32)}

    # Objects that have a mesh each.

    def _show_alone(self, drawing, objects):
        for i in set(self._alone) - set(objects.tolist()):
            self._visible(self._alone[i], False)
        for i in objects.tolist():
            pose, colour, key = drawing.poses[i], tuple(drawing.colours[i].tolist()), int(drawing.keys[i])
            place = {"position": pose[:3].copy(), "wxyz": pose[[6, 3, 4, 5]]}
            placed = self._alone.get(i)
            if placed is None:
                arrays = {**self._mesh_arrays(key), **place}
                name = f"/objects/{i}"
                handle = self.api.add_mesh_simple(name, **arrays, color=colour, **self._mesh_options())
                placed = self._alone[i] = self._added(handle, arrays, np.array([i]))
                placed.sent["key"], placed.sent["color"] = key, colour
                continue
            if placed.sent["key"] != key:
                self._update(placed, **self._mesh_arrays(key))
                placed.sent["key"] = key
            if placed.sent["color"] != colour:
                placed.handle.color = placed.sent["color"] = colour
            self._update(placed, **place)
            self._visible(placed, True)

    # Instances.

    def _show_instances(self, drawing, objects):
        self._choose_meshes(drawing, objects)
        groups = parts.group_objects(self._now, objects)
        coming = parts.group_objects(self._next, objects[self._next[objects] >= 0])
        for key, before in self._meshes.items():
            if key not in groups:
                self._visible(before, False)
        for key, members in (*groups.items(), *coming.items()):
            poses = drawing.poses[members].astype(np.float32)
            arrays = {
                "batched_positions": poses[:, :3],
                "batched_wxyzs": poses[:, [6, 3, 4, 5]],
                "batched_colors": _linear(drawing.colours[members]),
            }
            placed = self._meshes.pop(key, None)
            if placed is None:
                placed = self._add_instances(key, members, arrays, visible=key in groups)
            elif key in groups:
                self._update(placed, **arrays)
                self._visible(placed, True)
                placed.objects = members
            self._meshes[key] = placed  # the last used stand last
        hidden = [key for key in self._meshes if key not in groups and key not in coming]
        for key in hidden[: max(len(hidden) - HIDDEN_MESHES, 0)]:
            self._meshes.pop(key).handle.remove()

    def _choose_meshes(self, drawing, objects):
        """Decide which mesh every object shows now, and which it waits for."""
        wanted = drawing.keys
        ripe = self.clock() - RIPE
        ready = np.array([key for key, placed in self._meshes.items() if placed.since <= ripe], np.int64)
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

    def _add_instances(self, key, members, arrays, visible) -> _Placed:
        arrays = {**self._mesh_arrays(key), **arrays}
        name = "/meshes/{}/{}".format(*parts.split_key(key))
        options = {"lod": "off", "visible": visible}
        handle = self.api.add_batched_meshes_simple(name, **arrays, **options, **self._mesh_options())
        placed = self._added(handle, arrays, members)
        placed.sent["visible"] = visible
        return placed

    # Layers over them.

    def _show_triangles(self, name, corners, colour):
        placed = self._layers.get(name)
        if corners is None or not len(corners):
            if placed is not None:
                self._visible(placed, False)
            return
        vertices = corners.reshape(-1, 3)
        arrays = {"vertices": vertices, "faces": np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)}
        if placed is None:
            options = {"flat_shading": True, "side": "double", "cast_shadow": False, "receive_shadow": False}
            colour = tuple(round(255 * part) for part in colour)
            handle = self.api.add_mesh_simple(name, **arrays, color=colour, **options)
            self._layers[name] = _Placed(handle, arrays)
            self.sent += sum(array.nbytes for array in arrays.values())
            return
        self._update(placed, **arrays)
        self._visible(placed, True)

    def _show_lines(self, name, lines, colour, width):
        placed = self._layers.get(name)
        if not len(lines):
            if placed is not None:
                self._visible(placed, False)
            return
        if placed is None:
            handle = self.api.add_line_segments(name, lines, colour, thickness=width, thickness_units="screen")
            self._layers[name] = _Placed(handle, {"points": lines})
            self.sent += lines.nbytes
            return
        self._update(placed, points=lines)
        self._visible(placed, True)

    def _show_camera(self, camera):
        if camera is None:
            return
        placed = self._layers.get("/camera")
        if placed is None:
            width, height = camera.size
            handle = self.api.add_camera_frustum(
                "/camera",
                fov=float(camera.field_of_view),
                aspect=width / height,
                scale=0.03 * camera.far,
                thickness=1.5,
                thickness_units="screen",
                color=CAMERA_COLOUR,
            )
            placed = self._layers["/camera"] = _Placed(handle, {})
        # viser's cameras look along z with y down; the rows of `view` are right, up and back.
        turn = np.eye(4)
        turn[:3, :3] = camera.view.T * (1.0, -1.0, -1.0)
        wxyz = trimesh.transformations.quaternion_from_matrix(turn)
        self._update(placed, position=np.asarray(camera.eye, np.float64), wxyz=wxyz)


def _linear(colours) -> np.ndarray:
    """Return sRGB colours as the browser takes those of instances: linear in light, uint8."""
    part = colours / 255.0
    linear = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
    return np.round(255 * linear).astype(np.uint8)
