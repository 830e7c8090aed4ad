"""`warp-abtree sweep`: a pair of models at millions of poses, or the worlds of a scene, into shards; on Ray or not."""

import contextlib
import importlib.util
import sys
import time
from pathlib import Path

from warp_abtree.app.cli.arguments import PRECISIONS, Parser, positive
from warp_abtree.app.cli.model_commands import load_model
from warp_abtree.app.cli.report import print_json
from warp_abtree.app.toml.scene_file import load_scene
from warp_abtree.jobs import RayPool, SweepJob, ThisProcess, WorldsJob, run_shards
from warp_abtree.simulate.frame import resolve_lod

SUMMARY = "ask a pair of models at millions of poses, or run the worlds of a scene, into shards"
EXAMPLES = (
    "cow.npz cow.npz poses.npy --out answers",
    "cow.npz tool.npz poses.npy --output contacts --file parquet --workers 2 --out contacts",
    "worlds --frames 60 --ray ray://head:10001 --out counts",
)
OUTPUTS = ("any", "count", "faces", "contacts", "poses")
SHARDS = {"poses": 65536, "worlds": 64}


def add_arguments(sub: Parser):
    """Add the arguments of the command to its parser."""
    sub.add_file(
        "source",
        nargs="+",
        metavar="SCENE_OR_MODELS",
        help="two meshes or models and POSES.npy, (p, 7) poses of the second in the frame of the first; or a scene of "
        "two objects and POSES.npy; or a scene alone, whose worlds are run",
    )
    sub.add_file("--out", "-o", type=Path, required=True, metavar="DIR", help="folder to make, or to go on in")
    sub.add_argument("--output", choices=OUTPUTS, help="what to ask (any); of worlds count or poses (count)")
    sub.add_argument("--precision", choices=PRECISIONS, default="exact", help="as query (exact)")
    for name in ("a", "b"):
        sub.add_argument(f"--lod-{name}", metavar="LOD", help=f"LOD of {name.upper()}, as query (finest)")
    sub.add_file("--lods", type=Path, metavar="LODS.npy", help="LODs of both at each pose, (p, 2)")
    sub.add_argument("--frames", type=positive, metavar="N", help="frames to run worlds (the scene's own number)")
    sub.add_argument("--objects", type=positive, metavar="N", help="about so many objects, as run")
    sub.add_argument("--shard", type=positive, metavar="N", help="poses (65536) or worlds (64) a file")
    sub.add_argument("--file", choices=("npz", "parquet"), default="npz", help="kind of the files (npz)")
    sub.add_argument(
        "--ray",
        metavar="ADDRESS",
        help='of a Ray cluster (Ray is started here). "none": this process, with --device cuda:0,cuda:1 on two',
    )
    sub.add_argument("--workers", type=positive, metavar="N", help="Ray workers (as many as GPUs, or else CPU cores)")


def sweep(options, progress):
    """Do a sweep, or worlds, into shards."""
    begin = time.perf_counter()
    job = _make_job(options, progress)
    with_ray = options.ray != "none"
    if with_ray and importlib.util.find_spec("ray") is None:
        if options.ray or options.workers:
            raise ValueError("--ray and --workers need Ray: pip install ray")
        print("Ray is not installed (pip install ray): this process does all shards", file=sys.stderr)
        with_ray = False
    if with_ray and options.device:
        raise ValueError("--device: Ray places workers on GPUs, or CPUs where there is none; it goes with --ray none")
    if not with_ray and options.workers:
        raise ValueError("--workers: they are Ray's")
    named = {"file": options.file, "progress": progress}
    if with_ray:
        # Ray tells of workers that end on stdout, which is for what this command prints.
        with contextlib.redirect_stdout(sys.stderr), RayPool(options.ray, options.workers) as pool:
            done = run_shards(job, options.out, pool=pool, **named)
    else:
        done = run_shards(job, options.out, pool=ThisProcess(options.device and options.device.split(",")), **named)
    progress.close()
    result = {"out": str(options.out), "unit": job.unit, **done, "seconds": time.perf_counter() - begin}
    if options.json:
        print_json(result)
        return
    by = f"{done['workers']} Ray workers, {done['lost']} of them lost" if with_ray else "one process"
    damaged = f", {done['damaged']} damaged and done again" if done["damaged"] else ""
    print(
        f"{done['count']:,} {job.unit}s in {done['shards']} shards, {done['found']} found there{damaged}, by {by}, "
        f"in {result['seconds']:.1f} s: {options.out}"
    )


def _make_job(options, progress):
    source = list(options.source)
    poses = source.pop() if source[-1].lower().endswith(".npy") else None
    if len(source) == 1 and Path(source[0]).suffix.lower() not in ("", ".toml"):
        raise ValueError(f"{source[0]}: is no scene; a sweep takes two models, or one twice, and POSES.npy")
    if poses is None:
        return _make_worlds(options, source, progress)
    for name in ("frames", "objects"):
        if getattr(options, name) is not None:
            raise ValueError(f"--{name}: goes with a scene whose worlds are run")
    if len(source) == 2:
        models = [load_model(source[0], progress)]
        models.append(models[0] if source[1] == source[0] else load_model(source[1], progress))
        lods = [model.lod_max for model in models]
    elif len(source) == 1:
        scene = load_scene(source[0], device="cpu", progress=progress).scene
        if scene.object_count != 2:
            raise ValueError(f"{source[0]}: has {scene.object_count} objects; a sweep takes a scene of two")
        models, lods = [scene.models[m] for m in scene.object_model], scene.lods.tolist()
    else:
        raise ValueError("sweep takes two models and POSES.npy, a scene and POSES.npy, or a scene")
    for place, request in enumerate((options.lod_a, options.lod_b)):
        if request is not None and options.lods is not None:
            raise ValueError("--lods: LODs come from the file, or from --lod-a and --lod-b")
        if request is not None:
            try:
                lods[place] = resolve_lod(models[place], request)
            except ValueError as error:
                raise ValueError(f"--lod-{'ab'[place]}: {error}") from None
    if options.output == "poses":
        raise ValueError("--output poses: goes with a scene whose worlds are run")
    asked = {"output": options.output or "any", "precision": options.precision}
    shard = options.shard or SHARDS["poses"]
    model_a, model_b = models
    return SweepJob(model_a, model_b, poses, options.lods or lods, shard=shard, **asked)


def _make_worlds(options, source, progress):
    if len(source) != 1:
        raise ValueError("POSES.npy is missing: two models are asked at poses")
    for name in ("lod_a", "lod_b", "lods"):
        if getattr(options, name) is not None:
            raise ValueError(f"--{name.replace('_', '-')}: the scene gives LODs")
    if options.precision != "exact":
        raise ValueError("--precision: worlds are asked exactly")
    scene = load_scene(source[0], device="cpu", progress=progress, objects=options.objects)
    return WorldsJob(scene, options.frames, options.output or "count", options.shard or SHARDS["worlds"])
