"""Images of triangles and lines by pyvista (VTK), off-screen, and figures of them, still or moving, by Matplotlib."""

from __future__ import annotations

import ctypes.util
import math
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from warp_abtree.app.styles import STAGE_LABELS
from warp_abtree.checks.atomic_write import atomic_write
from warp_abtree.lod.view import Camera
from warp_abtree.simulate.frame_row import FrameRow

BACKGROUND = (1.0, 1.0, 1.0)
VIEW_ANGLE = 25.0  # degrees
LEGEND_WIDTH = 190  # pixels of an entry
LINE_WIDTH = 2.5  # pixels
LINE_LIFT = 0.0015  # of the distance to the eye: lines are moved towards it by so much, before the faces they lie on
# Directions to the lights in the frame of the camera (right, up, towards the eye), and their strengths.
AMBIENT = 0.42
LIGHTS = (((-0.45, 0.75, 0.60), 0.58), ((0.80, 0.05, 0.45), 0.18))


@dataclass
class Panel:
    """One view of a scene."""

    title: str  # above it; may have several lines
    triangles: np.ndarray  # corners in the world [units], float64 (t, 3, 3)
    colours: np.ndarray  # of each triangle, float64 (t, 3), 0 to 1
    lines: list = field(default_factory=list)  # (ends in the world (k, 2, 3), colour) of each kind of line
    labels: list = field(default_factory=list)  # (point in the world, text) of each


def import_pyvista(what: str):
    """Return pyvista, silent; raise ValueError where `what` lacks it, Matplotlib, or an OpenGL without a display."""
    try:
        import matplotlib  # noqa: F401
        import pyvista
        from vtkmodules.vtkCommonCore import vtkLogger
    except ImportError:
        raise ValueError(f"{what} needs pyvista and Matplotlib: pip install pyvista matplotlib") from None
    # VTK ends the process where it finds none of these.
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        if not (ctypes.util.find_library("EGL") or ctypes.util.find_library("OSMesa")):
            raise ValueError(f"{what} needs a display, EGL or OSMesa (Debian: apt-get install libegl1)")
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)  # it warns of a display that is not there
    return pyvista


def camera_around(points, eye, up) -> Camera:
    """Return a camera that looks from the direction `eye` and sees all points (n, 3)."""
    lower, upper = points.min(axis=0), points.max(axis=0)
    centre = 0.5 * (lower + upper)
    radius = float(np.linalg.norm(points - centre, axis=1).max()) or 1.0
    angle = math.radians(VIEW_ANGLE)
    eye = centre + radius / math.sin(0.5 * angle) * np.asarray(eye) / np.linalg.norm(eye)
    return Camera.look_at(eye, centre, up, field_of_view=angle, size=(1, 1), far=100 * radius)


def render(panel: Panel, camera: Camera, size: int) -> np.ndarray:
    """Return an image of a panel, uint8 (size, size, 3)."""
    pyvista = import_pyvista("a picture")
    plotter = pyvista.Plotter(off_screen=True, window_size=(size, size), lighting="none")
    try:
        plotter.set_background(BACKGROUND)
        plotter.enable_anti_aliasing("ssaa")
        for direction, strength in LIGHTS:
            plotter.add_light(pyvista.Light(position=direction, intensity=strength, light_type="camera light"))
        faces = np.arange(3 * len(panel.triangles)).reshape(-1, 3)
        mesh = pyvista.PolyData.from_regular_faces(panel.triangles.reshape(-1, 3), faces)
        mesh.cell_data["colour"] = np.round(255 * panel.colours).astype(np.uint8)
        shading = {"ambient": AMBIENT, "diffuse": 1.0, "specular": 0.0, "lighting": True}
        edges = {"show_edges": True, "edge_color": "black", "edge_opacity": 0.3, "line_width": 1}
        plotter.add_mesh(mesh, scalars="colour", rgb=True, **shading, **edges)
        for ends, colour in panel.lines:
            if len(ends):
                points = np.asarray(ends, np.float64).reshape(-1, 3)
                lines = pyvista.line_segments_from_points(points + LINE_LIFT * (camera.eye - points))
                plotter.add_mesh(lines, color=colour, line_width=LINE_WIDTH, lighting=False)
        if panel.labels:
            places = np.array([point for point, _ in panel.labels])
            lifted, texts = places + LINE_LIFT * (camera.eye - places), [text for _, text in panel.labels]
            box = {"shape_color": BACKGROUND, "shape_opacity": 0.8, "margin": 3}
            plotter.add_point_labels(lifted, texts, font_size=16, show_points=False, always_visible=True, **box)
        view = plotter.camera
        view.position, view.focal_point, view.up = camera.eye, camera.eye - camera.view[2], camera.view[1]
        view.view_angle = math.degrees(camera.field_of_view)
        plotter.reset_camera_clipping_range()
        return plotter.screenshot(None, return_img=True)
    finally:
        plotter.close()


def render_panels(panels: list[Panel], eye, up, size: int) -> list:
    """Return images of panels, seen from the direction `eye` by one camera, less the empty margin that all share."""
    drawn = [part for panel in panels for part in (panel.triangles, *(ends for ends, _ in panel.lines))]
    camera = camera_around(np.concatenate([np.reshape(part, (-1, 3)) for part in drawn]), eye, up)
    images = [render(panel, camera, size) for panel in panels]
    filled = np.any([(image < 250).any(axis=2) for image in images], axis=0)
    if not filled.any():
        return images
    rows, columns = np.flatnonzero(filled.any(axis=1)), np.flatnonzero(filled.any(axis=0))
    y, x = max(rows[0] - 8, 0), max(columns[0] - 8, 0)
    return [image[y : rows[-1] + 9, x : columns[-1] + 9] for image in images]


def draw(panels: list[Panel], path, title: str, legend, eye, up, size: int = 620):
    """Write panels side by side, seen from `eye` by one camera, above a legend of (colour, label), to a PNG file."""
    images = render_panels(panels, eye, up, size)
    write_png(lay_out(images, [panel.title for panel in panels], title, legend), path)


def new_figure(size, **options):
    """Return an empty figure of Matplotlib of a size [inches]."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=100, facecolor=BACKGROUND, **options)
    FigureCanvasAgg(figure)
    return figure


def figure_image(figure) -> np.ndarray:
    """Return a figure as an image, uint8 (rows, columns, 3)."""
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[:, :, :3].copy()


def lay_out(images: list, titles: list[str], title: str, legend) -> np.ndarray:
    """Return images of one size side by side, with titles and a legend, uint8 (rows, columns, 3)."""
    import matplotlib.patches

    rows, columns = images[0].shape[:2]
    gap, head, panel_head = 16, 44 if title else 0, 50
    width = len(images) * columns + (len(images) + 1) * gap
    # Pairs of entries, plain and intersecting, stay side by side.
    entry = max([LEGEND_WIDTH, *(50 + 7 * len(label) for _, label in legend)])
    across = max(1, min(len(legend) // 2, width // (2 * entry)))
    foot = 40 + 20 * (-(-len(legend) // (2 * across)) - 1)
    height = head + panel_head + rows + foot
    figure = new_figure((width / 100, height / 100))
    middle: dict = {"ha": "center", "va": "center"}
    figure.text(0.5, 1 - 0.5 * head / height, title, **middle, fontsize=15, fontweight="bold", color="0.15")
    for i, (text, image) in enumerate(zip(titles, images)):
        left = gap + i * (columns + gap)
        axes = figure.add_axes((left / width, foot / height, columns / width, rows / height))
        axes.imshow(image, interpolation="nearest", aspect="auto")
        axes.set_axis_off()
        x, y = (left + 0.5 * columns) / width, 1 - (head + 0.5 * panel_head) / height
        figure.text(x, y, text, **middle, fontsize=10.5, color="0.25", linespacing=1.35)
    # The legend fills columns first.
    lines = [legend[i : i + 2 * across] for i in range(0, len(legend), 2 * across)]
    entries = [line[i] for i in range(2 * across) for line in lines if i < len(line)]
    handles = [matplotlib.patches.Patch(facecolor=colour, edgecolor="0.4", label=label) for colour, label in entries]
    look = {"frameon": False, "fontsize": 10.5, "borderaxespad": 0.6}
    figure.legend(handles=handles, loc="lower center", ncols=2 * across, **look)
    return figure_image(figure)


def write_png(image: np.ndarray, path):
    """Write an image as a PNG of 256 colours, less than half the size; the file appears whole or not."""
    import PIL.Image

    picture = PIL.Image.fromarray(image)
    picture = picture.quantize(256, PIL.Image.Quantize.MEDIANCUT, kmeans=1, dither=PIL.Image.Dither.NONE)
    with atomic_write(path) as file:
        picture.save(file, format="PNG", optimize=True)


def write_animation(images: list, path, milliseconds: int):
    """Write images as an animation that repeats, WebP or GIF by the name; the file appears whole or not."""
    import PIL.Image

    first, *others = (PIL.Image.fromarray(image) for image in images)
    kind = Path(path).suffix[1:].lower()
    options: dict = {"quality": 70, "method": 6} if kind == "webp" else {"optimize": True}
    with atomic_write(path) as file:
        first.save(file, kind.upper(), save_all=True, append_images=others, duration=milliseconds, loop=0, **options)


def draw_run(rows: list[FrameRow], fractions, path, title: str):
    """Draw LODs (fractions of the finest, (frames, n)), times by stage and certified error of a run to a PNG file."""
    figure = new_figure((10, 10), layout="constrained")
    figure.suptitle(title, fontsize=14, fontweight="bold", color="0.15")
    lods, times, errors = figure.subplots(3, 1, sharex=True)
    frames = np.array([row.frame for row in rows])

    low, tenth, middle, ninth, high = np.percentile(fractions, (0, 10, 50, 90, 100), axis=1)
    lods.fill_between(frames, low, high, color="C0", alpha=0.15, linewidth=0, label="all objects")
    lods.fill_between(frames, tenth, ninth, color="C0", alpha=0.35, linewidth=0, label="10 to 90 % of them")
    lods.plot(frames, middle, color="C0", label="median")
    lods.set(ylabel="LOD, relative to the finest", ylim=(-0.03 * high.max() - 1e-6, 1.05 * high.max() + 1e-6))

    stages = [[getattr(row, name) for row in rows] for name in STAGE_LABELS]
    cost = np.sum(stages[:4], axis=0)
    times.stackplot(frames, *stages, labels=STAGE_LABELS.values(), alpha=0.8, linewidth=0, step="mid")
    times.step(frames, cost, where="mid", color="black", linewidth=0.8, label="T': select to query")
    budgets = [row.budget_ms for row in rows if row.budget_ms is not None]
    if budgets:
        times.axhline(budgets[-1], color="red", linewidth=1, label=f"T = {budgets[-1]:g} ms")
        times.axhline(1.1 * budgets[-1], color="red", linewidth=1, linestyle=":", label="T + 10 %")
    # A single slow frame must not compress the rest.
    top = np.percentile(np.sum(stages, axis=0), 99)
    times.set(ylabel="time [ms]", ylim=(0, 1.25 * max(top, *budgets, 1e-6)))

    errors.plot(frames, [row.error_mean for row in rows], color="C3", label="mean of the objects")
    errors.plot(frames, [row.error_max for row in rows], color="C3", linestyle=":", label="greatest")
    errors.set(ylabel="certified error [world units]", xlabel="frame", xlim=(frames[0], max(frames[-1], 1)))
    errors.set_ylim(bottom=0)
    for axes in (lods, times, errors):
        axes.grid(True, alpha=0.3)
        axes.legend(fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    write_png(figure_image(figure), path)
