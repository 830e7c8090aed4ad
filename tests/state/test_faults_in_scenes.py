"""Memory that ends, and steps that raise, in what is asked of a scene: it goes on as before, whichever step fails.

Out of memory, each call raises one clear error and nothing has changed; interrupted, LODs, poses and answers are as
before."""

import ctypes
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import warp as wp
from conftest import ROOT, slow, slow_rows
from helpers import faults, scenes
from helpers.faults import MORE_PAIRS, PAIRS, add_objects, check_scene, describe, make_scene
from helpers.samples import random_poses, sample
from helpers.scenes import everything

import warp_abtree as ab
from warp_abtree.checks import radix_sort
from warp_abtree.checks.cpu_threads import core_count

MOVES = {"one apart": [0, 3, 5, 9], "pool grows": [2, 30, 11, 60]}


@pytest.fixture(params=faults.FAULTS)
def fault(request, device, monkeypatch):
    return faults.FAULTS[request.param](device, monkeypatch)


def move_lods(scene, move):
    return scene.set_lods(np.zeros(4, int) if move == "coarsest" else scene.lods - MOVES[move])


@pytest.mark.parametrize("move", ["one apart", *slow("pool grows", "coarsest")])
def test_lods(device, fault, move):
    """States that move, are copied, taken again and new; also the next change is that of a scene without a fault."""

    def make():
        scene = make_scene(device)
        if move == "pool grows":
            scene.batch().states.free.clear()  # no state to take again
        return scene

    def check(before, scene):
        now = fault.check_scene(before, scene)
        if before is not None and isinstance(fault, faults.Interruption):
            expected = make()
            move_lods(scene, move)
            move_lods(expected, move)
            assert faults.check_answers(None, scene) == faults.check_answers(None, expected)
        return now

    assert fault.everywhere(make, lambda scene: move_lods(scene, move), check)[0] > 1


@pytest.mark.parametrize("move", ["one apart", *slow("coarsest")])
def test_graphs_and_queries_beside_lods(device, monkeypatch, move):
    """A query that was made before, and its graph, answer as before or refuse, while the scene is torn and after."""

    def make():
        scene = make_scene(device)
        query = ab.Query(scene, "faces", pairs=PAIRS, capacity=4096)
        with wp.ScopedCapture(device) as captured:
            query.launch()
        return scene, query, captured.graph

    def check(before, made):
        scene, query, graph = made
        if before is None:
            query.launch()
            return query.result().faces.tobytes()
        # In the order in which nothing has mended the scene yet.
        for launch in (lambda: wp.capture_launch(graph), query.launch, lambda: wp.capture_launch(graph)):
            with faults.refusing("interrupted", "replaced"):
                launch()
                assert query.result().faces.tobytes() == before
        assert scene.intersect(PAIRS, output="faces").faces.tobytes() == before
        return None

    faults.Interruption(device, monkeypatch).everywhere(make, lambda made: move_lods(made[0], move), check)


def test_poses(device, fault):
    poses = random_poses(np.random.default_rng(3), 4, 0.5)
    count, _ = fault.everywhere(lambda: make_scene(device), lambda scene: scene.set_poses(poses), check_scene)
    assert count >= 1 or isinstance(fault, faults.MemoryShortage)


def test_first_use(device, fault):
    whole = fault.check_scene(None, add_objects(device))

    def check(before, scene):
        assert scene.object_count == 4
        assert before is None or fault.check_scene(None, scene) == whole

    assert fault.everywhere(lambda: add_objects(device), lambda s: s.intersect(PAIRS, output="faces"), check)[0] > 30


EDITS = {
    "add": (lambda scene: scene.add(sample("box"), lod=3), lambda scene: [*scene.lods[5:]] == [3]),
    "remove": (lambda scene: scene.remove(4), lambda scene: not scene.present[4]),
    "change": (lambda scene: scene.change(4, world=1), lambda scene: scene.worlds[4] == 1),
}


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "edit"), [*(("interruption", edit) for edit in EDITS), ("memory", "remove")])
def test_an_edit(device, monkeypatch, kind, edit):
    """It is made, or not; poses and LODs of the others stay where they were set, not where they were added."""
    fault, (change, is_made) = faults.FAULTS[kind](device, monkeypatch), EDITS[edit]

    def make():
        scene = make_scene(device)
        scene.add(sample("twins"))
        scene.set_poses(random_poses(np.random.default_rng(2), 5, 0.5))
        return scene, describe(scene.intersect(PAIRS, output="faces"))

    def call(made):
        if not is_made(made[0]):
            change(made[0])
        return made[0].intersect(output="faces")

    def check(before, made):
        scene, answers = made
        if before is not None:
            assert scene.object_count == 5 or is_made(scene)
            assert describe(scene.intersect(PAIRS, output="faces")) == answers
        return True

    assert fault.everywhere(make, call, check)[0] > 30


def test_pairs_are_filtered_out(device, monkeypatch):
    def check(before, scene):
        found = [*map(tuple, scene.broad_phase().tolist())]
        if before is not None:
            assert set(before) - {(0, 1)} <= set(found) <= set(before)
            scene.filter(PAIRS[:1])
            assert (0, 1) not in map(tuple, scene.broad_phase().tolist())
        return found

    fault = faults.Interruption(device, monkeypatch)
    fault.everywhere(lambda: make_scene(device), lambda scene: scene.filter(PAIRS[:1]), check)


REQUESTS = {
    "any": dict(),
    "faces": dict(output="faces"),
    "contacts": dict(output="contacts"),
    "within": dict(output="count", within=0.01),
    "float32": dict(output="count", precision="float32"),
}


@pytest.mark.parametrize("asked", REQUESTS)
@pytest.mark.parametrize(("kind", "pairs"), [("interruption", "given"), *slow_rows(("memory", "found"))])
def test_requests(device, monkeypatch, kind, asked, pairs):
    """More pairs than the scene was asked before, with what belongs to each, and more hits than it had room for."""
    fault, options = faults.FAULTS[kind](device, monkeypatch), REQUESTS[asked]
    pairs = MORE_PAIRS if pairs == "given" else None
    untouched = check_scene(None, make_scene(device))
    expected = describe(make_scene(device).intersect(pairs, **options))

    def make():
        scene = make_scene(device)
        scene.intersect(PAIRS[:1], **options)
        return scene

    def check(before, scene):
        if before is None:
            return everything(scene)
        faults.check_buffer_lengths(scene._queries.kept.values())
        assert everything(scene) == before and describe(scene.intersect(pairs, **options)) == expected
        return check_scene(untouched, scene)

    count, result = fault.everywhere(make, lambda scene: scene.intersect(pairs, **options), check)
    assert count >= 4 and result.any.any()


FORK = """
import os, sys
import numpy as np, trimesh, warp as wp
wp.config.log_level = wp.LOG_WARNING
import warp_abtree as ab
model = ab.Model.load(trimesh.creation.torus(1.0, 0.3, 24, 12), base_faces=4)
def make(device):
    scene = ab.Scene(device)
    for k in range(5):
        scene.add(model, pose=(0.4 * k, 0.1, 0, 0, 0, 0, 1))
    return scene
device, other = sys.argv[1:3]
poses = np.tile([0.0, 0, 0, 0, 0, 0, 1], (300, 1))
poses[:, 0] = np.linspace(0, 3, 300)
scene = make(device)
def ask(where):
    swept = ab.sweep(model, model, poses, output="count", device=where)
    asked = scene if where == device else make(where)
    return swept.tolist(), asked.intersect(output="faces").faces.tolist()
expected = ask(device)
child = os.fork()
if child == 0:
    try:
        print("same" if ask(other) == expected else "another answer", flush=True)
    except RuntimeError as error:
        print(error, flush=True)
    os._exit(0)
_, status = os.waitpid(child, 0)
print(status, ask(device) == expected)
"""


def run(*devices):
    """Return what a forked child says that asks on the other device, and then its parent."""
    command = [sys.executable, "-c", FORK, *devices]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_forked_child(device):
    """As PyTorch's DataLoader forks: on the CPU it answers, on a GPU it refuses in one error. The parent goes on."""
    answer, parent = run(device, device)
    if ab.Scene(device).device.is_cuda:
        assert "cannot be used in a process forked after Warp started" in answer and "spawn" in answer
        assert run(device, "cpu")[0] == "same"
    else:
        assert answer == "same"
    assert parent == "0 True"


def test_a_real_interruption():
    """SIGINT while threads of several cores are at work: they have let go of the arrays before it is raised."""
    if core_count() < 2:
        pytest.skip("one core")
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        pytest.skip("SIGINT is ignored, as in the background of a shell")
    scene = scenes.add_objects("cpu", ["torus"] * 60, seed=6, spread=0.5)
    expected = scene.intersect(output="count").count
    main = threading.main_thread().ident
    for delay in np.linspace(0.001, 0.05, 6):
        timer = threading.Timer(delay, signal.pthread_kill, (main, signal.SIGINT))
        try:
            timer.start()
            for _ in range(1000):
                scene.intersect(output="count")
            time.sleep(1)
        except KeyboardInterrupt:
            pass
        timer.join()
        np.testing.assert_array_equal(scene.intersect(output="count").count, expected)


@pytest.mark.parametrize("failures", [0, 1, radix_sort.SORT_ATTEMPTS])
def test_a_sort_that_fails_is_repeated_then_an_error(device, monkeypatch, failures):
    numbers = np.random.default_rng(0).permutation(64)
    keys = wp.array(np.tile(numbers, 2), dtype=wp.int64, device=device)
    values = wp.array(np.tile(numbers, 2), dtype=wp.int32, device=device)
    sort, left = wp.utils.radix_sort_pairs, [failures]

    def fail(*args, **options):
        left[0] -= 1
        if left[0] < 0:
            sort(*args, **options)
        else:
            ctypes.memmove(radix_sort._error_address(), b"no device\0", 10)

    monkeypatch.setattr(wp.utils, "radix_sort_pairs", fail)
    if failures == radix_sort.SORT_ATTEMPTS:
        with pytest.raises(RuntimeError, match=f"64 numbers on {device} were not sorted: no device"):
            radix_sort.radix_sort(keys, values, 64, 7)
        return
    radix_sort.radix_sort(keys, values, 64, 7)
    np.testing.assert_array_equal(keys.numpy()[:64], np.arange(64))
    np.testing.assert_array_equal(values.numpy()[:64], np.arange(64))
