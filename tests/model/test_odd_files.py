"""Odd but valid mesh files, against the triangles that they hold; and what is wrong with them said by its name."""

import re
import struct
import zipfile

import numpy as np
import pytest
import trimesh
from helpers import refused
from helpers.scenes import names_of, posed_triangles

import warp_abtree as ab
from warp_abtree.model.mesh import load_mesh

BOX = trimesh.creation.box((1, 2, 3))


@pytest.mark.parametrize("kind", ["glb", "dae", "zip"])
def test_a_node_may_be_called_as_the_frame_of_all(tmp_path, kind):
    """Its transform counts, whatever trimesh calls the frame of a scene."""
    if kind == "dae":
        pytest.importorskip("collada")
    source = trimesh.Scene(base_frame="top")
    source.add_geometry(BOX, "World", transform=trimesh.transformations.translation_matrix([5, 6, 7]))
    data = source.export(file_type="glb") if kind != "dae" else trimesh.exchange.dae.export_collada(BOX)
    if kind == "dae":
        data = data.replace(b"<instance_geometry", b"<translate>5 6 7</translate><instance_geometry")
        data = re.sub(rb'(<node [^>]*name=")[^"]*', rb"\1World", data)
    path, data = tmp_path / f"a.{kind}", data.replace(b"World", b"world")
    path.write_bytes(data)
    if kind == "zip":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("inside.glb", data)
    scene = ab.scene_from_file(path, device="cpu")
    assert names_of(scene) == ["world"]
    np.testing.assert_allclose(posed_triangles(scene, 0), BOX.triangles + [5, 6, 7], atol=1e-6)
    vertices = ab.Model.load(path).mesh_at(0)[0]
    np.testing.assert_allclose([vertices.min(0), vertices.max(0)], BOX.bounds + [5, 6, 7], atol=1e-6)


def stl_text(*breaks):
    """Return a text file whose words are parted by these: after a solid's name, loop, vertices, endloop, endfacet."""
    name, loop, vertex, end, facet = breaks
    lines = [f"solid my vertex 2{name}"]
    for corners in BOX.triangles.tolist():
        points = vertex.join("vertex {} {} {}".format(*point) for point in corners)
        lines.append(f"facet normal 0 0 1{loop}outer loop{loop}{points}{end}endloop{facet}endfacet{facet}")
    return "".join(lines) + "endsolid"


@pytest.mark.parametrize(
    "breaks", ["NNNNN", "N  NN", "NNN N", "NN NN", "N   N", "N    ", "     ", "RRRRR"], ids=lambda text: repr(text)
)
def test_text_of_stl_is_free_of_lines(tmp_path, breaks):
    breaks = [{"N": "\n", "R": "\r", " ": " "}[key] for key in breaks]
    (tmp_path / "a.stl").write_text(stl_text(*breaks), newline="")
    check_box(tmp_path / "a.stl")


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("line", ["# made in C:\\", "o C:\\", "mtllib C:\\", "usemtl a\\", "s off # \\ or \\"])
def test_comments_and_names_of_obj_do_not_swallow_the_next_line(tmp_path, line, end):
    vertices = ["v {} {} {}".format(*vertex) for vertex in BOX.vertices]
    faces = [f"f {a + 1} {b + 1} \\{end} \\{end}{c + 1}" for a, b, c in BOX.faces]
    (tmp_path / "a.obj").write_text(end.join([line, *vertices, line, *faces]), newline="")
    check_box(tmp_path / "a.obj")
    (tmp_path / "a.obj").write_text(end.join([line, *vertices, line, *faces, "f 1 2 x"]), newline="")
    refused(ab.MeshError, r"a\.obj: line 47 cannot be read: f 1 2 x", load_mesh, tmp_path / "a.obj")


@pytest.mark.parametrize("order", ["", "<", ">"])
@pytest.mark.parametrize("first", [True, False], ids=["list first", "list last"])
def test_vertices_of_ply_may_have_lists(tmp_path, order, first):
    """Of several lengths, before and after their positions."""
    name = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    columns = ["property list uchar short near", "property double x\nproperty float y\nproperty double z"]
    head = ["ply", f"format {name} 1.0", "element vertex 8", *columns[:: 1 if first else -1], "element face 12"]
    head += ["property list uchar int vertex_indices", "end_header", ""]
    data = "\n".join(head).encode()
    for k, point in enumerate(BOX.vertices.tolist()):
        parts = [(k, *range(k)), point] if first else [point, (k, *range(k))]
        if order:
            data += b"".join(struct.pack(order + ("dfd" if part is point else f"B{k}h"), *part) for part in parts)
        else:
            data += " ".join(map(str, [*parts[0], *parts[1]])).encode() + b"\n"
    for face in BOX.faces.tolist():
        data += struct.pack(order + "B3i", 3, *face) if order else "3 {} {} {}\n".format(*face).encode()
    (tmp_path / "a.ply").write_bytes(data)
    check_box(tmp_path / "a.ply")


@pytest.mark.parametrize("kind", ["obj", "stl", "ply", "off", "glb", "gltf", "dae", "3mf", "zip"])
def test_what_git_lfs_did_not_fetch_is_said_to_be_that(tmp_path, kind):
    text = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'a' * 64}\nsize 12345\n"
    (tmp_path / f"a.{kind}").write_text(text)
    refused(ab.MeshError, "stands for a file that Git LFS has", load_mesh, tmp_path / f"a.{kind}")


def test_archives_hold_what_is_read_and_name_the_rest(tmp_path, monkeypatch):
    """3MF, too, where trimesh lacks the packages to read it."""
    pytest.importorskip("lxml"), pytest.importorskip("networkx")
    monkeypatch.setattr(trimesh, "available_formats", lambda: {"stl", "zip"})
    BOX.export(tmp_path / "a.3mf")
    for name, found in (("a.3mf", 12), ("a.usda", None)):
        with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
            archive.writestr(name, (tmp_path / "a.3mf").read_bytes())
        if found:
            assert ab.Model.load(tmp_path / "a.zip").face_count == found
        else:
            message = r"a\.zip: holds no mesh file \(left out a\.usda\)$"
            refused(ab.MeshError, message, ab.Model.load, tmp_path / "a.zip")


@pytest.fixture
def dae(tmp_path):
    """Return a function that writes a Collada file of a box, with a text of it replaced, and returns its path."""
    pytest.importorskip("collada")
    text = trimesh.exchange.dae.export_collada(BOX).decode()

    def write(old, new):
        assert old in text
        (tmp_path / "a.dae").write_text(text.replace(old, new, 1))
        return tmp_path / "a.dae"

    write.geometry = re.search("<geometry[^>]* id=.([^\"']*)", text)[1]
    return write


def check_box(path):
    scene = ab.scene_from_file(path, device="cpu")
    assert scene.object_count == 1
    np.testing.assert_allclose(posed_triangles(scene, 0), BOX.triangles)
    assert load_mesh(path).faces.shape == (12, 3)


def test_collada_coordinates_are_those_of_the_text(dae):
    """In float64; what is no number is refused, and not read as 0."""
    mesh = load_mesh(dae("-0.5", "-0.500000000001"))
    assert mesh.vertices.min(0)[0] == -0.500000000001
    for bad, message in (("NaN", "is not finite"), ("inf", "is not finite"), ("0,5", "cannot be read|broken")):
        refused(ab.MeshError, message, load_mesh, dae("-0.5", bad))


TURN = trimesh.transformations.rotation_matrix(np.radians(30), [1, 2, 3])
# From (9, 8, 7) along -x, (0, 2, 1) upwards: columns to the right, upwards and back.
LOOK = np.array([[0, 0, 1, 9], [1 / 5**0.5, 2 / 5**0.5, 0, 8], [-2 / 5**0.5, 1 / 5**0.5, 0, 7], [0, 0, 0, 1]])


@pytest.mark.parametrize(
    "texts, expected",
    [
        (["<translate>1234567.1 0 -0.3</translate>"], trimesh.transformations.translation_matrix([1234567.1, 0, -0.3])),
        (["<rotate>1 2 3 30</rotate>", "<scale>0.1 0.2 -0.3</scale>"], TURN @ np.diag([0.1, 0.2, -0.3, 1])),
        (["<rotate>0 0 0 30</rotate>", "<matrix>2 0 0 0.1 0 3 0 0 0 0 1 0 0 0 0 1</matrix>"],
         [[2, 0, 0, 0.1], [0, 3, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
        (["<lookat>9 8 7 5 8 7 0 2 1</lookat>"], LOOK),
    ],
)  # fmt: skip
def test_transforms_of_collada_are_those_of_the_text(dae, texts, expected):
    scene = ab.scene_from_file(dae("<instance_geometry", "".join(texts) + "<instance_geometry"), device="cpu")
    corners = trimesh.transform_points(BOX.triangles.reshape(-1, 3), expected)
    found = np.sort(posed_triangles(scene, 0).reshape(-1, 3), axis=0)
    np.testing.assert_allclose(found, np.sort(corners, axis=0), rtol=1e-15, atol=1e-15 * 2e6)
    odd = "<matrix>1 0 0 0 0 1 0 0 0 0 1 0 5 0 0 1</matrix><instance_geometry"
    for load in (load_mesh, ab.scene_from_file):
        refused(ab.MeshError, "its transform is not affine", load, dae("<instance_geometry", odd))


def test_what_collada_holds_beside_its_polygons_does_not_take_these_away(dae):
    lines = '<linestrips count="1"><p>0 1 2</p></linestrips></mesh>'
    with pytest.warns(UserWarning, match=f"a.dae: left out lines of '{dae.geometry}'$"):
        check_box(dae("</mesh>", lines))
    spare = '<visual_scene id="spare"><node><instance_geometry url="#{}"/></node></visual_scene>'
    spare = spare.format(dae.geometry)
    with pytest.warns(UserWarning, match="a.dae: left out scene 'spare'$"):
        check_box(dae("<library_visual_scenes>", f"<library_visual_scenes>{spare}"))
    inputs = '<input semantic="VERTEX" source="#none" offset="0"/>'
    for tag in ("triangles", "polylist", "polygons"):
        check_box(dae("</mesh>", f'<{tag} count="0">{inputs}</{tag}></mesh>'))
    skew = "<skew>45 1 0 0 0 1 0</skew>"
    refused(ab.MeshError, "a node has a <skew>", load_mesh, dae("<instance_geometry", f"{skew}<instance_geometry"))
