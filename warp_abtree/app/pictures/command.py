"""`warp-abtree picture`: a file of what `warp-abtree view` shows, still or moving, without a browser."""

from pathlib import Path

from warp_abtree.app.cli.arguments import Parser, positive_count
from warp_abtree.app.cli.report import check_output, print_result
from warp_abtree.app.pictures.render import import_pyvista
from warp_abtree.app.pictures.scenes import SIZE, SIZES, draw_frames, draw_snapshot
from warp_abtree.app.playback import add_playback_arguments, open_playback
from warp_abtree.app.render_data import Settings, Snapshot, objects_to_draw
from warp_abtree.app.scene_view import make_view
from warp_abtree.checks.arguments import whole_number

SUMMARY = "draw a scene or meshes to a PNG file, or a scene's frames to a WebP or GIF file"
EXAMPLES = (
    "scenes/bunny_tori.toml --frame 30 --out tori.png",
    "warp:bunny warp:bunny --lod 0.1 --out bunnies.png",
    "scenes/bunny_tori.toml --frames 60 --every 2 --out tori.webp",
    "warp:bunny warp:bunny --pose 2 0 0 0 0 0 1 --distances --out distance.png",
    "bunny.npz --lod tol:0.01 --eye 1 0.3 0.5 --out bunny.png",
)

# Bytes of an animation, all of whose pictures are held until it is written: in all, and of the meshes of a picture.
MEMORY_LIMIT, GEOMETRY = 2**32, 2**20


def add_arguments(sub: Parser):
    """Add the arguments of the command to its parser."""
    add_playback_arguments(sub)
    sub.add_file("--out", "-o", type=Path, required=True, metavar="FILE", help="PNG, or WebP or GIF, to write")
    sub.add_argument("--frame", type=int, default=0, metavar="N", help="frame of a scene to draw (0)")
    sub.add_argument("--frames", type=int, metavar="N", help="draw so many frames of a scene from there on")
    sub.add_argument("--every", type=positive_count, default=1, metavar="K", help="of these, draw each K-th (1)")
    for name, what in (("eye", "direction to the eye"), ("up", "direction upwards")):
        sub.add_argument(f"--{name}", nargs=3, type=float, metavar=("X", "Y", "Z"), help=f"{what} (the scene's own)")
    sub.add_flag("--distances", "draw distances between objects: of few all, of more those whose boxes overlap")
    sub.add_argument("--world", type=int, metavar="W", help="world to draw (the scene's own)")
    sub.add_argument("--size", type=positive_count, default=SIZE, metavar="PX", help=f"pixels along a side ({SIZE})")


def run_picture(options, progress):
    """Draw what the command line names."""
    import_pyvista("picture")
    _check(options)
    playback = open_playback(options.source, options.device, progress, options.objects, options.pose, options.lod)
    own = playback.view
    world = own.world if options.world is None else options.world
    up, eye = (own.up, options.eye or own.eye) if options.up is None else (options.up, options.eye)
    view, objects = make_view(up, eye, world), objects_to_draw(playback.worlds, world)
    settings = Settings(world, distances=options.distances)
    drawn = objects, options.out, playback.title, view, settings, options.size
    found = {"picture": str(options.out), "objects": len(objects)}
    if options.frames is None:
        snapshot = go_to(playback, options.frame, settings.output, progress)
        progress.close()
        draw_snapshot(playback.scene, snapshot, *drawn)
        print_result({**found, "frame": snapshot.number}, options.json)
        return
    frames = range(options.frame, options.frame + options.frames, options.every)
    draw_frames(playback.scene, run_frames(playback, frames, settings.output, progress), *drawn)
    progress.close()
    print_result({**found, "frames": len(frames)}, options.json)


def _check(options):
    """Refuse options that are wrong by themselves, before any work."""
    check_output(options.out, [".png"] if options.frames is None else [".webp", ".gif"], inputs=options.source)
    if options.frame < 0:
        raise ValueError(f"--frame: {options.frame} is below 0")
    if options.frames is not None and options.frames <= options.every:
        raise ValueError(f"--frames: {options.frames}, every {options.every}, is less than two to draw")
    whole_number(options.size, "--size", *SIZES)
    count = 0 if options.frames is None else -(-options.frames // options.every)
    if count * (3 * options.size**2 + GEOMETRY) > MEMORY_LIMIT:
        told = f"{count:,} pictures of {options.size} x {options.size} pixels take more than {MEMORY_LIMIT >> 30} GiB"
        raise ValueError(f"--frames: {told}; draw fewer by --every, or smaller ones by --size")


def run_frames(playback, frames: range, output, progress=None):
    """Yield the snapshots of frames, and run those between."""
    for number in range(frames[-1] + 1):
        snapshot = playback.step(output if number in frames else "count")
        if progress is not None:
            progress("frames", number + 1, frames[-1] + 1)
        if number in frames:
            yield snapshot


def go_to(playback, frame: int, output, progress=None) -> Snapshot:
    """Return the snapshot of a frame; a scene runs the frames before it."""
    return next(run_frames(playback, range(frame, frame + 1), output, progress)) if frame else playback.query(output)
