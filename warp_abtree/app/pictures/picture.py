"""Pictures without a browser: objects at their LODs and poses, faces that meet coloured, contacts, boxes of trees.

`warp-abtree picture` draws what `warp-abtree view` shows; in Python `draw_objects` draws any `Scene`.
"""

from pathlib import Path

import numpy as np

from warp_abtree.app.cli.report import check_output, print_json
from warp_abtree.app.pictures.plot import COLOURS, Camera, Panel, draw
from warp_abtree.app.viewer import render_data as parts
from warp_abtree.app.viewer.playback import Moment, RecordedSource, add_source_arguments, open_source
from warp_abtree.scene.scene import Scene

SUMMARY = "draw a scene, a recorded run or meshes to a PNG file"
EXAMPLES = (
    "scenes/bunny_tori.toml --frame 30 --out tori.png",
    "warp:bunny warp:bunny --lod 0.1 --contacts --out bunnies.png",
    "cow.obj --lod tol:0.01 --tree 6 --eye 1 0.3 0.5 --out cow.png",
)
CONTACT_COLOUR, NORMAL_COLOUR, BOX_COLOUR = (0.85, 0.10, 0.10), (0.45, 0.10, 0.60), (0.15, 0.35, 0.80)
LINE_WIDTH, LINE_LIFT = 0.006, 0.006  # parts of the radius of what is shown
SIZE = 800  # pixels


def ribbons(lines, camera: Camera, width: float) -> np.ndarray:
    """Return lines as flat strips that face the eye, a little before where they are, float64 (2 k, 3, 3).

    Args:
        lines: Ends in the world, (k, 2, 3).
        width: Of a strip [units].
    """
    lines = np.asarray(lines, np.float64)
    eye = camera.centre + camera.distance * camera.frame[2]
    view = eye - lines.mean(axis=1)
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    side = np.cross(lines[:, 1] - lines[:, 0], view)
    length = np.linalg.norm(side, axis=1, keepdims=True)
    # A line towards the eye, or of no length, is seen as a dot.
    flat = length[:, 0] <= 1e-12 * camera.radius
    side = np.where(flat[:, None], camera.frame[0], side / np.where(length > 0, length, 1.0)) * (0.5 * width)
    lines = np.where(flat[:, None, None], lines.mean(axis=1, keepdims=True), lines)
    lines = lines + (LINE_LIFT * camera.radius * view)[:, None]
    along = np.cross(view, side) * flat[:, None]
    a, b = lines[:, 0] - along, lines[:, 1] + along
    first, second = np.stack([a - side, b - side, b + side], axis=1), np.stack([a - side, b + side, a + side], axis=1)
    return np.concatenate([first, second])


def make_panel(scene: Scene, moment: Moment, objects, eye, up, contacts=False, normals=False, level=None):
    """Return a `Panel` of some objects of a scene, and its legend.

    Args:
        scene: `Scene`.
        moment: `Moment` of it, whose result has faces, and contacts where they are drawn.
        objects: Indices of those drawn, rising.
        eye, up: Directions to the eye and upwards in the world.
        contacts, normals: Whether segments of contacts and their normals are drawn.
        level: Of the boxes of trees; None for none.
    """
    cache = parts.MeshCache(scene)
    inside = np.zeros(scene.object_count, bool)
    inside[objects] = True
    struck = parts.struck_faces(moment.result, inside)
    owner = np.array(scene.object_model)
    triangles, colours, legend = [], [], []
    for key, members in parts.group_objects(parts.mesh_keys(scene, moment.lods), np.asarray(objects)).items():
        vertices, faces, face_ids = cache.mesh(*parts.split_key(key))
        corners = np.repeat(vertices[faces][None], len(members), axis=0).reshape(-1, 3, 3)
        triangles.append(parts.place_each(moment.poses, np.repeat(members, len(faces)), corners))
        hit = np.zeros((len(members), len(faces)), bool)
        rows = np.isin(struck[:, 0], members)
        hit[np.searchsorted(members, struck[rows, 0]), np.searchsorted(face_ids, struck[rows, 1])] = True
        plain, bright = COLOURS[parts.split_key(key)[0] % len(COLOURS)]
        colours.append(np.where(hit.reshape(-1, 1), bright, plain))
    count = sum(map(len, triangles))
    points = np.concatenate(triangles).reshape(-1, 3)
    for i in dict.fromkeys(owner[objects].tolist()):
        plain, bright = COLOURS[i % len(COLOURS)]
        name = scene.models[i].name
        legend.append((plain, name))
        if (owner[struck[:, 0]] == i).any():
            legend.append((bright, f"{name}, intersecting"))
    camera = Camera.around(points, eye, up)
    boxes, box_count = np.empty((0, 2, 3)), 0
    if level is not None:
        boxes, box_count = parts.tree_lines(scene, moment, objects, level)
    found = np.empty((2, 0, 2, 3))
    if contacts or normals:
        found = parts.contact_lines(moment.result, parts.normal_length(cache, objects), inside)
    layers = [(contacts, found[0], CONTACT_COLOUR, "contacts"), (normals, found[1], NORMAL_COLOUR, "normals")]
    layers.append((level is not None, boxes, BOX_COLOUR, f"active nodes at level {level}"))
    for asked, lines, colour, label in layers:
        if asked:
            strips = ribbons(lines, camera, LINE_WIDTH * camera.radius)
            triangles.append(strips)
            colours.append(np.tile(colour, (len(strips), 1)))
            legend.append((colour, label))
    title = f"{len(objects):,} object{'' if len(objects) == 1 else 's'}, {count:,} faces"
    pairs = moment.result.pairs
    shown = inside[pairs].all(axis=1) if len(pairs) else np.zeros(0, bool)
    second = f"{int(moment.result.count[shown].sum()):,} intersecting face pairs"
    if level is not None:
        second += f", {box_count:,} boxes"
    return Panel(f"{title}\n{second}", np.concatenate(triangles), np.concatenate(colours)), legend


def draw_objects(scene: Scene, poses, path, title="", objects=None, eye=(0.4, 0.35, 1.0), up=(0, 1, 0), **options):
    """Draw objects of a scene at its LODs to a PNG file, faces that meet coloured on both.

    The scene's poses are those of the picture afterwards.

    Args:
        scene: `Scene`.
        poses: Of every object, x y z and a quaternion x y z w, (n, 7).
        path: File to write.
        title: Above.
        objects: Indices of those drawn; None for all. Faces that meet others are not coloured.
        eye, up: Directions to the eye and upwards in the world.
        options: contacts, normals, level: as for `make_panel`; size: pixels along a side.

    Raises:
        ValueError: Bad poses, or an object that is none.
    """
    size = options.pop("size", SIZE)
    objects = np.arange(scene.object_count) if objects is None else np.unique(objects)
    if not len(objects) or objects[0] < 0 or objects[-1] >= scene.object_count:
        raise ValueError(f"objects: from {scene.object_count} objects none is chosen, or one that there is not")
    scene.set_poses(poses)
    output = "contacts" if options.get("contacts") or options.get("normals") else "faces"
    result = scene.intersect(output=output)
    moment = Moment(0, 0.0, np.asarray(poses, np.float64), scene.lods, result, None)
    panel, legend = make_panel(scene, moment, objects, eye, up, **options)
    draw([panel], path, title, legend, eye, up, size)


# The command.


def add_arguments(sub, positive):
    """Add the arguments of the command to its parser; `positive` is the type of whole numbers from 1."""
    add_source_arguments(sub, positive)
    sub.add_argument("--out", "-o", type=Path, required=True, metavar="PNG", help="file to write")
    sub.add_argument("--frame", type=int, default=0, metavar="N", help="frame of a scene or recording to draw (0)")
    sub.add_argument("--contacts", action="store_true", help="draw the segments in which faces meet")
    sub.add_argument("--normals", action="store_true", help="draw the normals of contacts")
    sub.add_argument("--tree", type=int, metavar="LEVEL", help="draw the boxes of the active nodes at a level of trees")
    for name, what in (("eye", "direction to the eye"), ("up", "direction upwards")):
        sub.add_argument(f"--{name}", nargs=3, type=float, metavar=("X", "Y", "Z"), help=f"{what} (the scene's own)")
    sub.add_argument("--world", type=int, metavar="W", help="world to draw (the scene's own)")
    sub.add_argument("--size", type=positive, default=SIZE, metavar="PX", help=f"pixels along a side ({SIZE})")


def picture(options, progress):
    """Draw a picture."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise ValueError("picture needs Matplotlib: pip install matplotlib") from None
    check_output(options.out, [".png"], inputs=options.source)
    for name, low in (("frame", 0), ("tree", 0)):
        value = getattr(options, name)
        if value is not None and value < low:
            raise ValueError(f"--{name}: {value} is below {low}")
    if not 50 <= options.size <= 8000:
        raise ValueError(f"--size: {options.size} is outside 50 .. 8000")
    named = {"objects": options.objects, "poses": options.pose, "lod": options.lod}
    source = open_source(options.source, options.device, progress, **named)
    eye = source.look.eye if options.eye is None else options.eye
    up = source.look.up if options.up is None else options.up
    if not np.isfinite([*eye, *up]).all() or not np.linalg.norm(np.cross(eye, up)) > 1e-6:
        raise ValueError("--eye: eye and up are not finite, of no length, or point the same way")
    world = source.look.world if options.world is None else options.world
    objects = np.flatnonzero((source.worlds == world) | (source.worlds == -1))
    if not len(objects):
        raise ValueError(f"--world: no object is in world {world}")
    deepest = parts.tree_depth(source.scene, objects)
    if options.tree is not None and options.tree > deepest:
        raise ValueError(f"--tree: the deepest tree ends at level {deepest}")
    moment = go_to(source, options.frame, "contacts" if options.contacts or options.normals else "faces", progress)
    progress.close()
    shown = {"contacts": options.contacts, "normals": options.normals, "level": options.tree}
    panel, legend = make_panel(source.scene, moment, objects, eye, up, **shown)
    draw([panel], options.out, source.title, legend, eye, up, options.size)
    if options.json:
        print_json({"picture": str(options.out), "objects": len(objects), "frame": moment.number})
    else:
        print(f"wrote {options.out}")


def go_to(source, frame: int, output, progress=None) -> Moment:
    """Return the moment of a frame: those before it run, as far as the source runs.

    Raises:
        ValueError: A recording that is not that long.
    """
    if isinstance(source, RecordedSource):
        if frame >= source.length:
            raise ValueError(f"--frame: the recording has {source.length} frames, from 0")
        source.seek(frame)
        return source.again(output)
    if frame == 0:
        return source.again(output)
    for done in range(frame + 1):
        moment = source.step(output if done == frame else "count")
        if progress is not None:
            progress("frames", done + 1, frame + 1)
    return moment
