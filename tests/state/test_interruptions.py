"""Ctrl-C, and launches that fail, at every launch, copy and allocation of every operation.

Afterwards LODs, poses and answers are as before, or the operator refuses in one sentence; never another answer. Each
operation is repeated on what is made anew, with its first, second, third ... step raising, until it succeeds.
"""

import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import trimesh
import warp as wp
from conftest import slow
from helpers.resources import add_objects, check_scene, describe, make_scene
from helpers.samples import random_poses, sample
from helpers.scenes import everything

import warp_abtree as ab
from warp_abtree.query.cpu_threads import core_count

PAIRS = np.array([(0, 1), (1, 2), (3, 1)])
MORE_PAIRS = np.array([(i, j) for i in range(4) for j in range(4) if i != j])
REFUSED = "interrupted"


class Interrupter:
    """Counts launches, copies, fills and allocations of a device, and raises in the place of one of them."""

    def __init__(self, device, monkeypatch):
        self.left = None
        allocator = wp.get_device(device).get_allocator()
        for owner, name in (
            (wp, "launch"),
            (wp, "copy"),
            (wp.utils, "radix_sort_pairs"),
            (wp.array, "fill_"),
            (wp.array, "zero_"),
            (wp.array, "assign"),
            (wp.Bvh, "rebuild"),
            (allocator, "allocate"),
        ):
            monkeypatch.setattr(owner, name, self._counted(getattr(owner, name)))

    def _counted(self, original):
        def call(*args, **options):
            # Threads that launch on further cores are not interrupted: Ctrl-C reaches the main thread alone.
            if self.left is not None and threading.current_thread() is threading.main_thread():
                self.left -= 1
                if self.left < 0:
                    self.left = None
                    raise self.error
            return original(*args, **options)

        return call

    def interrupt(self, call, count, error):
        """Return whether a call was interrupted at a step."""
        self.left, self.error = count, error
        try:
            call()
        except BaseException as caught:
            assert caught is error, f"{caught!r}, not the error that was raised"
            return True
        finally:
            self.left = None
        return False

    def everywhere(self, make, call, check):
        """Interrupt every step of a call; return how many there are.

        Args:
            make: Returns what the call is made on.
            check: Called as check(before, made) after each; with before None it returns what must not change.
        """
        for count in range(1000):
            made = make()
            before = check(None, made)
            error = (KeyboardInterrupt(), RuntimeError("the kernel cache cannot be written"))[count % 2]
            if not self.interrupt(lambda made=made: call(made), count, error):
                return count
            check(before, made)
        raise AssertionError("the call never ends")


@pytest.fixture
def interrupter(device, monkeypatch):
    return Interrupter(device, monkeypatch)


def check_answers(before, scene):
    """Return all that a scene answers, or check that it still does; states may have moved in the pool."""
    now = [scene.lods.tobytes(), *describe(scene.intersect(PAIRS, output="faces"))]
    now += describe(scene.intersect(MORE_PAIRS, output="count"))
    now.append(scene.broad_phase().tobytes())
    for i in range(scene.object_count):
        state = scene.tree_state(i)
        now += [state.lod, *(getattr(state, name).tobytes() for name in ("status", "lower", "upper", "skip"))]
    objects = scene.batch().objects.pool
    now += [objects.rotation.numpy().tobytes(), objects.position.numpy().tobytes()]
    assert before is None or now == before
    return now


MOVES = {
    "in place": [0, 7, 0, 7],
    "one apart": [0, 3, 5, 9],
    "all apart": [2, 30, 11, 60],
    "coarsest": [-1, -1, -1, -1],
}


def move_lods(scene, move):
    return np.zeros(4, int) if move == "coarsest" else scene.lods - MOVES[move]


@pytest.mark.parametrize("move", ["one apart", *slow("in place", "all apart", "coarsest")])
def test_lods(device, interrupter, move):
    """Also the change after it gives what it gives on a scene that nothing has happened to."""

    def check(before, scene):
        now = check_answers(before, scene)
        if before is not None:
            scene.set_lods(move_lods(scene, move))
            expected = make_scene(device)
            expected.set_lods(move_lods(expected, move))
            assert check_answers(None, scene) == check_answers(None, expected)
        return now

    assert interrupter.everywhere(
        lambda: make_scene(device), lambda scene: scene.set_lods(move_lods(scene, move)), check
    ) > (8)


@pytest.mark.parametrize("move", ["one apart", *slow("in place", "all apart", "coarsest")])
def test_graphs_and_queries_beside_lods(device, interrupter, move):
    """A query that was made before, and its graph, answer as before or refuse, while the scene is torn and after."""

    def make():
        scene = make_scene(device)
        query = ab.Query(scene, "faces", pairs=PAIRS, capacity=4096)
        with wp.ScopedCapture(device) as captured:
            query.launch()
        return scene, query, captured.graph

    def ask(run, query):
        try:
            run()
            return query.result().faces.tobytes()
        except RuntimeError as error:
            assert REFUSED in str(error) or "replaced" in str(error), error
            return None

    def check(before, made):
        scene, query, graph = made
        if before is None:
            query.launch()
            return query.result().faces.tobytes()
        # In the order in which nothing has mended the scene yet.
        assert ask(lambda: wp.capture_launch(graph), query) in (before, None)
        assert ask(query.launch, query) in (before, None)
        assert ask(lambda: wp.capture_launch(graph), query) in (before, None)
        assert scene.intersect(PAIRS, output="faces").faces.tobytes() == before
        return None

    interrupter.everywhere(make, lambda made: made[0].set_lods(move_lods(made[0], move)), check)


@pytest.mark.parametrize("matrices", [False, True])
def test_poses(device, interrupter, matrices):
    poses = random_poses(np.random.default_rng(3), 4, 0.5)
    if matrices:
        poses = np.tile(np.eye(4), (4, 1, 1)) + 0.1 * np.eye(4, k=3)
    assert interrupter.everywhere(lambda: make_scene(device), lambda scene: scene.set_poses(poses), check_scene) >= 1


def test_first_use(device, interrupter):
    whole = check_answers(None, add_objects(device))

    def check(before, scene):
        assert scene.object_count == 4
        assert before is None or check_answers(None, scene) == whole

    assert interrupter.everywhere(lambda: add_objects(device), lambda s: s.intersect(PAIRS, output="faces"), check) > 30


@pytest.mark.slow
def test_a_new_object(device, interrupter):
    """It is there, or not; the others answer as before."""

    def make():
        scene = make_scene(device)
        scene.set_poses(random_poses(np.random.default_rng(2), 4, 0.5))
        return scene

    def add(scene):
        scene.add(sample("box"), lod=3)
        scene.intersect(PAIRS, output="faces")

    def check(before, scene):
        assert before is None or scene.object_count in (4, 5)
        faces = describe(scene.intersect(PAIRS, output="faces"))
        assert before is None or faces == before
        return faces

    assert interrupter.everywhere(make, add, check) > 30


def test_pairs_are_filtered_out(device, interrupter):
    def check(before, scene):
        found = [*map(tuple, scene.broad_phase().tolist())]
        assert before is None or set(before) - {(0, 1)} <= set(found) <= set(before)
        scene.filter(PAIRS[:1])
        assert (0, 1) not in map(tuple, scene.broad_phase().tolist())
        return found

    interrupter.everywhere(
        lambda: make_scene(device),
        lambda scene: scene.filter(PAIRS[:1]),
        lambda b, s: check(b, s) if b is not None else [*map(tuple, s.broad_phase().tolist())],
    )


QUESTIONS = {
    "any": dict(),
    "faces": dict(output="faces"),
    "contacts": dict(output="contacts"),
    "within": dict(output="count", within=0.01),
}


@pytest.mark.parametrize("pairs", ["given", *slow("found")])
@pytest.mark.parametrize("question", QUESTIONS)
def test_questions(device, interrupter, question, pairs):
    options = QUESTIONS[question]
    pairs = MORE_PAIRS if pairs == "given" else None

    def make():
        scene = make_scene(device)
        scene.intersect(PAIRS[:1], **options)
        return scene

    def check(before, scene):
        now = [*everything(scene), *describe(scene.intersect(pairs, **options))] if before is not None else None
        if before is not None:
            assert now == before
        return before or [*everything(scene), *describe(make_scene(device).intersect(pairs, **options))]

    assert interrupter.everywhere(make, lambda scene: scene.intersect(pairs, **options), check) > 4


OPERATORS = {
    "faces": lambda scene: ab.Query(scene, "faces", pairs=MORE_PAIRS),
    "found": lambda scene: ab.Query(scene, "count", capacity=ab.Buffers(pairs=2)),
    "within": lambda scene: ab.Query(scene, "count", pairs=MORE_PAIRS, within=0.01),
    "contacts": lambda scene: ab.ContactQuery(scene, pairs=MORE_PAIRS, capacity=8),
    "manifolds": lambda scene: ab.ManifoldQuery(scene, capacity=ab.Buffers(pairs=2, hits=8)),
}
CALLS = {
    "launch": lambda query: query.launch(),
    "run": lambda query: query.run(),
    "set_pairs": lambda query: query.set_pairs([*MORE_PAIRS, *MORE_PAIRS]) if query.broad_phase is None else None,
    "result": lambda query: (query.launch(), query.result()),
}


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("kind", OPERATORS)
def test_operators(device, interrupter, kind, call):
    """After an interruption there is no result until the next launch, which is whole, or the query refuses for good."""

    def make():
        query = OPERATORS[kind](make_scene(device))
        query.run()
        return query

    def check(before, query):
        if before is None:
            return query.run().count.tolist()
        try:
            assert query.result().count.tolist() == before
        except (RuntimeError, ab.CapacityError) as error:
            assert REFUSED in str(error) or "replaced" in str(error) or "nothing was launched" in str(error), error
        try:
            assert query.run().count.tolist() in (before, 2 * before)
        except RuntimeError as error:
            assert "make a new one" in str(error)
        return before

    steps = interrupter.everywhere(make, CALLS[call], check)
    assert steps > 1 or (call == "set_pairs" and kind in ("found", "manifolds"))


FRAMES = {
    "states of their own": dict(),
    "ladder": dict(ladder=[np.arange(0, 60, 10), np.arange(0, 60, 10)]),
    "contacts": dict(output="contacts", capacity=4096),
}


@pytest.mark.parametrize("kind", FRAMES)
def test_frames(device, interrupter, kind):
    """The next launch, or the replay of a graph captured before, gives what it gives on a frame of its own."""
    options = {"output": "count", "pairs": MORE_PAIRS, **FRAMES[kind]}
    lods = np.array([20, 41, 9, 33])

    def make(captured=True):
        frame = ab.FrameGraph(add_objects(device), **options)
        graph = frame.capture() if captured else None
        frame.lods.assign(lods.astype(np.int32))
        return frame, graph

    whole = make(False)[0]
    whole.launch()
    expected = whole.result().count.tolist()

    def check_frame(frame, launch):
        with pytest.raises(RuntimeError, match=REFUSED):
            frame.result()
        launch()
        assert frame.result().count.tolist() == expected
        frame.check()

    def by_launch(before, made):
        return True if before is None else check_frame(made[0], made[0].launch)

    def by_graph(before, made):
        return True if before is None else check_frame(made[0], lambda: wp.capture_launch(made[1]))

    assert interrupter.everywhere(make, lambda made: made[0].launch(), by_launch) > 3
    assert interrupter.everywhere(make, lambda made: made[0].launch(), by_graph) > 3


def test_a_capture(device, interrupter):
    """An interrupted capture leaves the frame as it was; it can be captured again."""

    def make():
        return ab.FrameGraph(add_objects(device), output="count", pairs=MORE_PAIRS)

    def check(before, frame):
        wp.capture_launch(frame.capture())
        frame.check()
        now = frame.result().count.tolist()
        assert before is None or now == before
        return now

    assert interrupter.everywhere(make, lambda frame: frame.capture(), check) > 3


@pytest.mark.parametrize("output", ["any", "count", "faces"])
def test_sweeps(device, interrupter, output):
    poses = random_poses(np.random.default_rng(4), 60, 0.6)

    def ask(_=None):
        return ab.sweep(sample("torus"), sample("small ball"), poses, output=output, device=device)

    expected = ask().tobytes()

    def check(before, _):
        assert ask().tobytes() == expected
        return True

    assert interrupter.everywhere(lambda: None, ask, check) > 1


def test_bodies(device, interrupter):
    """A step is whole, or has not begun, or the bodies refuse."""

    def make():
        scene = ab.Scene(device)
        scene.add(sample("box"), static=True)
        scene.add(sample("box"), pose=(0.1, 0, 0.9, 0, 0, 0, 1))
        scene.add(sample("box"), pose=(0.1, 0, 1.85, 0, 0, 0, 1))
        bodies = ab.Dynamics(scene)
        bodies.step(1e-3)
        return bodies

    whole = make()
    whole.step(1e-3)
    expected = whole.poses().tobytes()

    def check(before, bodies):
        if before is None:
            return True
        try:
            bodies.step(1e-3)
            assert bodies.poses().tobytes() == expected
        except RuntimeError as error:
            assert "a step of the bodies was interrupted; make a new Dynamics" in str(error)
        return None

    assert interrupter.everywhere(make, lambda bodies: bodies.step(1e-3), check) > 10


@pytest.mark.slow
def test_collision_managers(device, interrupter):
    ball, ring = trimesh.creation.icosphere(subdivisions=2), trimesh.creation.torus(1.0, 0.3)

    def make():
        manager = ab.CollisionManager(device)
        for k, mesh in enumerate((ball, ring, ball)):
            manager.add_object(str(k), mesh, trimesh.transformations.translation_matrix((0.9 * k, 0, 0)))
        return manager

    def ask(manager):
        found = manager.in_collision_single(ring, return_names=True)
        return found, manager.in_collision_internal(return_names=True)

    expected = ask(make())

    def check(before, manager):
        assert before is None or ask(manager) == expected
        return True

    assert interrupter.everywhere(make, ask, check) > 10


def test_a_real_interruption(monkeypatch):
    """SIGINT while threads of several cores are at work: they have let go of the arrays before it is raised."""
    if core_count() < 2:
        pytest.skip("one core")
    scene = ab.Scene("cpu")
    rng = np.random.default_rng(6)
    for pose in random_poses(rng, 60, 0.5):
        scene.add(sample("torus"), pose)
    expected = scene.intersect(output="count").count
    main = threading.main_thread().ident
    for delay in np.linspace(0.001, 0.05, 12):
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


CACHE_PROGRAM = """
import sys, tempfile
import numpy as np, trimesh, warp as wp
wp.config.log_level = wp.LOG_WARNING
wp.config.kernel_cache_dir = tempfile.mkdtemp()
import warp_abtree as ab
model = ab.Model.load(trimesh.creation.torus(1.0, 0.3, 16, 8), base_faces=4)
def make():
    scene = ab.Scene("cpu")
    for k in range(3):
        scene.add(model, pose=(0.3 * k, 0.1, 0, 0, 0, 0, 1))
    return scene
scene = make()
scene.batch()
kept, wp.config.kernel_cache_dir = wp.config.kernel_cache_dir, sys.argv[1]
for call in (lambda: scene.set_lods([model.lod_max - 1] * 3), lambda: scene.intersect(output="faces")):
    try:
        call()
        print("not refused")
    except Exception as error:
        print("refused", type(error).__name__)
wp.config.kernel_cache_dir = kept
lods, faces = scene.lods.tolist(), scene.intersect(output="faces").faces
print(lods == [model.lod_max] * 3 and np.array_equal(faces, make().intersect(output="faces").faces) and len(faces) > 50)
"""


@pytest.mark.slow
def test_a_kernel_cache_that_cannot_be_written(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("in the place of the cache")
    command = [sys.executable, "-c", CACHE_PROGRAM, str(blocked / "cache")]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=300, env={**os.environ, "PYTHONPATH": os.getcwd()}
    )
    lines = done.stdout.split("\n")
    assert done.returncode == 0, done.stderr
    assert lines[0].startswith("refused") and lines[1].startswith("refused") and lines[2] == "True", done.stdout
