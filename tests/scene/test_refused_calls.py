"""Bad arguments of a scene and of queries about it: one clear error that names what is wrong, and no trace."""

import numpy as np
import pytest
from helpers.samples import STILL, sample
from helpers.scenes import TURN, everything, pair_scene

import warp_abtree as ab

NAN, INF = float("nan"), float("inf")
BOX_TOP = sample("box").lod_max


def with_entry(array, index, value):
    array = np.array(array, float)
    array[index] = value
    return array


# What is given, and words that the message needs beside the name of the argument.
POSES = {
    "not finite": (with_entry(STILL, 1, NAN), "finite"),
    "quaternion not finite": (with_entry(STILL, 5, INF), "finite"),
    "not normalised": (with_entry(STILL, 6, 1.002), "quaternion", "1.002"),
    "no quaternion": (np.zeros(7), "quaternion"),
    "a number": (1.0, "shape"),
    "skewed": (with_entry(TURN, (0, 0), 1e-4), "rigid"),
    "mirror": (np.diag([1.0, 1.0, -1.0, 1.0]), "rigid"),
    "bad last row": (with_entry(np.eye(4), (3, 0), 1e-9), "rigid"),
    "matrix not finite": (with_entry(np.eye(4), (0, 3), INF), "finite"),
    "3 by 4": (np.eye(4)[:3], "shape"),
    "text": ("origin",),
    "complex": (np.array(STILL, complex),),
    "ragged": ([0, 0, 0, [0, 0, 0, 1]],),
}
OBJECTS = [
    (dict(model="box.obj"), "model", "str"),
    (dict(model=None), "model", "NoneType"),
    (dict(world=-2), "world", "-2"),
    (dict(world=0.5), "world", "0.5"),
    (dict(world=NAN), "world", "nan"),
    (dict(importance=4), "importance", "4"),
    (dict(lod=-1), "LOD", "-1", "box"),
    (dict(lod=BOX_TOP + 1), "LOD", str(BOX_TOP + 1), "box"),
    (dict(lod=1.5), "LOD", "1.5"),
    (dict(lod=True), "LOD", "True"),
    (dict(static=1), "static"),
]
LODS = [
    ([1, 2], "(2,)", "3"),
    (3, "()"),
    ([1, -1, 2], "object 1", "-1"),
    ([1, BOX_TOP + 1, 2], "object 1", str(BOX_TOP + 1)),
    ([1, 2, 2**62], "object 2"),
    ([1, NAN, 2],),
    (["a", "b", "c"],),
    ([True, False, True],),
    ([1, [2], 3],),
]
PAIRS = [
    ([(0, 1), (0, 3)], "pair 1", "(0, 3)"),
    ([(-1, 0)], "pair 0", "(-1, 0)"),
    ([(0, 1), (1, 2), (2, 2)], "pair 2", "itself"),
    ([(0, 1, 2)], "(1, 3)"),
    ([(0.0, 1.0)], "float64"),
    ([(False, True)], "bool"),
    ("all of them",),
    ([(0, 1), (1,)],),
]
OPTIONS = [
    (dict(output="some"), "output", "'some'"),
    (dict(precision="float64"), "precision", "'float64'"),
    *[(dict(within=x), "within") for x in (-1e-300, NAN, INF, [1, 2, 3], [[1]], [1, -1], "1", [], True)],
]


def refused_calls():
    """Yield (name, call of a scene of three objects, words that the error needs)."""
    box, two = sample("box"), [(0, 1), (1, 0)]
    for name, (pose, *words) in POSES.items():
        yield f"add {name}", lambda scene, pose=pose: scene.add(box, pose), ["pose", *words]
        poses = [pose] * 3 if name != "text" else pose
        if isinstance(pose, np.ndarray) and pose.dtype == float and pose.shape in ((7,), (4, 4)):
            good = np.eye(4) if pose.ndim == 2 else np.array(STILL)
            poses, words = np.stack([good, pose, good]), [*words, "1"]
        yield f"set_poses {name}", lambda scene, poses=poses: scene.set_poses(poses), ["pose", *words]
    yield "too many poses", lambda scene: scene.set_poses(np.tile(STILL, (4, 1))), ["poses", "4", "3"]
    for options, *words in OBJECTS:
        yield f"add {options}", lambda scene, o=options: scene.add(**{"model": box, **o}), words
    for lods, *words in LODS:
        yield f"set_lods {lods}", lambda scene, lods=lods: scene.set_lods(lods), ["lods", *words]
    for pairs, *words in PAIRS:
        words = ["pairs", *words]
        yield f"intersect {pairs}", lambda scene, pairs=pairs: scene.intersect(pairs), words
        yield f"filter {pairs}", lambda scene, pairs=pairs: scene.filter(pairs), words
        yield f"query {pairs}", lambda scene, pairs=pairs: ab.Query(scene, pairs=pairs), words
    for options, *words in OPTIONS:
        yield f"intersect {options}", lambda scene, options=options: scene.intersect(two, **options), words
        yield f"query {options}", lambda scene, options=options: ab.Query(scene, pairs=two, **options), words
    yield "distances of found pairs", lambda scene: ab.Query(scene, within=[1, 2]), ["within"]
    yield "query of contacts", lambda scene: ab.Query(scene, "contacts", pairs=two), ["ab.ContactQuery"]
    yield "contacts precision", lambda scene: ab.ContactQuery(scene, two, precision="best"), ["precision"]
    for dtype in (np.int32, np.float16, "double trouble"):
        words = ["contact_dtype"]
        yield f"contact {dtype}", lambda s, dtype=dtype: s.intersect(two, "contacts", contact_dtype=dtype), words
        yield f"contacts {dtype}", lambda s, dtype=dtype: ab.ContactQuery(s, two, contact_dtype=dtype), words
    for room in (0, 2**31, NAN, "many"):
        yield f"query {room}", lambda s, room=room: ab.Query(s, capacity=room), ["capacity", str(room)]
        yield f"contacts {room}", lambda s, room=room: ab.ContactQuery(s, capacity=room), ["capacity", str(room)]
        for name in ("hits", "pairs", "uncertain"):
            words = [f"buffers: {name} ", str(room)]
            yield f"{name} {room}", lambda _, name=name, room=room: ab.Buffers(**{name: room}), words
    for i in (-1, 3, 0.5, "first", None):
        yield f"tree_state {i}", lambda scene, i=i: scene.tree_state(i), ["object", str(i)]


CALLS = {name: (call, words) for name, call, words in refused_calls()}


@pytest.mark.parametrize("case", CALLS)
def test_a_refused_call_leaves_no_trace(device, case):
    call, words = CALLS[case]
    scene = pair_scene(device)
    before, batch = everything(scene), scene.batch()
    error = TypeError if words[0] == "model" else ValueError
    with pytest.raises(error) as caught:
        call(scene)
    assert type(caught.value) is error
    message = str(caught.value)
    assert "\n" not in message and all(word in message for word in words), message
    assert scene.batch() is batch, "a refused call makes nothing anew"
    assert everything(scene) == before


def test_contacts_beyond_any_memory(device):
    with pytest.raises(ab.CapacityError, match="fewer than 2"):
        ab.ContactQuery(pair_scene(device), [(0, 1)], capacity=2**30)


@pytest.mark.parametrize("name", ["cuda:99", 7, ""])
def test_missing_devices_are_named(name):
    with pytest.raises(ValueError, match=r"no device .* cpu"):
        ab.Scene(name)


def test_an_empty_scene(device):
    scene = ab.Scene(device)
    assert scene.object_count == 0 and len(scene.lods) == 0 and scene.broad_phase().shape == (0, 2)
    for call in (
        lambda: scene.set_lods([]),
        lambda: scene.set_poses(np.empty((0, 7))),
        scene.intersect,
        lambda: scene.intersect([]),
        lambda: ab.Query(scene),
        lambda: ab.Pipeline(scene),
        lambda: ab.Frame(scene),
    ):
        with pytest.raises(ValueError, match=r"^the scene has no object$"):
            call()
    for call in (lambda: scene.intersect([(0, 1)]), lambda: scene.tree_state(0)):
        with pytest.raises(ValueError, match=r"no object|0 objects|outside"):
            call()
    scene.add(sample("box"))
    assert scene.broad_phase().shape == (0, 2) and scene.intersect().pairs.shape == (0, 2)


def test_a_refused_object_spoils_no_query(device):
    """One that is added does: a query is made for the objects there are."""
    scene = pair_scene(device)
    queries = [ab.Query(scene), ab.ContactQuery(scene, [(0, 1)])]
    with pytest.raises(ValueError):
        scene.add(sample("box"), lod=-1)
    for query in queries:
        query.launch()
    scene.add(sample("box"))
    for query in queries:
        with pytest.raises(RuntimeError, match="make a new one"):
            query.launch()
