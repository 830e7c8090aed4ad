"""Pictures of scenes: objects at their LODs and poses, intersecting faces coloured."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from warp_abtree.app import scene_geometry as geometry
from warp_abtree.app.cli.report import check_output
from warp_abtree.app.pictures.render import Panel, draw, lay_out, render_panels, write_animation
from warp_abtree.app.render_data import (
    LABELS,
    RenderData,
    Settings,
    Snapshot,
    compose,
    make_legend,
    objects_to_draw,
    worlds_of,
)
from warp_abtree.app.scene_view import make_view
from warp_abtree.app.styles import COLOURS, NEAREST_COLOUR
from warp_abtree.checks.arguments import whole_number
from warp_abtree.scene.scene import Scene

SIZE, SIZES = 800, (50, 8000)  # of a side [pixels]


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


def picture(
    scene: Scene, path, *, result=None, up="z", eye=None, world=0, distances=False, size=SIZE, title=""
) -> Path:
    """Draw a scene as it stands to a PNG file, intersecting faces coloured; return its path. Waits for the device.

    Args:
        scene: `Scene` with objects.
        path: PNG file to write, whole or not at all.
        result: `Result` of the scene as it stands, whose faces are coloured, as of some pairs; None asks for all.
        up: Axis that points upwards, as "z" or "-y", or a direction, (3,).
        eye: Direction to the eye, as up; None is from the front, a little from the right and from above.
        world: World to draw; objects of world -1 are in every one.
        distances: Whether distances are drawn between objects: of few all, of more those whose boxes overlap.
        size: Pixels along a side.
        title: Above the picture.

    Raises:
        TypeError: scene is no Scene.
        ValueError: pyvista or Matplotlib is not installed, a bad option, or a result without faces on the host, or of
            another scene or other LODs.
    """
    view, shown, path = make_view(up, eye, world), objects_to_draw(worlds_of(scene), world), Path(path)
    check_output(path, [".png"])
    whole_number(size, "size", *SIZES)
    if result is None:
        result = scene.intersect(output="faces")
    elif not isinstance(result.faces, np.ndarray):
        raise ValueError("result: no faces on the host; ask for output 'faces' or 'contacts'")
    elif result.pairs.max(initial=-1) >= scene.object_count:
        raise ValueError(f"result: names an object that is none of the scene's {scene.object_count:,}")
    snapshot = Snapshot(0, 0.0, scene.poses, scene.lods, result, None)
    draw_snapshot(scene, snapshot, shown, path, title, view, Settings(world, distances=distances), size)
    return path


def draw_snapshot(scene: Scene, snapshot: Snapshot, shown, path, title: str, view, settings: Settings, size: int):
    """Draw the shown objects of a snapshot to a PNG file, as a `SceneView` sees them."""
    cache = geometry.MeshCache(scene)
    data = compose(cache, snapshot, shown, settings)
    draw([make_panel(cache, data)], path, title, make_legend(scene, [data]), view.eye, view.up, size)


def draw_frames(scene: Scene, snapshots, shown, path, title: str, view, settings: Settings, size: int):
    """Draw two or more snapshots, equal steps of time apart, to a WebP or GIF file; `view` as for `draw_snapshot`."""
    cache, panels, seen, times = geometry.MeshCache(scene), [], [], []
    for snapshot in snapshots:
        data = compose(cache, snapshot, shown, settings)
        panels.append(make_panel(cache, data))
        seen.append(replace(data, colours=data.colours[:0], poses=data.poses[:0]))
        times.append(snapshot.time)
    images, legend = render_panels(panels, view.eye, view.up, size), make_legend(scene, seen)
    drawn = [lay_out([image], [panel.title], title, legend) for image, panel in zip(images, panels)]
    write_animation(drawn, path, round(1000 * (times[-1] - times[0]) / (len(times) - 1)))


def draw_clashes(scene: Scene, result, path, title: str):
    """Draw a scene to a PNG file, with the faces, curves and names of a result's pairs that have contacts."""
    view, cache = make_view("y"), geometry.MeshCache(scene)
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

    The scene's LODs are what they were afterwards, its poses those of the picture: of a time [s], unless the file's
    `[picture]` has one, or those given, (n, 7). LODs (n,) are for one panel in the place of the file's.
    """
    scene, view = loaded.scene, loaded.picture
    time = time if view.time is None else view.time
    poses = loaded.motion.poses(time) if poses is None else poses
    shown = objects_to_draw(loaded.worlds, view.world, f"{loaded.path}: picture.")
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
