"""Pictures of scenes: objects at their LODs and poses, intersecting faces coloured."""

from dataclasses import replace

import numpy as np

from warp_abtree.app import scene_geometry as geometry
from warp_abtree.app.pictures.render import Panel, camera_of, crop, draw, lay_out, render, write_animation
from warp_abtree.app.playback import MeshView
from warp_abtree.app.render_data import LABELS, RenderData, Settings, Snapshot, compose, objects_of_world
from warp_abtree.app.styles import COLOURS, NEAREST_COLOUR
from warp_abtree.scene.scene import Scene

SIZE = 800  # pixels


def make_panel(cache: geometry.MeshCache, data: RenderData, title: str | None = None) -> Panel:
    """Return a picture of render data; without a first line, `title` counts objects and faces."""
    triangles, colours = [], []
    for key, members in geometry.group_objects(data.keys, data.shown).items():
        vertices, faces, _ = cache.mesh(*geometry.split_key(key))
        corners = np.repeat(vertices[faces][None], len(members), axis=0).reshape(-1, 3, 3)
        owners = np.repeat(members, len(faces))
        triangles.append(geometry.place(data.poses, owners, corners))
        colours.append(data.colours[owners] / 255)
    for model, corners in data.intersecting.items():
        triangles.append(corners.astype(np.float64))
        colours.append(np.tile(COLOURS[model % len(COLOURS)][1], (len(corners), 1)))
    count = len(data.shown)
    title = title or f"{count:,} object{'' if count == 1 else 's'}, {data.faces:,} faces"
    title += f"\n{data.pair_count:,} intersecting face pairs"
    lines = [(data.nearest, NEAREST_COLOUR)] if len(data.nearest) else []
    return Panel(title, np.concatenate(triangles), np.concatenate(colours), lines, data.labels())


def make_legend(scene: Scene, panels: list[RenderData]) -> list:
    """Return (colour, label) of the models that panels of one scene show."""
    legend = []
    for model in dict.fromkeys(np.array(scene.object_model)[panels[0].shown].tolist()):
        plain, bright = COLOURS[model % len(COLOURS)]
        name = scene.models[model].name
        legend.append((plain, name))
        if any(model in data.intersecting for data in panels):
            legend.append((bright, f"{name}, intersecting"))
    return legend


def draw_snapshot(scene: Scene, snapshot: Snapshot, shown, path, title: str, view, settings: Settings, size: int):
    """Draw the shown objects of a snapshot to a PNG file; `view` is the directions to the eye and upwards."""
    cache = geometry.MeshCache(scene)
    data = compose(cache, snapshot, shown, settings)
    (eye, up), legend = view, make_legend(scene, [data])
    draw([make_panel(cache, data)], path, title, legend, eye, up, size)


def draw_frames(scene: Scene, snapshots, shown, path, title: str, view, settings: Settings, size: int):
    """Draw two or more snapshots, equal steps of time apart, to a WebP or GIF file; `view` as for `draw_snapshot`."""
    cache, panels, seen, times = geometry.MeshCache(scene), [], [], []
    for snapshot in snapshots:
        data = compose(cache, snapshot, shown, settings)
        panels.append(make_panel(cache, data))
        seen.append(replace(data, colours=data.colours[:0], poses=data.poses[:0]))
        times.append(snapshot.time)
    camera, legend = camera_of(panels, *view), make_legend(scene, seen)
    images = crop([render(panel, camera, size) for panel in panels])
    drawn = [lay_out([image], [panel.title], title, legend) for image, panel in zip(images, panels)]
    write_animation(drawn, path, round(1000 * (times[-1] - times[0]) / (len(times) - 1)))


def draw_clashes(scene: Scene, result, path, title: str):
    """Draw a scene to a PNG file, with the faces, curves and names of a result's pairs that have contacts."""
    view, cache = MeshView(), geometry.MeshCache(scene)
    snapshot = Snapshot(0, 0.0, scene.poses, scene.lods, result, None)
    panel = make_panel(cache, compose(cache, snapshot, np.flatnonzero(scene.present), Settings()))
    panel.lines.append((np.stack([result.contacts["p0"], result.contacts["p1"]], 1), NEAREST_COLOUR))
    met = np.flatnonzero(result.count)[:LABELS]
    panel.labels += [(result.pair_contacts["point"][k], ", ".join(map(scene.name, result.pairs[k]))) for k in met]
    draw([panel], path, title, [], view.eye, view.up, SIZE)


def panel_lods(loaded) -> list[np.ndarray]:
    """Return the LODs of all objects in each panel: both ends of the sweeps, or what the file's [picture] asks for."""
    asked = loaded.picture.lods
    asked = [asked] if isinstance(asked, float) else asked
    fractions = [asked or (sweep.start, sweep.turn) for sweep in loaded.sweeps]
    chosen = [loaded.base_lods.copy() for _ in range(len(fractions[0]) if fractions else 1)]
    for sweep, each in zip(loaded.sweeps, fractions):
        for lods, fraction in zip(chosen, each):
            sweep.apply(fraction, lods)
    return chosen


def draw_scene(loaded, path, time: float, poses=None, lods=None):
    """Draw a scene file's picture at one time and several LODs: both sides of an LOD switch, the same poses.

    The scene's LODs are what they were afterwards, its poses those of the picture.

    Args:
        loaded: What `load_scene` returned.
        time: Time of the poses [s], unless the file's `[picture]` has one.
        poses: Pose of every object, (n, 7), in the place of those of the time.
        lods: LOD of every object, (n,), for one panel in the place of the file's.
    """
    scene, view = loaded.scene, loaded.picture
    time = time if view.time is None else view.time
    poses = loaded.motion.poses(time) if poses is None else poses
    shown = objects_of_world(loaded.worlds, view.world)
    if len(shown) == 0:
        raise ValueError(f"{loaded.path}: picture.world: no object is in world {view.world}")
    swept = [model for sweep in loaded.sweeps for model, indices in sweep.objects if np.isin(indices, shown).any()]
    cache, panels = geometry.MeshCache(scene), []
    before = scene.lods
    scene.set_poses(poses)
    try:
        for chosen in panel_lods(loaded) if lods is None else [lods]:
            scene.set_lods(chosen)
            snapshot = Snapshot(0, time, poses, scene.lods, scene.intersect(output="faces"), None)
            panels.append(compose(cache, snapshot, shown, Settings()))
    finally:
        scene.set_lods(before)
    drawn = [make_panel(cache, data, _swept_title(scene, data, swept[0]) if swept else None) for data in panels]
    draw(drawn, path, loaded.title, make_legend(scene, panels), view.eye, view.up)


def _swept_title(scene, data, model) -> str:
    """Return the LODs at which a panel shows a swept model, and its faces."""
    keys = [geometry.split_key(key) for key in data.keys[data.shown]]
    lods = [lod for owner, lod in keys if scene.models[owner] is model]
    faces = sum(model.progressive.active_count(lod) for lod in lods)
    span = f"{min(lods):,}" if min(lods) == max(lods) else f"{min(lods):,} to {max(lods):,}"
    return f"{model.name} at LOD {span} of {model.lod_max:,}: {faces:,} faces"
