"""Jobs in shards: the answers of one call, whole files only, gone on with after an interrupt, and the same on Ray."""

import contextlib
import dataclasses
import io
import json
import pickle
import threading

import numpy as np
import pytest
from helpers.jobs import contents, load_worlds, pair, poses_of, stop_after
from helpers.samples import SHAPES, STILL, sample

import warp_abtree as ab
from warp_abtree.app.cli import sweep_command
from warp_abtree.app.cli.main import main
from warp_abtree.jobs import shard_folder, shards
from warp_abtree.jobs.shard_folder import MANIFEST


def read(out):
    """Return the columns of all shards, joined."""
    parts = list(ab.read_shards(out))
    assert [part[0] for part in parts[1:]] == [part[1] for part in parts[:-1]]
    return {name: np.concatenate([columns[name] for _, _, columns in parts]) for name in parts[0][2]}


def ask_scene(device, poses, lods, output):
    """Return the result of a scene with objects a pose, whose index is the pair's."""
    scene = ab.Scene(device)
    for k, model in enumerate(pair()):
        for i in range(len(poses)):
            scene.add(model, poses[i] if k else STILL, lod=int(lods[i, k]))
    return scene.intersect(np.arange(len(poses))[:, None] + [0, len(poses)], output=output)


def lods_of(count, seed=1):
    rng = np.random.default_rng(seed)
    return np.stack([rng.integers(0, model.lod_max + 1, count) for model in pair()], 1)


@pytest.mark.parametrize("output", ["any", "count", "faces", "contacts"])
@pytest.mark.parametrize("kind", ["finest", "fixed", "each"])
def test_answers_are_those_of_a_scene(device, tmp_path, monkeypatch, output, kind):
    monkeypatch.setattr(shards, "SCENE_POSES", 11)
    monkeypatch.setattr(shards, "READ_ROWS", 16)
    poses = poses_of()
    lods = np.tile([model.lod_max for model in pair()], (len(poses), 1))
    given = None
    if kind == "fixed":
        given = lods[0] // 2
        lods = np.tile(given, (len(poses), 1))
    elif kind == "each":
        given = lods = lods_of(len(poses))
        np.save(tmp_path / "lods.npy", lods)
        given = tmp_path / "lods.npy"
    np.save(tmp_path / "poses.npy", poses)
    job = ab.SweepJob(*pair(), tmp_path / "poses.npy", given, output=output, shard=27)
    done = ab.run_shards(job, tmp_path / "out", pool=ab.ThisProcess(device))
    assert done == {"shards": 4, "found": 0, "damaged": 0, "count": 100, "workers": 1, "lost": 0}
    found, expected = read(tmp_path / "out"), ask_scene(device, poses, lods, output)
    assert 10 < expected.any.sum() < 90
    if output in ("any", "count"):
        np.testing.assert_array_equal(found[output], getattr(expected, output))
        return
    for column, name in enumerate(("pose", "face_a", "face_b")):
        np.testing.assert_array_equal(found[name], expected.faces[:, column])
    for name in expected.contacts.dtype.names[2:] if output == "contacts" else ():
        np.testing.assert_array_equal(found[name], expected.contacts[name])
    assert len(found) == (3 if output == "faces" else 9)


def test_states_of_one_scene_stay_within_their_share_of_memory(monkeypatch):
    faces = sum(model.face_count for model in pair())
    monkeypatch.setattr(shards, "STATE_BYTES", 5 * shards.BYTES_A_FACE * faces)
    job = ab.SweepJob(*pair(), poses_of(), lods_of(100), output="count")
    asker = job.asker()
    found = asker.ask(job.item(0, 100), "cpu")["count"]
    assert asker._scene.object_count == 10
    np.testing.assert_array_equal(found, ask_scene("cpu", poses_of(), lods_of(100), "count").count)


def test_float32_poses_count_as_what_they_are(tmp_path):
    poses = poses_of().astype(np.float32)
    ab.run_shards(ab.SweepJob(*pair(), poses, output="count", shard=64), tmp_path / "out")
    np.testing.assert_array_equal(read(tmp_path / "out")["count"], ab.sweep(*pair(), poses, output="count"))


@pytest.mark.parametrize("output", ["count", "contacts"])
def test_several_devices_of_one_process_write_the_same(device, tmp_path, output):
    job = ab.SweepJob(*pair(), poses_of(), lods_of(100), output=output, shard=7)
    ab.run_shards(job, tmp_path / "one", pool=ab.ThisProcess(device))
    done = ab.run_shards(job, tmp_path / "three", pool=ab.ThisProcess([device] * 3))
    assert done["workers"] == 3 and contents(tmp_path / "three") == contents(tmp_path / "one")
    with pytest.raises(KeyboardInterrupt):
        ab.run_shards(job, tmp_path / "four", pool=ab.ThisProcess([device] * 4), progress=stop_after(6))
    assert ab.run_shards(job, tmp_path / "four", pool=ab.ThisProcess([device] * 2))["found"] == 6
    assert contents(tmp_path / "four") == contents(tmp_path / "one")
    with pytest.raises(ValueError, match="an empty list"):
        ab.ThisProcess([])


@pytest.mark.parametrize("count", [1, 2])
def test_every_shard_is_asked_in_a_turn(tmp_path, monkeypatch, count):
    """Where one device alone is asked, too: another thread may use the same GPU."""
    entered, asked = threading.local(), []

    @contextlib.contextmanager
    def turn(device):
        entered.device = device
        yield
        entered.device = None

    def ask(asker, item, device=None, plain=shards.SweepAsker.ask):
        asked.append(device is not None and getattr(entered, "device", None) == device)
        return plain(asker, item, device)

    monkeypatch.setattr(shards, "device_turn", turn)
    monkeypatch.setattr(shards.SweepAsker, "ask", ask)
    job = ab.SweepJob(*pair(), poses_of(), lods_of(100), output="count", shard=20)
    ab.run_shards(job, tmp_path / "out", pool=ab.ThisProcess(["cpu"] * count))
    assert asked == [True] * 5


def test_no_poses(tmp_path):
    done = ab.run_shards(ab.SweepJob(*pair(), np.empty((0, 7))), tmp_path / "out")
    assert done["shards"] == 0 and list(ab.read_shards(tmp_path / "out")) == []


# Interrupts.


def test_an_interrupted_job_goes_on(tmp_path, monkeypatch):
    job = ab.SweepJob(*pair(), poses_of(), output="faces", shard=9)
    ab.run_shards(job, tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        ab.run_shards(job, tmp_path / "out", progress=stop_after(4))
    assert len(list((tmp_path / "out").glob("shard-*.npz"))) == 4
    with pytest.raises(ValueError, match="8 of 12 shards are missing"):
        list(ab.read_shards(tmp_path / "out"))
    (tmp_path / "out" / "shard-000000000099-000000000100.npz.77.partial").write_bytes(b"half")
    asked = []
    again = ab.SweepJob(*pair(), poses_of(), output="faces", shard=9)
    monkeypatch.setattr(again, "item", lambda *part: asked.append(part) or job.item(*part))
    assert ab.run_shards(again, tmp_path / "out")["found"] == 4
    assert asked == [(start, min(start + 9, 100)) for start in range(36, 100, 9)]
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")
    assert ab.run_shards(again, tmp_path / "out")["found"] == 12


def test_a_write_that_fails_leaves_no_file(tmp_path, monkeypatch):
    job = ab.SweepJob(*pair(), poses_of(), shard=50)

    def fail(file, **columns):
        file.write(b"half")
        raise OSError("no space left")

    with monkeypatch.context() as patch, pytest.raises(OSError, match="no space left"):
        patch.setattr(np, "savez", fail)
        ab.run_shards(job, tmp_path / "out")
    assert list(contents(tmp_path / "out")) == [MANIFEST]
    assert ab.run_shards(job, tmp_path / "out")["found"] == 0


def test_names_have_room_for_more_than_twelve_digits(tmp_path):
    job = {"count": 2 * 10**12, "shard": 10**12, "file": "npz"}
    for part in shard_folder._ranges(job):
        (tmp_path / shard_folder._shard_name(*part, "npz")).touch()
    assert list(shard_folder._find_shards(tmp_path, job)) == [(0, 10**12), (10**12, 2 * 10**12)]


def test_a_run_that_ended_while_it_wrote_its_first_file_is_gone_on_with(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / f"{MANIFEST}.1.partial").write_text("{")
    assert ab.run_shards(ab.SweepJob(*pair(), poses_of(), shard=50), out)["shards"] == 2
    assert not list(out.glob("*.partial"))


def test_a_folder_is_of_one_job(tmp_path):
    options = {"output": "any", "shard": 50}
    ab.run_shards(ab.SweepJob(*pair(), poses_of(), **options), tmp_path / "out")
    before = contents(tmp_path / "out")
    models, last = pair(), poses_of()
    last[99, 0] = np.nextafter(last[99, 0], 9)
    for arguments, more, what in (
        ((*models, last), {}, "poses"),
        ((*models, poses_of()), {"output": "count"}, "output"),
        ((*models, poses_of()), {"shard": 51}, "shard"),
        ((*models, poses_of(), [3, 3]), {}, "lods"),
        ((*models[::-1], poses_of()), {}, "models"),
    ):
        with pytest.raises(ValueError, match=f"holds another job; not the same: .*{what}"):
            ab.run_shards(ab.SweepJob(*arguments, **{**options, **more}), tmp_path / "out")
    assert contents(tmp_path / "out") == before
    job = ab.SweepJob(*models, poses_of(), **options)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("text")
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / MANIFEST).write_text("{")
    for out, what in (
        (tmp_path / "full", "is not empty and holds no job.json"),
        (tmp_path / "full" / "thesis.txt", "is a file"),
        (tmp_path / "none" / "out", "there is no folder"),
        (tmp_path / "bad", "damaged"),
    ):
        with pytest.raises(ValueError, match=what):
            ab.run_shards(job, out)
    with pytest.raises(ValueError, match=r"holds no job\.json"):
        list(ab.read_shards(tmp_path / "full"))
    with pytest.raises(ValueError, match="file 'csv'"):
        ab.run_shards(job, tmp_path / "new", file="csv")
    assert not (tmp_path / "new").exists()


def test_a_pool_that_answers_twice_or_not_at_all_is_found_out(tmp_path):
    job = ab.SweepJob(*pair(), poses_of(), shard=50)

    class Pool(ab.ThisProcess):
        def ask(self, job, ranges):
            return super().ask(job, self.deal(ranges))

    for turn, (deal, what) in enumerate(
        ((lambda r: [r[0], r[0], r[1]], "answered twice"), (lambda r: r[:1], "1 of 2 shards were not answered"))
    ):
        pool = Pool()
        pool.deal = deal
        with pytest.raises(RuntimeError, match=what):
            ab.run_shards(job, tmp_path / str(turn), pool=pool)


def test_bad_input_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(shards, "READ_ROWS", 8)
    nan, long, lods = poses_of(), poses_of(), lods_of(100)
    nan[42, 1] = np.nan
    long[77, 3:] *= 1.1
    lods[63, 1] = 10**6
    (tmp_path / "text.npy").write_text("text")
    np.save(tmp_path / "fortran.npy", np.asfortranarray(poses_of()))
    for arguments, options, what in (
        ((nan,), {}, "pose 42 is not finite"),
        ((long,), {}, "pose 77 has a quaternion of norm 1.1"),
        ((poses_of()[:, :6],), {}, r"poses: shape \(100, 6\)"),
        ((poses_of(), lods), {}, "those of pose 63"),
        ((poses_of(), lods[:9]), {}, "lods: 9 given for 100 poses"),
        ((poses_of(), [0, 10**6]), {}, "LOD 1000000 is outside"),
        ((tmp_path / "none.npy",), {}, "no such file"),
        ((tmp_path / "text.npy",), {}, "cannot be read as .npy"),
        ((tmp_path / "fortran.npy",), {}, "in C order"),
        ((poses_of(),), {"output": "some"}, "output 'some'"),
        ((poses_of(),), {"precision": "good"}, "precision 'good'"),
        ((poses_of(),), {"shard": 0}, "shard 0 is outside"),
    ):
        with pytest.raises(ValueError, match=what):
            ab.SweepJob(*pair(), *arguments, **options)
    with pytest.raises(TypeError, match="not a Model"):
        ab.SweepJob("torus", sample("torus"), poses_of())


def test_parquet_holds_the_same(tmp_path):
    pytest.importorskip("pyarrow")
    for output in ("count", "contacts"):
        job = ab.SweepJob(*pair(), poses_of(), output=output, shard=40)
        ab.run_shards(job, tmp_path / f"{output}.npz")
        ab.run_shards(job, tmp_path / f"{output}.parquet", file="parquet")
        plain, table = read(tmp_path / f"{output}.npz"), read(tmp_path / f"{output}.parquet")
        if output == "count":
            np.testing.assert_array_equal(table.pop("pose"), np.arange(100))
        for name, values in plain.items():
            if values.ndim == 2:
                table[name] = np.stack([table.pop(f"{name}_{axis}") for axis in "xyz"], 1)
            np.testing.assert_array_equal(table.pop(name), values)
        assert not table


def test_a_model_keeps_its_hash(tmp_path):
    """Saved and opened, used, and copied to a worker it is the same; another is not."""
    model = ab.Model.from_arrays(*SHAPES["crumbs"]())
    known = shards.hash_model(model)
    ab.sweep(model, model, poses_of(3))
    ab.Scene("cpu").add(model)
    model.mesh_at(model.lod_max // 2)
    model.save(tmp_path / "model.npz")
    assert vars(model.progressive).keys() > {field.name for field in dataclasses.fields(model.progressive)}
    for same in (model, pickle.loads(pickle.dumps(model)), ab.Model.open(tmp_path / "model.npz")):
        assert shards.hash_model(same) == known
    assert shards.hash_model(sample("torus")) != known


# Worlds.

MOVED = '[[lod_sweep]]\nmodel = "ring"\nfrom = 1.0\nto = 0.2\nperiod = 0.1'


@pytest.mark.parametrize("kind", ["moved", "bodies"])
def test_worlds_in_shards_are_those_of_one_run(device, tmp_path, kind):
    scene = load_worlds(tmp_path, "[dynamics]" if kind == "bodies" else "", MOVED if kind == "moved" else "")
    runs = {}
    for output in ("count", "poses"):
        for shard in (2, 5):
            out = tmp_path / f"{output}{shard}"
            ab.run_shards(ab.WorldsJob(scene, 6, output, shard), out, pool=ab.ThisProcess(device))
            rows = read(out)
            order = np.lexsort((rows["object" if output == "poses" else "world"], rows["frame"]))
            runs[output, shard] = {name: values[order] for name, values in rows.items()}
        for name, values in runs[output, 5].items():
            np.testing.assert_array_equal(runs[output, 2][name], values, err_msg=name)
    whole = ab.load_scene(tmp_path / "scene.toml", device=device)
    bodies = whole.make_bodies()
    frame = whole.frame(bodies=bodies)
    for number in range(6):
        stand = whole.motion.poses(number * whole.time_step) if bodies is None else bodies.poses()
        result = frame.step()
        rows = runs["poses", 5]
        mine = rows["frame"] == number
        placed = np.stack([rows[name][mine] for name in ("x", "y", "z", "qx", "qy", "qz", "qw")], 1)
        np.testing.assert_array_equal(placed, stand[whole.worlds >= 0])
        rows = runs["count", 5]
        mine = rows["frame"] == number
        world = whole.worlds[result.pairs].max(1)
        np.testing.assert_array_equal(rows["face_pairs"][mine], np.bincount(world, result.count, 5))
        np.testing.assert_array_equal(rows["intersecting"][mine], np.bincount(world, result.any, 5))
    assert runs["count", 5]["face_pairs"].any()


def test_worlds_that_cannot_be_dealt(tmp_path):
    scene = load_worlds(tmp_path, "[dynamics]", '[[objects]]\nmodel = "ring"\nworld = -1\nposition = [0, 5, 0]')
    with pytest.raises(ValueError, match="object 16 is a rigid body in world -1"):
        ab.WorldsJob(scene)
    scene = load_worlds(
        tmp_path, "", '[lod]\ncontroller = "tolerance"\ntolerance = 0.01\n[camera]\neye = [0, 2, 9]\ntarget = [0, 0, 0]'
    )
    with pytest.raises(ValueError, match="by the clock"):
        ab.WorldsJob(scene)
    with pytest.raises(ValueError, match="output 'any' of worlds"):
        ab.WorldsJob(load_worlds(tmp_path), output="any")
    for name, value in (("frames", 0), ("frames", 2.5), ("shard", 0), ("shard", -1)):
        with pytest.raises(ValueError, match=f"^{name} {value} is "):
            ab.WorldsJob(load_worlds(tmp_path), **{name: value})


@pytest.mark.parametrize("workers", [0, -1, 1.5])
def test_workers_of_ray_are_counted_from_one(workers):
    with pytest.raises(ValueError, match=f"^workers {workers} is "):
        ab.RayPool(workers=workers)


# The command.


def command(*words):
    """Return the exit status of `warp-abtree sweep`, and what it printed."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main(["sweep", *map(str, words)])
    return status, out.getvalue(), err.getvalue()


def test_command(tmp_path):
    for name, model in zip("ab", pair()):
        model.save(tmp_path / f"{name}.npz")
    np.save(tmp_path / "poses.npy", poses_of())
    np.save(tmp_path / "lods.npy", lods_of(100))
    a, b, poses, out = (tmp_path / name for name in ("a.npz", "b.npz", "poses.npy", "out"))
    plain = ["--ray", "none", "--device", "cpu"]
    status, text, _ = command(a, b, poses, "--out", out, "--shard", 30, "--output", "count", "--json", *plain)
    assert status == 0 and json.loads(text)["shards"] == 4
    np.testing.assert_array_equal(read(out)["count"], ab.sweep(*pair(), poses_of(), output="count", device="cpu"))
    status, text, _ = command(a, b, poses, "--out", out, "--shard", 30, "--output", "count", *plain)
    assert status == 0 and "100 poses in 4 shards, 4 found there, by one process" in text
    lods = ["--lods", tmp_path / "lods.npy"]
    assert command(a, b, poses, "--out", tmp_path / "lods", *lods, *plain)[0] == 0
    expected = ask_scene("cpu", poses_of(), lods_of(100), "any").any
    np.testing.assert_array_equal(read(tmp_path / "lods")["any"], expected)
    half = pair()[0].lod_for(fraction=0.5)
    assert command(a, a, poses, "--out", tmp_path / "half", "--lod-a", "0.5", *plain)[0] == 0
    expected = ab.sweep(pair()[0], pair()[0], poses_of(), half, device="cpu")
    np.testing.assert_array_equal(read(tmp_path / "half")["any"], expected)
    load_worlds(tmp_path)
    scene = tmp_path / "scene.toml"
    status, text, _ = command(scene, "--frames", 2, "--shard", 2, "--out", tmp_path / "worlds", *plain)
    assert status == 0 and "5 worlds in 3 shards" in text
    for words, what in (
        ([a, b, "--out", tmp_path / "x"], "POSES.npy is missing"),
        ([a, poses, "--out", tmp_path / "x"], "is no scene; a sweep takes two models, or one twice"),
        ([a, b, a, poses, "--out", tmp_path / "x"], "two models and POSES.npy"),
        ([scene, poses, "--out", tmp_path / "x"], "takes a scene of two"),
        ([a, b, poses, "--frames", 3, "--out", tmp_path / "x"], "--frames: goes with a scene"),
        ([a, b, poses, *lods, "--lod-a", "3", "--out", tmp_path / "x"], "--lods: LODs come from"),
        ([a, b, poses, "--lod-b", "tall", "--out", tmp_path / "x"], "--lod-b: LOD 'tall'"),
        ([a, b, poses, "--output", "poses", "--out", tmp_path / "x"], "--output poses: goes with a scene"),
        ([scene, "--lod-a", "3", "--out", tmp_path / "x"], "--lod-a: the scene gives LODs"),
        ([a, b, poses, "--workers", 2, "--out", tmp_path / "x"], "--workers: they are Ray's"),
    ):
        status, _, err = command(*words, *plain)
        assert status == 2 and what in err and err.count("\n") == 1, err
    assert not (tmp_path / "x").exists()


def test_without_ray_one_line_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(sweep_command.importlib.util, "find_spec", lambda name: None)
    sample("torus").save(tmp_path / "a.npz")
    np.save(tmp_path / "poses.npy", poses_of())
    asked = [tmp_path / "a.npz", tmp_path / "a.npz", tmp_path / "poses.npy", "--out", tmp_path / "out"]
    status, _, err = command(*asked)
    assert status == 0 and err == "Ray is not installed (pip install ray): this process does all shards\n"
    assert len(read(tmp_path / "out")["any"]) == 100
    status, _, err = command(*asked, "--workers", "2")
    assert status == 2 and "need Ray" in err
