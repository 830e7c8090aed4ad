"""`warp-abtree doctor`: what this machine has, what is missing, and whether its devices answer right."""

import contextlib
import importlib.metadata
import os
import platform
import re
import shlex
import sys
import time
from pathlib import Path

import warp as wp

from warp_abtree.app.cli.report import print_result
from warp_abtree.app.toml.folder import scene_folder, scene_names
from warp_abtree.checks.version import __version__
from warp_abtree.model.model import Model
from warp_abtree.scene.scene import Scene

SUMMARY = "say what this machine has, what is missing, and whether its devices answer right"
EXAMPLES = ("", "--json", "--device cpu")
CORE = ("warp-lang>=1.19", "numpy", "trimesh")
# Of each extra its use and its packages; tests compare them with pyproject.toml.
EXTRAS = {
    "app": ("scene files, progress bars, completion in shells", ("msgspec", "rich", "shtab", "tomli")),
    "view": ("viewer", ("viser>=1.1",)),
    "pictures": ("pictures and plots", ("pyvista", "matplotlib")),
    "usd": ("meshes inside Warp, USD files", ("usd-core",)),
    "dynamics": ("bodies whose meshes are open", ("scipy", "networkx")),
    "newton": ("contacts for Newton's solvers", ("newton>=1.8",)),
    "cluster": ("sweeps on Ray, Parquet files", ("ray", "pyarrow")),
}
OLD_PYTHON_ONLY = ("tomli",)  # Python 3.11 has tomllib
# Two triangles that cross, and a pose of the second one at which they do not.
CROSSING = ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0.25, 0.25, -1], [0.25, 0.25, 1], [2, 2, 0]])
AWAY = (0, 0, 3, 0, 0, 0, 1)


def _numbers(version) -> tuple:
    """Return the numbers that a version begins with, up to the first part that is none."""
    return tuple(map(int, re.sub(r"[^\d.].*", "", version).strip(".").split("."))) if version[:1].isdigit() else ()


def check_packages(needs) -> dict:
    """Return for each requirement, as "viser>=1.1", the installed version or None, and whether that is new enough."""
    found = {}
    for need in needs:
        name, _, least = need.partition(">=")
        try:
            version = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            version = None
        new_enough = version is not None and _numbers(version) >= _numbers(least)
        found[name] = {"version": version, "ok": new_enough, "needs": need}
    return found


def check_extras() -> dict:
    """Return for each extra its use, its packages, and whether all are installed."""
    found = {}
    for extra, (use, needs) in EXTRAS.items():
        packages = check_packages(need for need in needs if need not in OLD_PYTHON_ONLY or sys.version_info < (3, 11))
        found[extra] = {"for": use, "packages": packages, "ok": all(each["ok"] for each in packages.values())}
    return found


def check_device(device) -> dict:
    """Query a device where the answer is known; the seconds include loading and, at first, compiling of kernels."""
    gpu = device.is_cuda
    found = {
        "device": device.alias,
        "name": device.name if gpu else platform.processor() or platform.machine(),
        "architecture": f"sm_{device.arch}" if gpu else platform.machine(),
        "memory_bytes": device.total_memory if gpu else None,
        "free_bytes": device.free_memory if gpu else None,
    }
    begin = time.perf_counter()
    try:
        scene = Scene(device)
        first, second = (Model.from_arrays(vertices, [[0, 1, 2]]) for vertices in CROSSING)
        scene.add(first)
        scene.add(second)
        scene.add(second, pose=AWAY)
        answer = scene.intersect([[0, 1], [0, 2], [1, 2]], output="count").count.tolist()
        error = None if answer == [1, 0, 0] else f"a wrong answer: {answer}"
    except Exception as problem:  # of any kind: it is the finding
        error = " ".join(str(problem).split()) or type(problem).__name__
    return {**found, "ok": error is None, "seconds": time.perf_counter() - begin, "error": error}


def check_cache() -> dict:
    """Return the folder of Warp's compiled kernels, its modules and bytes, and whether it can be written."""
    folder = Path(wp.config.kernel_cache_dir or "")  # set by the start of Warp
    modules, size = 0, 0
    for place, folders, files in os.walk(folder):  # other processes may be writing there
        modules += len(folders) if place == str(folder) else 0
        for name in files:
            with contextlib.suppress(FileNotFoundError):
                size += os.path.getsize(os.path.join(place, name))
    return {
        "folder": str(folder),
        "modules": modules,
        "bytes": size,
        "writable": os.access(folder, os.W_OK),
    }


def examine(devices=None) -> dict:
    """Return all that `warp-abtree doctor --json` prints, about some Warp devices or all."""
    checked = [check_device(device) for device in (wp.get_devices() if devices is None else devices)]
    core = check_packages(CORE)
    found = {
        "warp_abtree": __version__,
        "folder": str(Path(__file__).parents[2]),
        "python": platform.python_version(),
        "system": platform.platform(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "cuda_driver": _cuda_driver(),
        "devices": checked,
        "packages": core,
        "extras": check_extras(),
        "kernel_cache": check_cache(),
        "scenes": {"folder": str(scene_folder()), "names": scene_names()},
    }
    packages = [each for extra in found["extras"].values() for each in extra["packages"].values()]
    found["install"] = [each["needs"] for each in packages if not each["ok"]]
    found["usable"] = bool(checked) and all(each["ok"] for each in (*checked, *core.values()))
    return found


def _cuda_driver():
    try:
        version = wp.get_cuda_driver_version() if wp.is_cuda_available() else None
    except RuntimeError:
        return None
    return ".".join(map(str, version)) if isinstance(version, tuple) else version


def doctor(options, progress) -> int:
    """Examine this machine; the exit status is 0 where it is usable, else 1."""
    devices = None if options.device is None else [Scene(device=options.device).device]
    found = examine(devices)
    if not options.json:
        for extra in found["extras"].values():
            packages = extra["packages"].items()
            extra["packages"] = ", ".join(f"{name} {each['version'] or 'missing'}" for name, each in packages)
        found["install"] = f"pip install {shlex.join(found['install'])}" if found["install"] else None
    print_result(found, options.json)
    return 0 if found["usable"] else 1
