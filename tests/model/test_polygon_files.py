"""Polygons of every format against exact areas and points inside; parts, damage, and the limit on unpacking."""

import gzip
import io
import math
import struct
import sys
import tracemalloc
import zipfile
from fractions import Fraction

import numpy as np
import pytest
import trimesh
from helpers import refused
from helpers.scenes import names_of

import warp_abtree as ab
from warp_abtree.model.files import unpack
from warp_abtree.model.files.polygons import triangulate
from warp_abtree.model.mesh import load_mesh

LETTER = [(4, 1), (1, 1), (1, 3), (4, 3), (4, 4), (0, 4), (0, 0), (4, 0)]
COMB = [(14, 0), *[p for k in range(6, -1, -2) for p in ((k * 2, 1), (k * 2, 9), (k * 2 - 2, 9), (k * 2 - 2, 1))]]
COMB = [*COMB[:-1], (-2, 0)]
TURNS = [(round(64 * r * math.cos(k / 3)), round(64 * r * math.sin(k / 3))) for r in (1, 2) for k in range(20)]
SPIRAL = [(x * (k + 6), y * (k + 6)) for k, (x, y) in enumerate(TURNS[20:])]
SPIRAL += [(x * (k + 6), y * (k + 6)) for k, (x, y) in reversed(list(enumerate(TURNS[:20])))]
DOUBLED = [point for point in LETTER[5:] + LETTER[:5] for _ in range(2)]
LINKED = [(0, 0), (9, 0), (9, 9), (0, 9), (0, 0), (1, 1), (1, 4), (4, 4), (5, 5)]  # two holes
LINKED += [(5, 8), (8, 8), (8, 5), (5, 5), (4, 4), (4, 1), (1, 1)]
NOTCHED = [(0, 0), (2**17, 0), (2**17, 2**17), (0, 2**17), (0, 2), (1, 1)]
POLYGONS = {"letter": LETTER, "comb": COMB, "spiral": SPIRAL, "letter turned": LETTER[3:] + LETTER[:3]}
POLYGONS |= {"doubled": DOUBLED, "linked holes": LINKED, "notched": NOTCHED}
DAE = """<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset>
<created>2020-01-01T00:00:00</created><modified>2020-01-01T00:00:00</modified></asset><library_geometries>
<geometry id="g"><mesh><source id="p"><float_array id="a" count="{numbers}">{points}</float_array><technique_common>
<accessor source="#a" count="{count}" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source><vertices id="v"><input semantic="POSITION"
source="#p"/></vertices>{primitives}</mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="s">
<node name="plate"><instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>"""
INPUT = '<input semantic="VERTEX" source="#v" offset="0"/>'


def ply(points, faces, order="", kind="int", length="uchar"):
    """Return a PLY file with more columns than are needed, in text ("") or binary ("<", ">")."""
    name = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    data = f"ply\nformat {name} 1.0\ncomment by hand\nelement vertex {len(points)}\n"
    data += "property float x\nproperty double y\n"
    data += f"property float z\nproperty uchar red\nelement face {len(faces)}\nproperty uchar flag\n"
    data += f"property list {length} {kind} vertex_indices\nproperty list uchar float texcoord\nend_header\n"
    if order == "":
        data += "".join(f"{x} {y} 0 255\n" for x, y in points)
        data += "".join(f"1 {len(face)} {' '.join(map(str, face))} 2 0.5 0.5\n" for face in faces)
        return data.encode()
    body = b"".join(struct.pack(order + "fdfB", x, y, 0, 255) for x, y in points)
    for face in faces:
        corners = np.array(face, order + {"int": "i4", "ushort": "u2"}[kind]).tobytes()
        counts = struct.pack(order + {"uchar": "BB", "short": "Bh"}[length], 1, len(face))
        body += counts + corners + struct.pack(order + "Bff", 2, 0.5, 0.5)
    return data.encode() + body


def off(points, faces, head="OFF\n", more=""):
    rows = "".join(f"{x} {y} 0{more}\n" for x, y in points)
    listed = "".join(f"{len(face)} {' '.join(map(str, face))} 0.5 0.5 0.5\n" for face in faces)
    return f"# by hand\n{head}{len(points)} {len(faces)} 0 # counts\n\n{rows}{listed}".encode()


def obj(points, faces):
    lines = "".join(f"f {' '.join(str(k + 1) for k in face)}\n" for face in faces)
    return ("".join(f"v {x} {y} 0\n" for x, y in points) + lines).encode()


def dae(points, primitives):
    listed = " ".join(f"{x} {y} 0" for x, y in points)
    return DAE.format(numbers=3 * len(points), count=len(points), points=listed, primitives=primitives).encode()


def polylist(faces):
    counts, corners = " ".join(str(len(face)) for face in faces), " ".join(str(k) for face in faces for k in face)
    return f'<polylist count="{len(faces)}">{INPUT}<vcount>{counts}</vcount><p>{corners}</p></polylist>'


def polygons(faces):
    listed = "".join(f"<p>{' '.join(map(str, face))}</p>" for face in faces)
    return f'<polygons count="{len(faces)}">{INPUT}{listed}</polygons>'


def zipped(data, name="inside.off", other="readme.txt"):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, data)
        archive.writestr(other, "none")
    return file.getvalue()


WRITERS = {
    "a.obj": obj,
    "text.ply": ply,
    "little.ply": lambda points, faces: ply(points, faces, "<"),
    "big.ply": lambda points, faces: ply(points, faces, ">", "ushort", "short"),
    "packed.ply.gz": lambda points, faces: gzip.compress(ply(points, faces, "<", "ushort")),
    "plain.off": off,
    "joined.off": lambda points, faces: off(points, faces, "OFF"),
    "colours.off": lambda points, faces: off(points, faces, "COFF\n", " 255 0 0 255"),
    "normals.off": lambda points, faces: off(points, faces, "NOFF\n", " 0 0 1"),
    "archive.zip": lambda points, faces: zipped(off(points, faces)),
    "polylist.dae": lambda points, faces: dae(points, polylist(faces)),
    "polygons.dae": lambda points, faces: dae(points, polygons(faces)),
}


def crosses(corners, point):
    """Whether a polygon of the plane holds a point, by the crossings of a ray; exact."""
    inside, (px, py) = False, point
    for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1]):
        if (ay > py) != (by > py) and px < ax + Fraction((py - ay) * (bx - ax), by - ay):
            inside = not inside
    return inside


def check_cover(triangles, polygon):
    """Check that triangles (n, 3, 3) of the plane z = 0 cover a polygon, each of its points once."""
    flat = [[(Fraction(x), Fraction(y)) for x, y, _ in corners] for corners in triangles.tolist()]

    def area(ring):
        return sum(a[0] * b[1] - b[0] * a[1] for a, b in zip(ring, ring[1:] + ring[:1]))

    assert sum(abs(area(ring)) for ring in flat) == abs(area(polygon)) and (triangles[..., 2] == 0).all()
    assert all(area(ring) * area(polygon) >= 0 for ring in flat)
    (left, low), (right, high) = np.min(polygon, axis=0), np.max(polygon, axis=0)
    steps = [Fraction(2 * k + 1, 22) + Fraction(1, 10**6) for k in range(11)]
    for u in steps:
        for v in steps:
            point = (int(left) + u * int(right - left), int(low) + v * int(high - low))
            assert sum(crosses(ring, point) for ring in flat) == crosses(polygon, point)


@pytest.mark.parametrize(
    "name, shape", [*((name, "linked holes") for name in WRITERS), *(("a.obj", shape) for shape in POLYGONS)]
)
def test_polygons_are_covered_once(tmp_path, name, shape):
    """In the order of the file, beside triangles and quads, by both ways in."""
    if name.endswith(".dae"):
        pytest.importorskip("collada")
    points = [*POLYGONS[shape], (50, 0), (51, 0), (51, 1), (50, 1)]
    count = len(POLYGONS[shape])
    faces = [[count, count + 1, count + 2], list(range(count)), [count, count + 1, count + 2, count + 3]]
    (tmp_path / name).write_bytes(WRITERS[name](points, faces))
    mesh = load_mesh(tmp_path / name)
    scene = ab.scene_from_file(tmp_path / name, device="cpu")
    names = names_of(scene)
    stem = {"archive.zip": "inside", "packed.ply.gz": "packed"}.get(name, name.split(".")[0])
    assert names == ["plate" if name.endswith(".dae") else stem]
    vertices, found, _ = scene.models[0].mesh_at(scene.models[0].lod_max)
    dropped = len(mesh.dropped_faces)
    for triangles, fewer in ((mesh.vertices[mesh.faces], 0), (vertices[found], dropped)):
        assert len(triangles) == 1 + count - 2 + 2 - fewer
        quad = triangles[[0, -2, -1]]
        assert (quad >= [50, 0, 0]).all() and (quad <= [51, 1, 0]).all(), "faces keep the order of the file"
        check_cover(triangles[1:-2], POLYGONS[shape])


BENT = [(16, 3), (14, 10), (19, 16), (10, 18), (5, 5), (8, 4), (0, 2), (5, 1)]
TEETH = [(2, 4), (3, 17), (4, 7), (9, 7), (8, 17), (12, 10), (18, 12), (19, 7), (13, 7), (13, 0), (10, 0), (8, 1)]
STEPS = [(0, 0), (0, 1), (1, 1), (1, 5), (2, 5), (2, 1), (3, 1), (3, 6), (4, 6), (4, 0), (2, 0)]


@pytest.mark.parametrize("ring", [BENT, TEETH, STEPS, LETTER, COMB, NOTCHED], ids=len)
def test_polygons_of_any_plane_do_not_fold(ring):
    """Corners on lines through others are beside them by rounding, either way."""
    rng = np.random.default_rng(len(ring))
    middles = (np.array(ring) + np.roll(ring, -1, axis=0)) / 2
    for k in range(80):
        flat = np.stack([ring, middles], 1).reshape(-1, 2)[:: 1 if k % 2 else 2]
        flat = np.roll(flat, k, axis=0)[:: rng.choice([-1, 1])]
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0] if k % 8 else np.roll(np.eye(3), k // 8, axis=0)
        points = np.pad(flat, ((0, 0), (0, 1))) @ turn + rng.normal(size=3) * 9
        corners = points[triangulate(points, np.array([len(flat)]), np.arange(len(flat)), "")]
        x, y = (flat - flat[0]).T
        area = abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
        assert trimesh.triangles.area(corners).sum() == pytest.approx(area, rel=1e-9)


def test_strips_are_wound_alike(tmp_path):
    """Triangle strips of PLY, -1 between them, and of Collada: against the triangles written out."""
    expected = [[7, 0, 6], [6, 0, 1], [1, 2, 6], [6, 2, 5]]
    head = "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n"
    points = "".join(f"{x} {y} 0\n" for x, y in LETTER)
    strips = "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_text(head + strips + points + "10 7 0 6 1 -1 1 2 6 5 -1\n")
    mesh = load_mesh(tmp_path / "a.ply")
    assert mesh.faces.tolist() == np.searchsorted([0, 1, 2, 5, 6, 7], expected).tolist()
    pytest.importorskip("collada")
    strips = f'<tristrips count="2">{INPUT}<p>7 0 6 1</p><p>1 2 6 5</p></tristrips>'
    (tmp_path / "a.dae").write_bytes(dae(LETTER, strips))
    mesh = load_mesh(tmp_path / "a.dae")
    areas = np.cross(*np.diff(mesh.vertices[mesh.faces], axis=1).transpose(1, 0, 2))[:, 2]
    true = np.array(LETTER)[np.array(expected)]
    assert sorted(areas) == pytest.approx(sorted(np.linalg.det(np.diff(true, axis=1))))


def test_objects_of_dae(tmp_path):
    """A node of several materials is one object; instances and nodes share a model; lines are named."""
    pytest.importorskip("collada")
    lines = f'<lines count="1">{INPUT}<p>0 1</p></lines>'
    data = dae(LETTER, polylist([[0, 1, 6]]) + polylist([list(range(8))]) + lines).decode()
    nodes = """<node id="one"><translate>1 0 0</translate><instance_geometry url="#g"/><node name="sub">
        <scale>2 2 2</scale><instance_geometry url="#g"/></node></node><node><instance_node url="#lib"/></node>"""
    library = """<library_nodes><node id="lib"><translate>0 9 0</translate><instance_geometry url="#g"/></node>
        </library_nodes><library_visual_scenes>"""
    data = data.replace('<node name="plate"><instance_geometry url="#g"/></node>', nodes)
    (tmp_path / "a.dae").write_text(data.replace("<library_visual_scenes>", library))
    with pytest.warns(UserWarning, match=r"a\.dae: left out lines of 'g'"):
        scene = ab.scene_from_file(tmp_path / "a.dae", device="cpu")
        names = names_of(scene)
    assert names == ["one", "sub", "lib"] and len(scene.models) == 2
    assert scene.batch().objects.pool.position.numpy().tolist() == [[1, 0, 0], [1, 0, 0], [0, 9, 0]]


LATTICE = b'<?xml version="1.0"?><model xmlns:b="http://x/beamlattice/2017/02" requiredextensions="b"></model>'
FACES, HEAD = [list(range(8))], ply(LETTER, [])
BOX, PLATE = trimesh.creation.box(), dae(LETTER, polylist(FACES))
BINARY, TEXT = BOX.export(file_type="stl"), BOX.export(file_type="stl_ascii").encode()

MARKED = {kind: BOX.export(file_type=kind) for kind in ("obj", "off", "stl_ascii")}
MARKED = {kind: text.encode() for kind, text in MARKED.items()} | {"ply": BOX.export(file_type="ply", encoding="ascii")}


@pytest.mark.parametrize(
    "name, data, message",
    [
        ("", None, "is a folder"),
        ("nowhere.obj", None, r"nowhere\.obj: no such file"),
        ("a.docx", b"", "unknown extension 'docx'; known here: .*obj"),
        ("a.xyz", b"0 0 0\n1 1 1\n", "no faces .*PointCloud"),
        ("a.obj", obj(LETTER, []), "no faces"),
        ("a.obj", b"f 1 2 3\n", "no vertices"),
        ("a.obj", b"v 0 0 0\nv 1 0 x\n", "line 2 cannot be read"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nf 1 2\n", "line 3 cannot be read"),
        ("a.obj", b"v 0 0 0\nf 1 2 -2\n", "line 2 refers to a vertex before the first"),
        ("a.obj", obj(LETTER, FACES).replace(b"v 1 1", b"v nan 1"), "vertex 1 is not finite"),
        ("a.obj.gz", b"not gzip at all", "cannot be read"),
        ("a.obj.gz", gzip.compress(obj(LETTER, FACES), mtime=0)[:-20], "cannot be read"),
        ("a.ply", b"not a ply", "cannot be read as ply"),
        ("a.ply", ply(LETTER, [[0, 1]]), "face 0 has 2 corners"),
        ("a.ply", ply(LETTER, [[0, 1, 2, 8]]), "face 0 refers to vertex 8"),
        ("a.ply", ply(LETTER, [[0, 1, 2, -1]], "<"), "face 0 refers to vertex -1"),
        ("a.ply", ply(LETTER, FACES * 2, "<")[:-3], "cut short: .* 2 'face', 1 are whole"),
        ("a.ply", ply(LETTER, FACES * 2)[:-30], "cut short|does not fit the header"),
        ("a.ply", HEAD.replace(b"vertex 8", b"vertex 99999999999"), "cut short: .* 8 are whole"),
        ("a.ply", ply(LETTER, FACES, "<").replace(b"face 1\n", b"face 4000000000\n"), "cut short"),
        ("a.ply", ply(LETTER, FACES).replace(b" 2 0.5 0.5\n", b"\n"), "does not fit the header"),
        ("a.ply", HEAD, r"no faces \(it holds vertex\)"),
        ("a.ply", HEAD.replace(b"float x", b"float u"), "no vertices with x, y and z"),
        ("a.ply", HEAD.replace(b"float x", b"quaternion x"), "header line 'property quaternion x'"),
        ("a.off", off(LETTER, FACES * 2)[:-30], "cut short|line 13 cannot be read"),
        ("a.off", off(LETTER, FACES).replace(b"8 1 0 #", b"9 1 0 #"), "cut short: it declares 9 vertices"),
        ("a.off", off(LETTER, [[0, 1, 2, 8]]), "face 0 refers to vertex 8"),
        ("a.off", off(LETTER, FACES, "OFF BINARY\n"), "BINARY is not read"),
        ("a.off", off(LETTER, FACES, "4OFF\n"), "4OFF is not read"),
        ("a.off", b"solid", "does not begin with OFF"),
        ("a.stl", b"solid x\nfacet\nendsolid", "no faces"),
        ("a.stl", TEXT.replace(b"vertex ", b"vertex x ", 1), "cannot be read as stl"),
        ("a.stl", BINARY[:90], "no faces: its header declares 12 facets"),
        ("a.stl", BINARY[:80] + bytes(4) + BINARY[84:], "declares 0 facets, and 12 would fit"),
        ("a.stl", BINARY[:80] + bytes(4), "declares 0 facets, and 0 would fit"),
        ("a.stl", TEXT.replace(b"endloop", b"vertex 0 0 0\nendloop"), "a facet of 4 vertices"),
        ("a.dae", dae(LETTER, f"<polygons>{INPUT}<ph><p>0 1 2</p><h>3 4 5</h></ph></polygons>"), "'g' has .* holes"),
        ("a.dae", dae(LETTER, polylist(FACES).replace(">8<", ">7<")), "'g': its polygons have 7 corners"),
        ("a.dae", PLATE.replace(b'stride="3"', b'stride="3" offset="3"'), "'g' has positions that are not X, Y and Z"),
        ("a.dae", PLATE.replace(b'"X"', b'"W"').replace(b'"Z"', b'"X"').replace(b'"W"', b'"Z"'), "'g' has positions"),
        ("a.zip", zipped(off(LETTER, [[0, 1]])), "inside.off: line"),
        ("a.zip", zipped(b"", "b.txt"), "holds no mesh file"),
        ("a.3mf", zipped(LATTICE, "3D/3dmodel.model"), "requires the 3MF extension http://x/beamlattice/2017/02"),
        ("a.obj", b"o a\n" + obj(LETTER, [[0, 1, 8]]), "face 0 refers to vertex 8"),
        ("a.obj", obj(LETTER, []) + b"surf 0 1 0 1 1 2 3 4\nl 1 2\n", r"\(left out free-form surfaces, lines\)"),
        ("a.step", b"ISO-10303-21;", "pip install cascadio"),
        ("a.usda", b"#usda 1.0", "read by scene_from_file"),
    ],
)
def test_damaged_files(tmp_path, name, data, message, monkeypatch):
    if name == "a.dae":
        pytest.importorskip("collada")
    if name == "a.3mf":
        pytest.importorskip("lxml")
    if name == "a.step":
        monkeypatch.setitem(sys.modules, "cascadio", None)
    if data is not None:
        (tmp_path / name).write_bytes(data)
    only_meshes = name in ("a.usda", "a.xyz")
    for read in (load_mesh, lambda path: ab.scene_from_file(path, device="cpu"))[: 1 if only_meshes else 2]:
        caught = refused(ab.MeshError, message, read, tmp_path / name)
        assert str(caught).startswith(f"{tmp_path / name}: ")


@pytest.mark.parametrize(
    "name, data, count, message",
    [
        ("a.stl", BINARY[:-60], 10, "cut short: 10 facets are read of the 12"),
        ("a.stl", b"solid" + bytes(75) + BINARY[80:-60], 10, "cut short: 10 facets are read of the 12"),
        ("a.stl", BINARY + b"xyzzy", 12, "left out 5 bytes behind the 12 facets"),
        ("a.stl", TEXT[: TEXT.rindex(b"vertex") + 9], 11, "cut short: 11 facets are whole"),
        ("a.stl", TEXT + bytes(3), 12, None),
        *((f"a.{kind}", b"\xef\xbb\xbf" + data, len(BOX.faces), None) for kind, data in MARKED.items()),
        ("a.ply", ply(LETTER, FACES, "<") + b"more", 6, "left out what follows"),
        ("a.ply", ply(LETTER, FACES).replace(b"element face", b"element edge 0\nelement face"), 6, None),
        ("a.off", off(LETTER, FACES) + b"3 0 1 2\n", 6, "left out 1 lines"),
        ("a.obj", b"\xef\xbb\xbf" + obj(LETTER, FACES), 6, None),
        ("a.obj", obj(LETTER, FACES) + b"l 1 2\np 3\n", 6, "left out lines, points"),
        ("a.obj", obj(LETTER, FACES) + b"fo 1 2 3\nbsp 1 2\n", 6, "left out faces as 'fo', free-form surfaces"),
        ("a.zip", zipped(obj(LETTER, FACES), "a.obj", "b.obj.gz"), 6, "left out b.obj.gz"),
    ],
)
def test_what_is_left_out_is_named(tmp_path, name, data, count, message, recwarn):
    (tmp_path / name).write_bytes(data)
    faces = ab.Model.load(tmp_path / name).face_count
    scene = ab.scene_from_file(tmp_path / name, device="cpu")
    assert faces == count == scene.models[0].face_count
    said = [(str(warning.message), warning.filename) for warning in recwarn]
    assert len(said) == (0 if message is None else 2)
    assert all(text.startswith(f"{tmp_path / name}: {message}") and file == __file__ for text, file in said)


def test_a_cached_model_warns_again(tmp_path, monkeypatch):
    monkeypatch.setenv("WARP_ABTREE_CACHE", str(tmp_path / "cache"))
    (tmp_path / "ball.stl").write_bytes(trimesh.creation.icosphere(subdivisions=3).export(file_type="stl")[:-60])
    for _ in range(2):
        with pytest.warns(UserWarning, match="cut short: 1,278 facets"):
            ab.Model.load(tmp_path / "ball.stl")
    assert len(list((tmp_path / "cache").glob("*.npz"))) == 1


def test_a_solid_of_stl_is_an_object(tmp_path):
    (tmp_path / "a.stl").write_bytes(b"solid a b\n" + TEXT.split(b"\n", 1)[1] + b"\n" + TEXT.split(b"\n", 1)[1])
    text = (tmp_path / "a.stl").read_bytes().replace(b"endsolid", b"endsolid\nsolid second", 1)
    (tmp_path / "a.stl").write_bytes(text)
    assert names_of(ab.scene_from_file(tmp_path / "a.stl", device="cpu")) == ["a b", "second"]
    assert ab.Model.load(tmp_path / "a.stl").face_count == 24


def test_members_of_archives(tmp_path):
    """Files are looked for beside the member that names them; those that macOS hides are no meshes."""
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("__MACOSX/._a.stl", bytes([0, 5, 22, 7]) + bytes(100))
        for folder, size in (("", 1), ("sub/", 2), ("sub/sub/", 3)):
            for name, data in trimesh.Scene(trimesh.creation.box(extents=[size] * 3)).export(file_type="gltf").items():
                archive.writestr(folder + name, data)
    mesh = load_mesh(tmp_path / "a.zip")
    sizes = np.ptp(mesh.vertices[mesh.faces].reshape(3, 36, 3), axis=1)
    assert sizes.tolist() == [[1.0] * 3, [2.0] * 3, [3.0] * 3]


@pytest.mark.parametrize("name", ["a.obj.gz", "a.zip", "a.3mf", "a.npz"])
def test_files_that_unpack_to_too_much_are_refused(tmp_path, name, monkeypatch):
    monkeypatch.setattr(unpack, "UNPACKED_BYTES", 2**16)
    text = obj(LETTER, FACES) + b"#" * 2**18
    data = gzip.compress(text) if name == "a.obj.gz" else zipped(text, "a.obj")
    if name == "a.npz":
        np.savez_compressed(tmp_path / name, vertex_pos=np.zeros(2**15))
    else:
        (tmp_path / name).write_bytes(data)
    read = ab.Model.open if name == "a.npz" else load_mesh
    refused((ab.MeshError, ab.ModelError), r"unpacks to more than .* MiB", read, tmp_path / name)
    monkeypatch.setattr(unpack, "UNPACKED_RATIO", 10**6)
    if name in ("a.obj.gz", "a.zip"):
        assert len(load_mesh(tmp_path / name).faces) == 6


@pytest.mark.parametrize("name", ["a.zip", "a.3mf"])
def test_archives_that_lie_about_sizes(tmp_path, name):
    data = bytearray(zipped(b"#" * 2**26, "a.model" if name == "a.3mf" else "a.obj"))
    entry = data.index(b"PK\1\2")
    data[entry + 24 : entry + 28] = struct.pack("<I", 100)
    (tmp_path / name).write_bytes(data)
    tracemalloc.start()
    refused(ab.MeshError, "Bad CRC-32", load_mesh, tmp_path / name)
    assert tracemalloc.get_traced_memory()[1] < 2**24
    tracemalloc.stop()


def test_declared_sizes_are_checked_before_arrays_are_made(tmp_path):
    ab.Model.load(BOX).save(tmp_path / "a.npz")
    arrays = dict(np.load(tmp_path / "a.npz"))
    with zipfile.ZipFile(tmp_path / "b.npz", "w") as archive:
        for key, value in arrays.items():
            file = io.BytesIO()
            np.save(file, value)
            if key == "vertex_parent":
                file.seek(0)
                header = {"descr": "<i4", "fortran_order": False, "shape": (10**6,)}
                np.lib.format.write_array_header_1_0(file, header)
            archive.writestr(f"{key}.npy", file.getvalue())
    said = r"member 'vertex_parent\.npy' has another length than its array"
    refused(ab.ModelError, said, ab.Model.open, tmp_path / "b.npz")
