"""Recording of a scene that runs, as one page of HTML that plays it in a browser without a server."""

from dataclasses import replace
from html import escape

import numpy as np

from warp_abtree.app import scene_geometry as geometry
from warp_abtree.app.render_data import Settings, Snapshot, compose, legend_html, make_legend, objects_to_draw
from warp_abtree.app.toml.objects import unit
from warp_abtree.app.viewer.viewer_scene import ViewerScene, light_scene, place_camera
from warp_abtree.checks.atomic_write import atomic_write
from warp_abtree.checks.quaternions import quaternions_of

PICTURES_MAX = 80  # of a recording, at most
PICTURE_SECONDS = 1 / 15  # that a picture is shown, at least; faster scenes are slowed down
KEPT_BITS = 10  # of the mantissa of positions and vertices: 0.05 % of a coordinate
CAMERA_SCALE = 0.06  # of the frustum of the scene's camera, in radii of what is shown
# The player loads the light of the surroundings, and fades in, whenever it begins again: the canvas stays opaque.
# Below the recording stand a title and a legend; in a window that is higher than wide the recording is a square.
STYLE = """<style>
html, body { height: 100% } body { margin: 0; display: flex; flex-direction: column; font-family: sans-serif }
#root { flex: 1; min-height: 0; position: relative; overflow: hidden; contain: strict }
#root > div { height: 100% !important } canvas { opacity: 1 !important }
footer { padding: 0.5em 0.7em 0; line-height: 1.5 }
@media (max-aspect-ratio: 1/1) { #root { flex: none; height: 110vw } }
</style>"""


def short_floats(values) -> np.ndarray:
    """Return float32 of fewer bits, which pack better."""
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    dropped = 23 - KEPT_BITS
    return ((bits + (1 << (dropped - 1))) >> dropped << dropped).view(np.float32)


class _RoundedMeshes(geometry.MeshCache):
    """Meshes with rounded vertices."""

    def mesh(self, model, lod):
        vertices, faces, face_ids = super().mesh(model, lod)
        return short_floats(vertices), faces, face_ids


class SceneRecording:
    """A recording of a `SceneFile`, at its start, on a viser server that shows nothing else.

    Colours tell LODs, or else intersecting faces; contact points are drawn where there are rigid bodies. Of many frames
    that will be run every k-th is kept.
    """

    def __init__(self, server, loaded, frames: int, by_lod: bool):
        self.server, self.loaded, view = server, loaded, loaded.picture
        self._eye, self._up = unit(view.eye), unit(view.up)
        self.shown = objects_to_draw(loaded.worlds, view.world, f"{loaded.path}: picture.")
        self.settings = Settings(by_lod=by_lod, intersecting=not by_lod, contacts=loaded.dynamics is not None)
        self.stride = -(-frames // PICTURES_MAX)
        self.seconds = max(self.stride * loaded.time_step, PICTURE_SECONDS)
        self.time, self.pictures = 0.0, []
        self.cache = _RoundedMeshes(loaded.scene)
        self._scene = ViewerScene(server.scene, self.cache, clock=lambda: self.time)
        light_scene(server.scene, self._eye, self._up)
        self._serializer = server.get_scene_serializer()

    def add(self, row):
        """Draw the frame of a row that was just run, if it is one of those that are kept. Waits for the device."""
        if row.frame % self.stride:
            return
        scene = self.loaded.scene
        result = scene.intersect(output=self.settings.output)
        snapshot = Snapshot(row.frame, row.time, scene.poses, scene.lods, result, row)
        data = compose(self.cache, snapshot, self.shown, self.settings)
        contacts = None if data.contacts is None else short_floats(data.contacts)
        triangles = {model: short_floats(corners) for model, corners in data.intersecting.items()}
        data = replace(data, poses=short_floats(data.poses), intersecting=triangles, contacts=contacts)
        if not self.pictures:
            self._begin(geometry.bounds(self.cache, snapshot, self.shown))
        else:
            self._serializer.insert_sleep(self.seconds)
            self.time += self.seconds
        self._scene.show(data)
        self._tell(data, row)
        self.pictures.append(replace(data, poses=data.poses[:0], intersecting=dict.fromkeys(data.intersecting)))

    def _begin(self, ball):
        """Place the cameras: of the page, and the frustum of the one that LODs are for."""
        (centre, radius), camera = ball, self.loaded.camera
        place_camera(self.server.initial_camera, ball, self._eye, self._up)
        top = tuple(centre + 0.9 * radius * self._up)
        self._label = self.server.scene.add_label("/row", "", position=top, anchor="bottom-center")
        self._camera = None
        if camera is not None:
            options = {"scale": CAMERA_SCALE * radius, "thickness": CAMERA_SCALE * radius / 20}
            fov, size = camera(0.0).field_of_view, camera(0.0).size
            self._camera = self.server.scene.add_camera_frustum("/camera", fov, size[0] / size[1], **options)

    def _tell(self, data, row):
        """Write what the frame found, and move the frustum."""
        if data.contacts is not None:
            found = f"{len(data.contacts)} contact points"
        elif row.budget_ms is not None:
            found = f"{row.total_ms:.1f} of {row.budget_ms:g} ms"
        else:
            found = f"{data.pair_count:,} pairs of them meet"
        self._label.text = f"{row.time:.2f} s: {data.faces:,} faces, {found}"
        if self._camera is not None:
            camera = self.loaded.camera(row.time)
            turn = quaternions_of((camera.view * [[1], [-1], [-1]]).T[None])[0]  # a camera of vision looks along z
            self._camera.position, self._camera.wxyz = camera.eye, turn[[3, 0, 1, 2]]

    def write(self, path):
        """Write the page."""
        self._serializer.insert_sleep(self.seconds)
        speed = self.seconds / (self.stride * self.loaded.time_step)
        slow = f", {speed:.0f} times slower" if speed > 1.5 else ""
        legend = legend_html(make_legend(self.loaded.scene, self.pictures, self.settings.by_lod))
        title = escape(self.loaded.title)
        page = self._serializer.as_html()
        page = page.replace("<title>Viser</title>", f"<title>{title}</title>", 1)
        footer = f"{STYLE}<footer><b>{title}</b>{slow}{legend}</footer>"
        end = page.rindex("</body>")
        data = (page[:end] + footer + page[end:]).encode()
        with atomic_write(path) as file:
            file.write(data)
