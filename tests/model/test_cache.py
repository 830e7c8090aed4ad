"""The cache of models: a mesh that comes again is opened, and nothing wrong with the folder is an error."""

import gzip
import json
import os
import shutil
import stat
import struct

import numpy as np
import pytest
import trimesh

import warp_abtree as ab
from warp_abtree.model import cache
from warp_abtree.model import model as model_module
from warp_abtree.model import progressive as progressive_module


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("WARP_ABTREE_CACHE", str(tmp_path / "models"))
    return tmp_path / "models"


@pytest.fixture
def built(monkeypatch):
    """Names of the meshes that were built, in order."""
    names, build = [], model_module.build_progressive

    def note(mesh, *options, **more):
        names.append(mesh.name)
        return build(mesh, *options, **more)

    monkeypatch.setattr(model_module, "build_progressive", note)
    return names


@pytest.fixture
def ball(tmp_path):
    path = tmp_path / "ball.obj"
    trimesh.creation.icosphere(3).export(path)  # 1,280 faces
    return path


def truncate(path):
    path.write_bytes(path.read_bytes()[:1000])


def alter(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 255
    path.write_bytes(data)


def other_errors(path):
    """Errors half as large, under the same key and digest."""
    with np.load(path) as file:
        members = dict(file)
    np.savez(path, **members | {"lod_error": members["lod_error"] / 2})


def test_a_glb_that_refers_to_files_is_read_again(folder, tmp_path):
    ball = trimesh.creation.icosphere(3)
    views = [{"buffer": 0, "byteLength": 12 * 642}, {"buffer": 0, "byteOffset": 12 * 642, "byteLength": 12 * 1280}]
    accessors = [{"bufferView": 0, "componentType": 5126, "count": 642, "type": "VEC3"}]
    accessors += [{"bufferView": 1, "componentType": 5125, "count": 3840, "type": "SCALAR"}]
    tree = {"asset": {"version": "2.0"}, "nodes": [{"mesh": 0}], "accessors": accessors, "bufferViews": views}
    tree |= {"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}]}
    text = json.dumps(tree | {"buffers": [{"uri": "ball.bin", "byteLength": 12 * 1922}]}).encode()
    text += b" " * (-len(text) % 4)
    data = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON") + text
    for path, content in ((tmp_path / "a.glb", data), (tmp_path / "b.glb.gz", gzip.compress(data))):
        path.write_bytes(content)
        for radius in (1, 3):
            points = (radius * ball.vertices).astype(np.float32)
            (tmp_path / "ball.bin").write_bytes(points.tobytes() + ball.faces.astype(np.uint32).tobytes())
            model = ab.Model.load(path)
            assert np.abs(model.mesh_at(model.lod_max)[0]).max() == radius


def test_a_file_that_comes_again_is_opened(folder, built, ball):
    first, second = ab.Model.load(ball), ab.Model.load(str(ball))
    assert built == ["ball"] and len(list(folder.iterdir())) == 1
    assert os.name == "nt" or stat.S_IMODE(folder.stat().st_mode) == 0o700, "the folder is the user's alone"
    assert second.digest == first.digest and second.name == "ball" and second.error_at(7) == first.error_at(7)
    shutil.copy(ball, ball.with_name("copy.obj"))
    assert ab.Model.load(ball.with_name("copy.obj")).name == "copy" and built == ["ball"]


@pytest.mark.parametrize("when", ["beside the collapse", "of a model that is found", "asked"])
def test_certified_errors_are_kept(folder, ball, monkeypatch, when):
    if when == "of a model that is found":
        ab.Model.load(ball)
    model = ab.Model.load(ball, certify=when != "asked")
    assert (when == "beside the collapse") == (model.progressive.known_error is not None)
    assert len(list(folder.iterdir())) == (1 if when == "asked" else 2)
    errors = ab.Model.load(ball, cache=False).progressive.lod_error
    assert np.array_equal(model.progressive.lod_error, errors) and len(list(folder.iterdir())) == 2
    monkeypatch.setattr(progressive_module, "certify_errors", lambda *_: pytest.fail("certified again"))
    assert np.array_equal(ab.Model.load(ball).progressive.lod_error, errors)


@pytest.mark.parametrize("damage", [truncate, alter, other_errors])
def test_damaged_errors_are_certified_again(folder, ball, damage):
    errors = ab.Model.load(ball, certify=True).progressive.lod_error
    (path,) = (path for path in folder.iterdir() if "lod_error" in np.load(path))
    whole = path.read_bytes()
    damage(path)
    assert np.array_equal(ab.Model.load(ball).progressive.lod_error, errors)
    assert path.read_bytes() == whole


def test_options_and_other_contents_build_anew(folder, built, ball):
    ab.Model.load(ball)
    assert ab.Model.load(ball, base_faces=100).progressive.active_count(0) > 50
    trimesh.creation.icosphere(3, radius=2.0).export(ball)
    assert np.ptp(ab.Model.load(ball).mesh_at(0)[0]) > 2.0
    assert len(built) == 3 == len(list(folder.iterdir()))
    mesh = trimesh.creation.icosphere(3, radius=3.0)  # found by what it holds
    models = [ab.Model.from_arrays(mesh.vertices, mesh.faces, name="a"), ab.Model.load(mesh)]
    assert len(built) == 4 and models[0].digest == models[1].digest
    assert [model.name for model in models] == ["a", "trimesh"]
    mesh.metadata["name"] = "ball"
    assert ab.Model.load(mesh).name == "ball" and len(built) == 4


def test_it_can_be_passed_by_or_not_be_written(folder, built, ball, monkeypatch):
    ab.Model.load(ball, cache=False)
    monkeypatch.setenv("WARP_ABTREE_CACHE", "off")
    ab.Model.load(ball)
    assert len(built) == 2 and not folder.exists()
    monkeypatch.setenv("WARP_ABTREE_CACHE", str(folder))
    folder.write_text("a file")
    assert ab.Model.load(ball).face_count == 1280 and folder.read_text() == "a file"


def test_small_models_and_those_beyond_the_limit_are_not_kept(folder, built, ball, monkeypatch):
    for _ in range(2):
        ab.Model.load(trimesh.creation.box())
    monkeypatch.setattr(cache, "SIZE_LIMIT", 1000)
    ab.Model.load(ball)
    assert len(built) == 3 and not folder.exists()


def test_where_the_folder_is(monkeypatch, tmp_path):
    monkeypatch.setenv("WARP_ABTREE_CACHE", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.cache_folder() == tmp_path / "warp_abtree"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert cache.cache_folder() == tmp_path / "home" / ".cache" / "warp_abtree"
    monkeypatch.setenv("WARP_ABTREE_CACHE", "~/models")
    assert cache.cache_folder() == tmp_path / "home" / "models"


def replace_by_another(path):
    ball = trimesh.creation.icosphere(2)
    ab.Model.load(ball).save(path.with_name("other.npz"))
    os.replace(path.with_name("other.npz"), path)


def swap_with_another_key(path):
    """A whole file of the cache, under the name of another mesh."""
    ab.Model.load(trimesh.creation.icosphere(3, radius=9.0))
    (other,) = (file for file in path.parent.glob("*.npz") if file != path)
    os.replace(other, path)


@pytest.mark.parametrize("damage", [truncate, alter, replace_by_another, swap_with_another_key])
def test_a_damaged_or_foreign_file_is_written_again(folder, built, ball, damage):
    first = ab.Model.load(ball)
    (path,) = folder.iterdir()
    whole = path.stat().st_size
    damage(path)
    built.clear()
    assert ab.Model.load(ball).digest == first.digest and built == ["ball"] and path.stat().st_size == whole
    assert ab.Model.load(ball).digest == first.digest and built == ["ball"]


def test_the_models_used_least_recently_go_first(folder, built, ball, monkeypatch):
    paths = []
    for k in range(3):
        path = ball.with_name(f"ball{k}.obj")
        trimesh.creation.icosphere(3, radius=2.0 + k).export(path)
        ab.Model.load(path)
        paths.append(path)
        for i, file in enumerate(sorted(folder.iterdir(), key=lambda file: file.stat().st_mtime_ns)):
            os.utime(file, (1000 + i, 1000 + i))
    ab.Model.load(paths[0])  # used now
    size = max(file.stat().st_size for file in folder.iterdir())
    monkeypatch.setattr(cache, "SIZE_LIMIT", int(2.5 * size))
    stranger = folder / "mine.npz"
    stranger.write_bytes(bytes(3 * size))
    os.utime(stranger, (1, 1))
    ab.Model.load(ball)
    assert stranger.stat().st_size == 3 * size, "other files of the folder stay, and count for nothing"
    stranger.unlink()
    built.clear()
    for path in (paths[0], ball):
        ab.Model.load(path)
    assert built == [] and len(list(folder.iterdir())) == 2


def test_files_of_other_programs_stay(folder, ball):
    folder.mkdir()
    key = "0123456789" * 4
    names = ["film.partial", "mine.npz.12-0123abcd.partial", f"{key}.npz.12.partial", f"x{key}.npz.12-0123abcd.partial"]
    left = folder / f"{key}.npz.12-0123abcd.partial"  # of a writer of the cache that was killed
    for path in (left, *(folder / name for name in names)):
        path.write_text("half")
    ab.Model.load(ball)
    assert not left.exists() and all((folder / name).read_text() == "half" for name in names)


@pytest.mark.skipif(os.name == "nt", reason="pipes and links of POSIX")
@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, lambda path: os.symlink(path, path)])
def test_what_is_no_file_is_passed_by(folder, built, ball, make):
    """Under the name of a model, which a pipe would make wait for ever, and under that of its errors; and as a mesh."""
    ab.Model.load(ball, certify=True)
    paths = list(folder.iterdir())
    for path in paths:
        path.unlink()
        make(path)
    built.clear()
    model = ab.Model.load(ball, certify=True)
    assert built == ["ball"] and model.error_at(0) > 0 and len(paths) == 2
    make(ball.with_name("other.obj"))
    assert cache.file_key(ball.with_name("other.obj")) is None
