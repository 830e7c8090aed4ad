"""glTF and GLB files written byte by byte: every kind of primitive, accessor and node, and what is refused or named."""

import base64
import copy
import json
import struct

import numpy as np
import pytest
import trimesh
from helpers import refused
from helpers.scenes import names_of, posed_triangles

import warp_abtree as ab

BOX = trimesh.creation.box()
POINTS, CORNERS = np.asarray(BOX.vertices, np.float32), np.asarray(BOX.faces, np.uint16).ravel()
RIM = np.array([[5, 0, 0], [6, 0, 0], [7, 1, 0], [6, 2, 0], [5, 1, 0]], np.float32)  # convex: a fan of 3
KINDS = {"float32": 5126, "uint8": 5121, "uint16": 5123, "uint32": 5125, "int8": 5120, "int16": 5122}
SOLID = {"attributes": {"POSITION": 0}, "indices": 1}


def tree_of(arrays, primitives, node=None, **more):
    """Return the tree and the buffer of a file with an accessor and a view for each array, and one mesh."""
    blob, views, accessors = b"", [], []
    for array in map(np.ascontiguousarray, arrays):
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": array.nbytes})
        shape = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[array.shape[1] if array.ndim > 1 else 1]
        kind = KINDS[array.dtype.name]
        accessors.append({"bufferView": len(views) - 1, "componentType": kind, "count": len(array), "type": shape})
        blob += array.tobytes() + b"\0" * (-array.nbytes % 4)
    tree = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "bufferViews": views}
    tree |= {"nodes": [{"mesh": 0, "name": "crate", **(node or {})}], "buffers": [{"byteLength": len(blob)}]}
    tree |= {"accessors": accessors, "meshes": [{"primitives": copy.deepcopy(primitives), "name": "part"}]}
    return tree | more, blob


def glb(tree, blob):
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(blob), len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob


@pytest.fixture
def read(tmp_path):
    """Write a file; return its corners by Model.load, those of each object by scene_from_file, and their names."""

    def make(tree, blob, name="a.glb"):
        (tmp_path / name).write_bytes(glb(tree, blob) if name.endswith("glb") else json.dumps(tree).encode())
        model = ab.Model.load(tmp_path / name)
        scene = ab.scene_from_file(tmp_path / name, device="cpu")
        names = names_of(scene)
        found = {title: posed_triangles(scene, i) for i, title in enumerate(names)}
        vertices, faces, _ = model.mesh_at(model.lod_max)
        np.testing.assert_allclose(np.concatenate(list(found.values())), vertices[faces], atol=1e-6)
        return found

    return make


@pytest.mark.parametrize("mode, indices", [(5, None), (5, [4, 0, 3, 1, 2]), (6, None), (6, [2, 3, 4, 0, 1])])
def test_strips_and_fans(read, mode, indices):
    rim = {"attributes": {"POSITION": 2}, "mode": mode, "material": 1}
    points, more = (RIM, []) if mode == 6 or indices else (RIM[[4, 0, 3, 1, 2]], [])
    if indices:
        rim["indices"], more = 3, [np.array(indices, np.uint8)]
    found = read(*tree_of([POINTS, CORNERS, points, *more], [{**SOLID, "material": 0}, rim]))
    assert list(found) == ["crate"] and len(found["crate"]) == 12 + 3
    np.testing.assert_array_equal(found["crate"][:12], BOX.triangles)
    area = np.cross(*np.diff(found["crate"][12:], axis=1).transpose(1, 0, 2)) / 2
    assert (area[:, 2] > 0).all() and area.sum(0).tolist() == [0, 0, 2.5]


@pytest.mark.parametrize("shared", [True, False], ids=["shared vertices", "own vertices"])
def test_materials_do_not_part_an_object(read, shared, tmp_path):
    """Nor open it: it can be a solid, and does not meet itself."""
    parts = [{"attributes": {"POSITION": 0 if shared else 3 + k}, "indices": k, "material": k} for k in range(3)]
    pieces = np.split(CORNERS, 3)
    if shared:
        arrays, parts = [POINTS, *pieces], [{**part, "indices": 1 + k} for k, part in enumerate(parts)]
    else:
        arrays = [np.arange(12, dtype=np.uint16)] * 3 + [POINTS[piece] for piece in pieces]
    tree, blob = tree_of(arrays, parts, materials=[{}, {}, {}])
    (tmp_path / "one.glb").write_bytes(glb(tree, blob))
    alone = ab.scene_from_file(tmp_path / "one.glb", device="cpu", solid=True)
    assert alone.object_solid == [True] and not len(alone.intersect().pairs)
    tree["nodes"] += [{"mesh": 0, "name": "crate", "matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 0, 0, 1]}]
    tree["nodes"][0] |= {"children": [1], "translation": [0, 0, 1], "rotation": [0, 0, 1, 0], "scale": [2, 1, 1]}
    found = read(tree, blob)
    assert list(found) == ["crate", "crate_1"]
    first = BOX.triangles * [-2, -1, 1] + [0, 0, 1]
    np.testing.assert_allclose(found["crate"], first, atol=1e-12)
    second = (BOX.triangles[:, ::-1] * [-1, 1, 1] + [5, 0, 0]) * [-2, -1, 1] + [0, 0, 1]
    np.testing.assert_allclose(found["crate_1"], second, atol=1e-12)
    for triangles in found.values():
        solid = trimesh.Trimesh(**trimesh.triangles.to_kwargs(triangles))
        assert solid.is_watertight and solid.volume == pytest.approx(2)


def test_sparse_strided_and_quantized_positions(read):
    moved = BOX.faces[0][:2].astype(np.uint16)
    tree, blob = tree_of([POINTS, CORNERS, moved, POINTS[moved] + 10], [SOLID])
    sparse = {"count": 2, "indices": {"bufferView": 2, "componentType": 5123}, "values": {"bufferView": 3}}
    tree["accessors"][0]["sparse"] = sparse
    expected = POINTS.copy()
    expected[moved] += 10
    np.testing.assert_array_equal(read(tree, blob)["crate"], expected[BOX.faces])
    del tree["accessors"][0]["bufferView"]
    expected[[k for k in range(8) if k not in moved]] = 0
    whole = np.isin(BOX.faces, moved).sum(axis=1) == 2  # others have two corners at the origin
    np.testing.assert_array_equal(read(tree, blob)["crate"], expected[BOX.faces[whole]])
    whole = np.round(POINTS * 2 * 127).astype(np.int8)
    tree, blob = tree_of([np.pad(whole, ((0, 0), (0, 1))), CORNERS], [SOLID])
    tree["accessors"][0] |= {"type": "VEC3", "normalized": True}
    tree["bufferViews"][0]["byteStride"] = 4
    tree["extensionsRequired"] = ["KHR_mesh_quantization"]
    np.testing.assert_array_equal(read(tree, blob)["crate"], BOX.triangles * 2)


def test_instances(read):
    """EXT_mesh_gpu_instancing: an object each, where translation, turn and scale put it in the node's frame."""
    moves, turns = RIM[:2], np.array([[0, 0, 0, 1], [0, 0, 0.70710678, 0.70710678]], np.float32)
    sizes = np.array([[1, 1, 1], [1, 2, 1]], np.float32)
    own = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 2, "ROTATION": 3, "SCALE": 4}}}
    node = {"extensions": own, "translation": [0, 0, 7]}
    used = {"extensionsRequired": ["EXT_mesh_gpu_instancing"]}
    found = read(*tree_of([POINTS, CORNERS, moves, turns, sizes], [SOLID], node, **used))
    assert list(found) == ["crate[0]", "crate[1]"]
    np.testing.assert_allclose(found["crate[0]"], BOX.triangles + [5, 0, 7], atol=1e-6)
    turned = (BOX.triangles * [1, 2, 1])[..., [1, 0, 2]] * [-1, 1, 1] + [6, 0, 7]
    np.testing.assert_allclose(found["crate[1]"], turned, atol=1e-6)


def test_buffers_of_their_own(read, tmp_path):
    tree, blob = tree_of([POINTS, CORNERS], [SOLID])
    (tmp_path / "far off.bin").write_bytes(blob)
    inside = "data:application/octet-stream;base64," + base64.b64encode(blob).decode()
    for uri in ("far%20off.bin", inside):
        tree["buffers"][0]["uri"] = uri
        np.testing.assert_array_equal(read(tree, blob, "a.gltf")["crate"], BOX.triangles)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"mode": 0}, "left out points of mesh 'part'"),
        ({"mode": 3}, "left out lines of mesh 'part'"),
        ({"attributes": {"NORMAL": 2}, "mode": 4}, "left out what has no positions of mesh 'part'"),
        ({"targets": [{"POSITION": 0}]}, r"taken at rest: mesh 'part' \(morph targets\)"),
        ({"skin": 0}, r"taken at rest: crate \(skin\)"),
        ({"scenes": [{"nodes": [0]}, {"name": "spare", "nodes": [0]}]}, "left out scene 'spare'"),
        ({"visible": False}, r"left out lid \(invisible\)"),
    ],
)
def test_what_is_not_read_as_it_stands_is_named(tmp_path, change, message):
    tree, blob = tree_of([POINTS, CORNERS, RIM], [SOLID, {"attributes": {"POSITION": 2}, "mode": 6}])
    rim = tree["meshes"][0]["primitives"][1]
    faces = 12 if "mode" in change else 15
    if "visible" in change:
        tree["nodes"] += [{"mesh": 0, "name": "lid", "extensions": {"KHR_node_visibility": change}}]
        tree["nodes"][0]["children"] = [1]
    else:
        {"skin": tree["nodes"][0], "scenes": tree}.get(next(iter(change)), rim).update(change)
    (tmp_path / "a.glb").write_bytes(glb(tree, blob))
    with pytest.warns(UserWarning, match=rf"a\.glb: {message}$"):
        assert ab.Model.load(tmp_path / "a.glb").face_count == faces
    with pytest.warns(UserWarning, match=rf"a\.glb: {message}$"):
        assert names_of(ab.scene_from_file(tmp_path / "a.glb", device="cpu")) == ["crate"]


@pytest.mark.parametrize(
    "where, change, message",
    [
        ([], {"extensionsRequired": ["EXT_meshopt_compression"]}, "requires the glTF extension EXT_meshopt_compr"),
        ([], {"extensionsRequired": ["KHR_materials_unlit", "ABC_d"]}, "requires the glTF extension ABC_d"),
        ([], {"asset": {"version": "1.0"}}, r"is glTF 1\.0"),
        (["accessors", 1], {"count": 10**12}, "values of buffer view 1 end outside"),
        (["accessors", 0], {"bufferView": 7}, "is damaged: IndexError"),
        (["bufferViews", 1], {"byteLength": 10**6}, "buffer view 1 ends outside its buffer"),
        (["buffers", 0], {"uri": "gone.bin"}, r"buffer 'gone\.bin' cannot be read"),
        (["bufferViews", 0], {"buffer": 1}, "is damaged: IndexError"),
        (["bufferViews", 0], {"buffer": -1}, "is damaged: IndexError: -1 is below 0"),
        (["accessors", 0], {"bufferView": -3}, "is damaged: IndexError: -3 is below 0"),
        (["nodes", 0], {"mesh": -1}, "is damaged: IndexError: -1 is below 0"),
        (["scenes", 0], {"nodes": [-1]}, "is damaged: IndexError: -1 is below 0"),
        (["meshes", 0, "primitives", 0, "attributes"], {"POSITION": -3}, "is damaged: IndexError: -3 is below 0"),
        (["accessors", 1], {"componentType": 5126, "count": 9}, "mesh 'part': its indices are no integers"),
        (["nodes", 0], {"matrix": [1, 0, 0, 0.5, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}, "'crate': .* is not affine"),
        (["nodes", 0], {"children": [0]}, "node 0 hangs on two nodes or on itself"),
        (["meshes", 0, "primitives", 0], {"mode": 7}, "mesh 'part': a primitive of mode 7"),
        (["meshes", 0, "primitives", 0], {"mode": 0}, "left out points of mesh 'part'"),
        (["meshes", 0, "primitives", 0, "attributes"], {"POSITION": 2}, "mesh 'part': refers to vertex 7, but .* 5"),
    ],
)
def test_files_refused(tmp_path, where, change, message):
    tree, blob = tree_of([POINTS, CORNERS, RIM], [SOLID])
    place = tree
    for key in where:
        place = place[key]
    place.update(change)
    for suffix in ("glb", "gltf"):
        inside = {"uri": "data:;base64," + base64.b64encode(blob).decode()}
        tree["buffers"][0] = inside | tree["buffers"][0] if suffix == "gltf" else tree["buffers"][0]
        text = glb(tree, blob) if suffix == "glb" else json.dumps(tree).encode()
        (tmp_path / f"a.{suffix}").write_bytes(text)
        for load in (ab.Model.load, ab.scene_from_file):
            assert str(refused(ab.MeshError, message, load, tmp_path / f"a.{suffix}")).startswith(f"{tmp_path}")


def test_compressed_and_cut_files(tmp_path):
    tree, blob = tree_of([POINTS, CORNERS], [SOLID])
    (tmp_path / "a.glb").write_bytes(glb(tree, blob)[:-20])
    refused(ab.MeshError, "cut short", ab.Model.load, tmp_path / "a.glb")
    for accessor in tree["accessors"]:
        del accessor["bufferView"]
    packed = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    tree["meshes"][0]["primitives"][0]["extensions"] = packed
    (tmp_path / "a.glb").write_bytes(glb(tree, blob))
    said = r"mesh 'part': KHR_draco_mesh_compression (needs DracoPy|cannot be read)"
    refused(ab.MeshError, said, ab.Model.load, tmp_path / "a.glb")


@pytest.mark.parametrize("mode", [4, 5])
def test_triangles_of_draco(read, mode):
    """Lists of triangles, whatever the primitive says was packed."""
    draco = pytest.importorskip("DracoPy")
    data = draco.encode(POINTS.astype(float), CORNERS.reshape(-1, 3).astype(np.uint32), quantization_bits=16)
    packed = {"KHR_draco_mesh_compression": {"bufferView": 2, "attributes": {"POSITION": 0}}}
    tree, blob = tree_of([POINTS, CORNERS, np.frombuffer(data, np.uint8)], [SOLID | {"mode": mode}])
    tree["meshes"][0]["primitives"][0]["extensions"] = packed
    del tree["accessors"][0]["bufferView"]
    found = trimesh.Trimesh(**trimesh.triangles.to_kwargs(read(tree, blob)["crate"].round(3)))
    assert len(found.faces) == 12 and found.volume == pytest.approx(1, abs=0.01)


def test_objects_of_obj(tmp_path):
    """Relative indices count from where they stand; each `o` line begins an object, materials and groups do not."""
    lines, names = [], ["left", "right", "left"]
    for k, name in enumerate(names):
        lines += [f"o {name}", *(f"v {x + 5 * k} {y} {z}" for x, y, z in BOX.vertices), "usemtl red", "s off"]
        for half, material in ((BOX.faces[:6], "blue"), (BOX.faces[6:], "red")):
            lines += [*(f"f {a - 8} {b - 8} {c - 8}" for a, b, c in half), f"usemtl {material}", f"g {material}"]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    scene = ab.scene_from_file(tmp_path / "a.obj", device="cpu")
    assert names_of(scene) == ["left", "right", "left_1"]
    model = ab.Model.load(tmp_path / "a.obj")
    vertices, faces, _ = model.mesh_at(model.lod_max)
    for k in range(3):
        np.testing.assert_array_equal(posed_triangles(scene, k), BOX.triangles + [5 * k, 0, 0])
        np.testing.assert_array_equal(vertices[faces[12 * k : 12 * k + 12]], BOX.triangles + [5 * k, 0, 0])
    # The same with the indices written out, plainly.
    plain = [line for line in lines if line[0] in "ov"]
    for k in range(3):
        at = plain.index(f"o {names[k]}", 21 * k) + 9
        plain[at:at] = [f"f {a} {b} {c}" for a, b, c in (BOX.faces + 8 * k + 1).tolist()]
    (tmp_path / "b.obj").write_text("\n".join(plain))
    scene = ab.scene_from_file(tmp_path / "b.obj", device="cpu")
    assert names_of(scene) == ["left", "right", "left_1"] and [model.face_count for model in scene.models] == [12] * 3
