"""python -m bench gate --before TREE: this checkout beside another one: answers, times, kernels, first answer.

Both trees answer the same questions in processes of their own (`worker.py`); every digest must be equal. Launches
are timed in turn, tree by tree, and the rows give both medians [ms] and their ratio. On CUDA registers, local and
shared memory of every kernel that was loaded are compared; on the CPU the kernels of warps answer the same questions
again. The first answer is the wall time of a process with an empty kernel cache, the least of three (--quick: of one).
Without --before one tree is kept.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
WORKER = Path(__file__).with_name("worker.py")
ROUNDS, REPEATS = 15, 3  # turns of a launch, and launches a turn
QUICK_ROUNDS = 2
SLOWER = 1.02  # a row may be
REGIMES = {"cpu": ({}, {"warps": True}), "cuda": ({},)}


class Tree:
    """A process that answers for one checkout."""

    def __init__(self, root, device, quick, cache=None):
        paths = os.pathsep.join(filter(None, [str(root), os.environ.get("PYTHONPATH")]))
        env = os.environ | {"PYTHONPATH": paths} | ({"WARP_CACHE_PATH": str(cache)} if cache else {})
        command = [sys.executable, "-P", str(WORKER), device, "quick" if quick else "full"]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=env, cwd=root
        )

    def ask(self, do, **command):
        """Return the answer to a command; raise a RuntimeError with what the worker says where it failed."""
        print(json.dumps({"do": do, **command}), file=self.process.stdin, flush=True)
        line = self.process.stdout.readline()
        found = json.loads(line) if line else {"error": f"the worker ended with {self.process.wait()}"}
        if "error" in found:
            raise RuntimeError(found["error"])
        return found["answer"]

    def close(self):
        self.process.stdin.close()
        self.process.wait()


def run(device, before=None, quick=False):
    """Yield a row a difference of bytes or kernels from another checkout, a row a launch, and a summary; without one
    the digests, times and kernels of this one. Raise a RuntimeError where it is no checkout, or a worker failed."""
    roots = {"now": ROOT} if before is None else {"before": Path(before).resolve(), "now": ROOT}
    for root in roots.values():
        if not (root / "warp_abtree" / "__init__.py").is_file():
            raise RuntimeError(f"{root} is no checkout of warp_abtree")
    yield {"case": "trees"} | {name: revision(root) for name, root in roots.items()}
    trees = {name: Tree(root, device.alias, quick) for name, root in roots.items()}
    try:
        differing = yield from compare_digests(trees, REGIMES["cuda" if device.is_cuda else "cpu"])
        ratios = yield from compare_times(trees, QUICK_ROUNDS if quick else ROUNDS)
        if device.is_cuda:
            yield from compare_kernels(trees)
    finally:
        for tree in trees.values():
            tree.close()
    rounds = [{name: time_first(root, device.alias) for name, root in roots.items()} for _ in range(1 if quick else 3)]
    first = {f"first_{name}_s": min(times[name] for times in rounds) for name in roots}
    row = {"case": "summary", "digests_differ": differing}
    if ratios:
        row |= {"median_ratio": round(float(np.median(ratios)), 4), "worst_ratio": max(ratios)}
        row["slower_rows"] = sum(ratio > SLOWER for ratio in ratios)
    yield row | first


def revision(root) -> str:
    """Return the commit of a checkout, with "+" where files differ from it."""
    command = ["git", "-C", str(root), "describe", "--always", "--dirty=+", "--exclude=*"]
    found = subprocess.run(command, capture_output=True, text=True)
    return found.stdout.strip() or "unknown"


def compare_digests(trees, regimes):
    """Yield a row for each answer, or for each that differs; return how many differ."""
    asked = {name: tree.ask("list")["digests"] for name, tree in trees.items()}
    differing = 0
    for regime in regimes:
        for part in asked["now"]:
            command = {"do": "digest", "name": part, "regime": regime}
            with ThreadPoolExecutor() as pool:  # each tree compiles its kernels
                found = dict(zip(trees, pool.map(lambda tree, command=command: tree.ask(**command), trees.values())))
            for key in dict.fromkeys(key for answers in found.values() for key in answers):
                row = {name: answers.get(key) for name, answers in found.items()}
                differs = len(set(row.values())) > 1
                differing += differs
                if differs or len(trees) == 1:
                    yield {"case": "digest", "part": part, "answer": key, **regime, **row}
    return differing


def compare_times(trees, rounds):
    """Yield a row a launch: medians [ms] and their ratio; return the ratios."""
    ratios, listed = [], {key: tree.ask("list")["times"] for key, tree in trees.items()}
    for name in listed["now"]:
        lacking = [key for key, names in listed.items() if name not in names]
        if lacking:
            yield {"case": "time", "launch": name, "skipped": f"the tree {lacking[0]} has none, or not its meshes"}
            continue
        for tree in trees.values():
            tree.ask("prepare", name=name)
            tree.ask("time", name=name, repeats=REPEATS)
        times = {key: [] for key in trees}
        for turn in range(rounds):
            for key in list(trees)[:: 1 - 2 * (turn % 2)]:
                times[key] += trees[key].ask("time", name=name, repeats=REPEATS + 1)[1:]  # the first finds cold caches
        medians = {key: float(np.median(values)) for key, values in times.items()}
        row = {"case": "time", "launch": name} | {f"{key}_ms": float(f"{ms:.4g}") for key, ms in medians.items()}
        if "before" in medians:
            ratios.append(round(medians["now"] / medians["before"], 3))
            row["ratio"] = ratios[-1]
        yield row
    return ratios


def compare_kernels(trees):
    """Yield a row for each CUDA kernel, or for each whose registers or memory differ."""
    found = {name: tree.ask("kernels") for name, tree in trees.items()}
    kernels = {name: each.get("kernels", {}) for name, each in found.items()}
    for key in sorted({key for each in kernels.values() for key in each}):
        row = {name: each.get(key) for name, each in kernels.items()}
        if len(trees) == 1 or row["before"] != row["now"]:
            yield {"case": "kernel", "kernel": key, "properties": found["now"].get("names"), **row}


def time_first(root, device) -> float:
    """Return the wall time [s] of a process from its start to the first answers, with an empty kernel cache."""
    with tempfile.TemporaryDirectory() as cache:
        began = time.perf_counter()
        tree = Tree(root, device, True, cache)
        tree.ask("first")
        taken = time.perf_counter() - began
        tree.close()
    return round(taken, 2)
