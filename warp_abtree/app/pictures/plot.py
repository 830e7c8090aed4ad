"""Pictures of scenes with their intersecting faces coloured; Matplotlib writes them, a small z-buffer draws them.

Objects interpenetrate here, where sorting faces by depth fails, so visibility is decided pixel by pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_abtree.checks.atomic_write import atomic_write
from warp_abtree.scene.scene import Scene
from warp_abtree.simulate.frame import FrameRow

# Plain and intersecting faces, by model in the order of the scene.
COLOURS = (
    ((0.80, 0.76, 0.71), (0.06, 0.74, 0.25)),
    ((0.30, 0.50, 0.78), (1.00, 0.87, 0.12)),
    ((0.84, 0.50, 0.37), (0.97, 0.22, 0.60)),
    ((0.56, 0.48, 0.74), (0.20, 0.88, 0.94)),
)
BACKGROUND = (1.0, 1.0, 1.0)
SAMPLES = 2  # along each side of a pixel
LEGEND_WIDTH = 190  # pixels of an entry
CHUNK = 200_000  # candidate pixels at once
# Directions to the lights in the eye's frame (right, up, towards the eye), and their strengths.
AMBIENT = 0.42
LIGHTS = (((-0.45, 0.75, 0.60), 0.58), ((0.80, 0.05, 0.45), 0.18))


@dataclass
class Panel:
    """One view of a scene: coloured triangles in the world.

    Attributes:
        title: Above it; may have several lines.
        triangles: Corners [units], float64 (t, 3, 3).
        colours: Colour of each before light, float64 (t, 3), 0 to 1.
    """

    title: str
    triangles: np.ndarray
    colours: np.ndarray


def place(pose, points) -> np.ndarray:
    """Return points (n, 3) of a model where a pose x y z qx qy qz qw puts them."""
    x, y, z, w = np.asarray(pose[3:], np.float64) / np.linalg.norm(pose[3:])
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    return points @ rotation.T + pose[:3]


def make_panel(scene: Scene, poses, objects, subject=None) -> Panel:
    """Pose a scene, find the intersecting faces of some of its objects, and colour them.

    Args:
        scene: `Scene` at the LODs to draw.
        poses: Pose of every object, (n, 7).
        objects: Indices of the objects drawn.
        subject: Index of the model whose LOD and faces the title names; None for the objects together.
    """
    scene.set_poses(poses)
    objects = np.asarray(objects)
    pairs = scene.broad_phase()
    pairs = pairs[np.isin(pairs, objects).all(axis=1)]
    result = scene.intersect(pairs, output="faces")
    owner = np.array(scene.object_model)
    triangles, colours = [], []
    shown: dict[int, int] = {}
    hit_faces: dict[int, int] = {}
    for i in objects:
        model = scene.models[owner[i]]
        vertices, faces, face_ids = model.mesh_at(int(scene.lods[i]))
        hit = np.zeros(model.face_count, bool)
        for side in (0, 1):
            mine = pairs[result.faces[:, 0], side] == i if len(pairs) else np.zeros(0, bool)
            hit[result.faces[mine, 1 + side]] = True
        plain, struck = COLOURS[owner[i] % len(COLOURS)]
        triangles.append(place(poses[i], vertices)[faces])
        colours.append(np.where(hit[face_ids][:, None], struck, plain))
        shown[owner[i]] = shown.get(owner[i], 0) + len(face_ids)
        hit_faces[owner[i]] = hit_faces.get(owner[i], 0) + int(hit.sum())
    count = len(result.faces)
    if subject is None or subject not in shown:
        first = f"{len(objects)} objects, {sum(shown.values()):,} faces"
    else:
        lods = np.unique(scene.lods[objects[owner[objects] == subject]])
        span = f"{lods[0]:,}" if len(lods) == 1 else f"{lods[0]:,} to {lods[-1]:,}"
        first = (
            f"{scene.models[subject].name} at LOD {span} of {scene.models[subject].lod_max:,}: {shown[subject]:,} faces"
        )
    second = f"{count:,} intersecting face pairs"
    if subject in hit_faces:
        second += f", {hit_faces[subject]:,} faces of the {scene.models[subject].name}"
    return Panel(f"{first}\n{second}", np.concatenate(triangles), np.concatenate(colours))


# From triangles to pixels.


@dataclass(frozen=True)
class Camera:
    """A pinhole far enough away to see a ball.

    Attributes:
        frame: Rows right, up, towards the eye, (3, 3).
        centre, radius: The ball [units].
        distance: From the eye to the centre [units].
    """

    frame: np.ndarray
    centre: np.ndarray
    radius: float
    distance: float

    @classmethod
    def around(cls, points, eye, up) -> Camera:
        """Return a camera that looks from a direction and sees all points (n, 3)."""
        back = np.asarray(eye, np.float64) / np.linalg.norm(eye)
        right = np.cross(up, back)
        right /= np.linalg.norm(right)
        frame = np.stack([right, np.cross(back, right), back])
        centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
        radius = float(np.linalg.norm(points - centre, axis=1).max()) or 1.0
        return cls(frame, centre, radius, 4.5 * radius)

    def project(self, points):
        """Return image coordinates (n, 2), y up, and the inverse distance along the view (n,), linear in the image."""
        local = (points - self.centre) @ self.frame.T
        inverse = 1.0 / (self.distance - local[:, 2])
        return local[:, :2] * (inverse * self.distance)[:, None], inverse


def _candidates(corner, width, height):
    """Yield (triangle, x, y) of every pixel in each triangle's box, in chunks of whole triangles."""
    low = np.maximum(np.floor(corner.min(axis=1)).astype(int), 0)
    high = np.minimum(np.ceil(corner.max(axis=1)).astype(int) + 1, (width, height))
    span = np.maximum(high - low, 0)
    size = span[:, 0] * span[:, 1]
    total = np.cumsum(size)
    begin = 0
    while begin < len(size):
        done = total[begin - 1] if begin else 0
        end = max(begin + 1, int(np.searchsorted(total, done + CHUNK, side="right")))
        here = np.arange(begin, end)
        triangle = np.repeat(here, size[here])
        step = np.arange(len(triangle)) - np.repeat(total[here] - size[here] - done, size[here])
        yield triangle, low[triangle, 0] + step % span[triangle, 0], low[triangle, 1] + step // span[triangle, 0]
        begin = end


def _weights(corner, x, y):
    """Return barycentric weights of pixel centres in triangles (k, 3, 2), shape (k, 3); the triangles have an area."""
    px, py = x + 0.5, y + 0.5
    (ax, ay), (bx, by), (cx, cy) = (corner[:, i].T for i in range(3))
    double = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    u = ((bx - px) * (cy - py) - (by - py) * (cx - px)) / double
    v = ((cx - px) * (ay - py) - (cy - py) * (ax - px)) / double
    return np.stack([u, v, 1.0 - u - v], axis=1)


def rasterise(corner, inverse, width, height):
    """Return the foremost triangle of every pixel and its inverse depth, (height, width); -1 and 0 where there is none.

    Args:
        corner: Pixel coordinates, y down, (t, 3, 2).
        inverse: Inverse depth of each corner, above 0, (t, 3).
    """
    front = np.full(width * height, -1, np.int64)
    depth = np.zeros(width * height)
    (ax, ay), (bx, by), (cx, cy) = (corner[:, i].T for i in range(3))
    solid = np.flatnonzero(np.abs((bx - ax) * (cy - ay) - (by - ay) * (cx - ax)) > 1e-9)
    for triangle, x, y in _candidates(corner[solid], width, height):
        triangle = solid[triangle]
        weights = _weights(corner[triangle], x, y)
        inside = (weights >= 0).all(axis=1)
        triangle, pixel = triangle[inside], (y * width + x)[inside]
        near = np.einsum("ij,ij->i", weights[inside], inverse[triangle])
        np.maximum.at(depth, pixel, near)
        foremost = near == depth[pixel]
        front[pixel[foremost]] = triangle[foremost]
    return front.reshape(height, width), depth.reshape(height, width)


def _shade(panel: Panel, camera: Camera) -> np.ndarray:
    """Return lit colours of all triangles, (t, 3); surfaces have no inside, so normals face the eye."""
    local = (panel.triangles - camera.centre) @ camera.frame.T
    normal = np.cross(local[:, 1] - local[:, 0], local[:, 2] - local[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal /= np.where(length > 0, length, 1.0)
    view = np.array([0.0, 0.0, camera.distance]) - local.mean(axis=1)
    normal *= np.where(np.einsum("ij,ij->i", normal, view) < 0, -1.0, 1.0)[:, None]
    light = np.full(len(normal), AMBIENT)
    for direction, strength in LIGHTS:
        direction = np.array(direction) / np.linalg.norm(direction)
        light += strength * np.maximum(normal @ direction, 0.0)
    return np.clip(panel.colours * light[:, None], 0.0, 1.0)


def render(panel: Panel, camera: Camera, size: int) -> np.ndarray:
    """Return an image of a panel, float64 (size, size, 3), 0 to 1."""
    fine = size * SAMPLES
    flat, inverse = camera.project(panel.triangles.reshape(-1, 3))
    scale = 0.5 * fine / camera.radius
    corner = (flat * (scale, -scale) + 0.5 * fine).reshape(-1, 3, 2)
    front, _ = rasterise(corner, inverse.reshape(-1, 3), fine, fine)
    image = np.empty((fine, fine, 3))
    image[:] = BACKGROUND
    y, x = np.nonzero(front >= 0)
    triangle = front[y, x]
    image[y, x] = _shade(panel, camera)[triangle] * _edges(corner[triangle], x, y)[:, None]
    return image.reshape(size, SAMPLES, size, SAMPLES, 3).mean(axis=(1, 3))


def _edges(corner, x, y):
    """Return a factor that darkens pixels near an edge of their triangle, less where triangles are small."""
    side = np.linalg.norm(np.roll(corner, -1, axis=1) - np.roll(corner, -2, axis=1), axis=2)
    (ax, ay), (bx, by), (cx, cy) = (corner[:, i].T for i in range(3))
    double = np.abs((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))
    height = double[:, None] / np.maximum(side, 1e-12)
    distance = (_weights(corner, x, y) * height).min(axis=1) / SAMPLES
    strength = np.clip(0.03 * np.sqrt(double) / SAMPLES, 0.10, 0.40)
    return 1.0 - strength * np.clip(1.0 - (distance - 0.35) / 0.4, 0.0, 1.0)


def draw(panels: list[Panel], path, title: str, legend, eye, up, size: int = 620):
    """Write panels side by side, seen by one camera, to a PNG file.

    Args:
        panels: `Panel`s of the same place.
        path: File to write.
        title: Above all panels.
        legend: (colour, label) of each entry below.
        eye, up: Directions to the eye and upwards in the world.
        size: Pixels along a panel's side.
    """
    import matplotlib.patches
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    camera = Camera.around(np.concatenate([panel.triangles.reshape(-1, 3) for panel in panels]), eye, up)
    images = _crop([render(panel, camera, size) for panel in panels])
    rows, columns = images[0].shape[:2]
    gap, head, panel_head = 16, 44, 50
    width = len(panels) * columns + (len(panels) + 1) * gap
    # Pairs of entries, plain and intersecting, stay side by side.
    across = max(1, min(len(legend) // 2, width // (2 * LEGEND_WIDTH)))
    foot = 40 + 20 * (-(-len(legend) // (2 * across)) - 1)
    height = head + panel_head + rows + foot
    dpi = 100
    figure = Figure(figsize=(width / dpi, height / dpi), dpi=dpi, facecolor=BACKGROUND)
    canvas = FigureCanvasAgg(figure)
    figure.text(
        0.5, 1 - 0.5 * head / height, title, ha="center", va="center", fontsize=15, fontweight="bold", color="0.15"
    )
    for i, (panel, image) in enumerate(zip(panels, images)):
        left = gap + i * (columns + gap)
        axes = figure.add_axes((left / width, foot / height, columns / width, rows / height))
        axes.imshow(image, interpolation="nearest", aspect="auto")
        axes.set_axis_off()
        where = (left + 0.5 * columns) / width, 1 - (head + 0.5 * panel_head) / height
        figure.text(*where, panel.title, ha="center", va="center", fontsize=10.5, color="0.25", linespacing=1.35)
    # The legend fills columns first.
    lines = [legend[i : i + 2 * across] for i in range(0, len(legend), 2 * across)]
    entries = [line[i] for i in range(2 * across) for line in lines if i < len(line)]
    handles = [matplotlib.patches.Patch(facecolor=colour, edgecolor="0.4", label=label) for colour, label in entries]
    figure.legend(
        handles=handles, loc="lower center", ncols=2 * across, frameon=False, fontsize=10.5, borderaxespad=0.6
    )
    _write_png(canvas, path)


def _write_png(canvas, path):
    """Write a canvas as a PNG of 256 colours, less than half the size; the file appears whole or not at all."""
    import PIL.Image

    canvas.draw()
    image = PIL.Image.fromarray(np.asarray(canvas.buffer_rgba())[:, :, :3].copy())
    image = image.quantize(256, PIL.Image.Quantize.MEDIANCUT, kmeans=1, dither=PIL.Image.Dither.NONE)
    with atomic_write(path) as file:
        image.save(file, format="PNG", optimize=True)


def _crop(images):
    """Cut the empty margin that all images share, and leave a little."""
    drawn = np.any([np.abs(image - BACKGROUND).max(axis=2) > 0.02 for image in images], axis=0)
    if not drawn.any():
        return images
    rows, columns = np.flatnonzero(drawn.any(axis=1)), np.flatnonzero(drawn.any(axis=0))
    y, x = max(rows[0] - 8, 0), max(columns[0] - 8, 0)
    return [image[y : rows[-1] + 9, x : columns[-1] + 9] for image in images]


def panel_lods(loaded) -> list[np.ndarray]:
    """Return the LODs of all objects in each panel: both ends of the sweeps, or what the file's [picture] asks for."""
    fractions = [loaded.picture.lods or [sweep.start, sweep.turn] for sweep in loaded.sweeps]
    chosen = [loaded.base_lods.copy() for _ in range(len(fractions[0]) if fractions else 1)]
    for sweep, parts in zip(loaded.sweeps, fractions):
        for lods, part in zip(chosen, parts):
            sweep.apply(part, lods)
    return chosen


def draw_scene(loaded, path, time: float, poses=None, lods=None):
    """Draw a scene file's picture at one time and several LODs: both sides of an LOD switch, the same poses.

    The scene's LODs are what they were afterwards, its poses those of the picture.

    Args:
        loaded: What `load_scene` returned.
        path: PNG file to write.
        time: Time of the poses [s], unless the file's `[picture]` has one.
        poses: Pose of every object, (n, 7), in the place of those of the time.
        lods: LOD of every object, (n,), for one panel in the place of the file's.

    Raises:
        ValueError: The world to draw has no object.
    """
    scene, picture = loaded.scene, loaded.picture
    time = time if picture.time is None else picture.time
    poses = loaded.motion.poses(time) if poses is None else poses
    objects = np.flatnonzero((loaded.worlds == picture.world) | (loaded.worlds == -1))
    if len(objects) == 0:
        raise ValueError(f"{loaded.path}: picture.world: no object is in world {picture.world}")
    owner = np.array(scene.object_model)
    swept = [model for sweep in loaded.sweeps for model, indices in sweep.objects if np.isin(indices, objects).any()]
    subject = next((i for i, model in enumerate(scene.models) if swept and model is swept[0]), None)
    before, panels = scene.lods, []
    try:
        for shown in panel_lods(loaded) if lods is None else [lods]:
            scene.set_lods(shown)
            panels.append(make_panel(scene, poses, objects, subject))
    finally:
        scene.set_lods(before)
    legend = []
    for i in dict.fromkeys(owner[objects].tolist()):
        plain, struck = COLOURS[i % len(COLOURS)]
        name = scene.models[i].name
        legend += [(plain, name), (struck, f"{name}, intersecting")]
    draw(panels, path, loaded.title, legend, picture.eye, picture.up)


# Runs.

STAGE_LABELS = {
    "select_ms": "select",
    "refine_ms": "refine",
    "broad_ms": "broad phase",
    "query_ms": "query",
    "move_ms": "move",
    "answer_ms": "answer",
}


def draw_run(rows: list[FrameRow], parts, path, title: str):
    """Draw LODs, times by stage and certified error of a run over its frames, to a PNG file.

    Args:
        rows: One a frame.
        parts: LOD of every object over its finest, (frames, n).
        path: File to write.
        title: Above.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 10), dpi=100, facecolor=BACKGROUND, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    lods, times, errors = figure.subplots(3, 1, sharex=True)
    figure.suptitle(title, fontsize=14, fontweight="bold", color="0.15")
    frames = np.array([row.frame for row in rows])

    low, tenth, middle, ninth, high = np.percentile(parts, (0, 10, 50, 90, 100), axis=1)
    lods.fill_between(frames, low, high, color="C0", alpha=0.15, linewidth=0, label="all objects")
    lods.fill_between(frames, tenth, ninth, color="C0", alpha=0.35, linewidth=0, label="10 to 90 % of them")
    lods.plot(frames, middle, color="C0", label="median")
    lods.set(ylabel="LOD, part of the finest", ylim=(-0.03 * high.max() - 1e-6, 1.05 * high.max() + 1e-6))

    stages = [[getattr(row, name) for row in rows] for name in STAGE_LABELS]
    cost = np.sum(stages[:4], axis=0)
    times.stackplot(frames, *stages, labels=STAGE_LABELS.values(), alpha=0.8, linewidth=0, step="mid")
    times.step(frames, cost, where="mid", color="black", linewidth=0.8, label="T': select to query")
    budgets = [row.budget_ms for row in rows if row.budget_ms is not None]
    if budgets:
        times.axhline(budgets[-1], color="red", linewidth=1, label=f"T = {budgets[-1]:g} ms")
        times.axhline(1.1 * budgets[-1], color="red", linewidth=1, linestyle=":", label="T + 10 %")
    # One hitch must not flatten the rest.
    top = np.percentile(np.sum(stages, axis=0), 99)
    times.set(ylabel="time [ms]", ylim=(0, 1.25 * max(top, *budgets, 1e-6)))

    errors.plot(frames, [row.error_mean for row in rows], color="C3", label="mean of the objects")
    errors.plot(frames, [row.error_max for row in rows], color="C3", linestyle=":", label="greatest")
    errors.set(ylabel="certified error [world units]", xlabel="frame", xlim=(frames[0], max(frames[-1], 1)))
    errors.set_ylim(bottom=0)
    for axes in (lods, times, errors):
        axes.grid(True, alpha=0.3)
        axes.legend(fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    _write_png(canvas, path)


# Colours that are told apart with any colour vision (Okabe and Ito 2008), dashes, and widths, by controller.
CONTROLLER_STYLES = {
    "none": ("finest LODs", "0.45", "-", 0.9),
    "coarsest": ("coarsest LODs", "0.45", ":", 1.2),
    "tolerance": ("tolerance", "#009E73", "-", 1.0),
    "paper": ("paper's controller", "#D55E00", "-", 1.0),
    "predictive": ("predictive controller", "#0072B2", "-", 1.4),
}


def draw_controllers(runs: dict[str, list[FrameRow]], budget_ms: float, path, title: str):
    """Draw what several controllers made of one scene, to a PNG file: frame times about T, faces, certified error.

    Args:
        runs: Rows of a run by controller: "predictive", "paper", "tolerance", "none" (finest LODs), "coarsest".
        budget_ms: T [ms].
        path: File to write.
        title: Above.

    Raises:
        ValueError: No run, or one of an unknown controller.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    unknown = set(runs) - set(CONTROLLER_STYLES)
    if unknown or not runs:
        raise ValueError(f"runs: {sorted(unknown)} are none of {', '.join(CONTROLLER_STYLES)}, or there are none")
    figure = Figure(figsize=(9, 8.4), dpi=100, facecolor=BACKGROUND, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    times, faces, errors = figure.subplots(3, 1, sharex=True, height_ratios=(1.5, 1.0, 1.0))
    figure.suptitle(title, fontsize=13, fontweight="bold", color="0.15")
    most = max(row.faces for rows in runs.values() for row in rows)
    for name, (label, colour, dash, width) in CONTROLLER_STYLES.items():
        rows = runs.get(name)
        if rows is None:
            continue
        style = {"color": colour, "linestyle": dash, "linewidth": width, "label": label}
        frames = [row.frame for row in rows]
        times.plot(frames, [row.cost_ms for row in rows], **style)
        faces.plot(frames, [100 * row.faces / most for row in rows], **style)
        errors.plot(frames, [row.error_mean for row in rows], **style)
    times.axhspan(budget_ms, 1.1 * budget_ms, color="#F0E442", alpha=0.7, linewidth=0, label="T to T + 10 %")
    times.axhline(budget_ms, color="black", linewidth=0.9, label=f"T = {budget_ms:.3g} ms")
    costs = np.array([row.cost_ms for rows in runs.values() for row in rows])
    # A hitch, and frames before anything has come together, must not flatten the rest.
    times.set(
        yscale="log", ylim=(max(costs.min(), budget_ms / 10) / 1.15, 1.3 * max(np.percentile(costs, 99.5), budget_ms))
    )
    times.set_ylabel("frame time T' [ms]")
    faces.set(yscale="log", ylabel="faces of all objects\n[% of the finest]")
    errors.set(ylabel="certified error, mean\nof the objects [world units]")
    errors.set_xlabel("frame")
    errors.set_ylim(bottom=0)
    plain = FuncFormatter(lambda value, _: f"{value:g}")
    for axes, steps in ((times, (1, 2, 5)), (faces, (1, 3))):
        axes.yaxis.set_major_locator(LogLocator(subs=steps))
        axes.yaxis.set_major_formatter(plain)
        axes.yaxis.set_minor_formatter(NullFormatter())
    for axes in (times, faces, errors):
        axes.set_xlim(0, max(max(row.frame for row in rows) for rows in runs.values()) or 1)
        axes.grid(True, alpha=0.3)
    handles, labels = times.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize="small")
    _write_png(canvas, path)
