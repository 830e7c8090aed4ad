"""`warp-abtree sweep`: a pair of models at millions of poses, into shards; on Ray or not."""

import contextlib
import importlib.util
import sys
import time
from pathlib import Path

from warp_abtree.app.cli.arguments import PRECISION_NAMES, Parser, positive_count
from warp_abtree.app.cli.model_commands import load_models, lod_at
from warp_abtree.app.cli.query_command import OUTPUTS
from warp_abtree.app.cli.report import print_result
from warp_abtree.app.toml.scene_file import load_scene
from warp_abtree.jobs import RayPool, SweepJob, ThisProcess, run_shards

SUMMARY = "ask a pair of models at millions of poses, into shards"
EXAMPLES = (
    "bunny.npz bunny.npz poses.npy --out answers",
    "bunny.npz warp:bear poses.npy --output contacts --workers 2 --out contacts",
    "bunny.npz warp:bear poses.npy --output distance --beyond 0.1 --out near",
    "bunny.npz warp:bear poses.npy --output first_contact --ends ends.npy --out times",
)


def add_arguments(sub: Parser):
    """Add the arguments of the command to its parser."""
    about = "two meshes or models and POSES.npy, (p, 7) or (p, 4, 4) poses of the second in the frame of the first; "
    about += "or a scene of two objects and POSES.npy"
    sub.add_scene("source", nargs="+", metavar="SCENE_OR_MODELS", help=about)
    sub.add_file("--out", "-o", type=Path, required=True, metavar="DIR", help="folder to make, or to go on in")
    sub.add_argument("--output", choices=(*OUTPUTS, "first_contact"), default="any", help="what to ask (any)")
    sub.add_argument("--precision", choices=PRECISION_NAMES, default="exact", help="as query (exact)")
    for name in ("a", "b"):
        sub.add_argument(f"--lod-{name}", metavar="LOD", help=f"LOD of {name.upper()}, as query (finest)")
    sub.add_file("--lods", type=Path, metavar="LODS.npy", help="LODs of both at each pose, (p, 2)")
    sub.add_file("--ends", type=Path, metavar="ENDS.npy", help="end poses of first_contact, as POSES.npy")
    sub.add_flag("--solid", "what lies inside A or B, closed meshes, intersects it")
    sub.add_number("--within", "whether any or count are proved farther apart than X, too")
    sub.add_number("--tolerance", "what a distance, or a time of first contact, may be off by (0, 1e-6)")
    sub.add_number("--beyond", "distance that is far enough (none)")
    sub.add_number("--shard", "poses a file (65536)", positive_count, 65536)
    about = 'of a Ray cluster (Ray is started here). "none": this process, with --device cuda:0,cuda:1 on two'
    sub.add_argument("--ray", metavar="ADDRESS", help=about)
    sub.add_number("--workers", "Ray workers (as many as GPUs, or else CPU cores)", positive_count)


def run_sweep(options, progress):
    """Do a sweep into shards."""
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
    if with_ray:
        # Ray tells of workers that end on stdout, which is for what this command prints.
        with contextlib.redirect_stdout(sys.stderr), RayPool(options.ray, options.workers) as pool:
            done = run_shards(job, options.out, pool, progress)
    else:
        done = run_shards(job, options.out, ThisProcess(options.device and options.device.split(",")), progress)
    progress.close()
    seconds = time.perf_counter() - begin
    print_result({"out": str(options.out), "unit": "pose", **done, "seconds": seconds}, options.json)


def _make_job(options, progress) -> SweepJob:
    source = list(options.source)
    if not source[-1].lower().endswith(".npy"):
        raise ValueError("POSES.npy is missing: two models are asked at poses")
    poses = source.pop()
    if len(source) == 2:
        models = load_models(source, progress)
        lods = [model.lod_max for model in models]
    elif len(source) == 1:
        if Path(source[0]).suffix.lower() not in ("", ".toml"):
            raise ValueError(f"{source[0]}: is no scene; a sweep takes two models, or one twice, and POSES.npy")
        scene = load_scene(source[0], device="cpu", progress=progress).scene
        if scene.object_count != 2:
            raise ValueError(f"{source[0]}: has {scene.object_count} objects; a sweep takes a scene of two")
        models, lods = [scene.models[m] for m in scene.object_model], scene.lods.tolist()
    else:
        raise ValueError("sweep takes two models and POSES.npy, or a scene of two objects and POSES.npy")
    for place, request in enumerate((options.lod_a, options.lod_b)):
        if request is not None and options.lods is not None:
            raise ValueError("--lods: LODs come from the file, or from --lod-a and --lod-b")
        if request is not None:
            lods[place] = lod_at(f"--lod-{'ab'[place]}", models[place], request)
    asked = {"output": options.output, "precision": options.precision, "end_poses": options.ends}
    asked |= {name: getattr(options, name) for name in ("solid", "within", "tolerance", "beyond")}
    model_a, model_b = models
    return SweepJob(model_a, model_b, poses, options.lods or lods, shard=options.shard, **asked)
