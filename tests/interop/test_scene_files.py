"""Scenes from and to trimesh, glTF and USD: every mesh in its place, intersecting faces in colour."""

import math

import numpy as np
import pytest
import trimesh

import warp_abtree as ab

TURN, SHIFT = trimesh.transformations.rotation_matrix, trimesh.transformations.translation_matrix
BOX = trimesh.creation.box((1, 2, 3))
GREY, RED = [176, 176, 176], [214, 39, 40]


def posed_triangles(scene, i):
    """Corners of an object's original faces in the world."""
    model, objects = scene.models[scene.object_model[i]], scene.batch().objects.pool
    vertices, faces, _ = model.mesh_at(model.lod_max)
    return (vertices @ objects.rotation.numpy()[i].T + objects.position.numpy()[i])[faces]


def nodes_in_the_world(source):
    found = {}
    for node in source.graph.nodes_geometry:
        transform, geometry = source.graph[node]
        mesh = source.geometry[geometry].copy()
        mesh.apply_transform(transform)
        found[node] = mesh
    return found


def assembly(with_extras=False):
    """Instances that are rigid, scaled alike, stretched and mirrored, under a parent that moves them all."""
    source = trimesh.Scene()
    source.graph.update("parent", matrix=TURN(0.3, [1, 2, 3], [1, 0, 0]))
    for name, mesh in (("ball", trimesh.creation.icosphere(subdivisions=1)), ("box", BOX)):
        source.add_geometry(mesh, node_name=f"{name} 0", geom_name=name, parent_node_name="parent")
    double, mirror, flat = np.diag([2, 2, 2, 1.0]), np.diag([1, -1, 1, 1.0]), np.diag([1, 0.5, 0.25, 1.0])
    matrices = [TURN(1, [0, 1, 0], [0, 0, 2]), TURN(1, [0, 1, 1]) @ double, TURN(2, [3, 1, 0]) @ double]
    matrices += [TURN(0.4, [0, 0, 1]) @ mirror, TURN(0.7, [0, 1, 0.2]) @ flat @ TURN(0.2, [1, 0, 0])]
    for k, matrix in enumerate(matrices):
        for name in ("ball", "box"):
            source.graph.update(f"{name} {k + 1}", "parent", matrix=matrix, geometry=name)
    if with_extras:
        source.add_geometry(trimesh.PointCloud(np.eye(3)), node_name="points")
        source.add_geometry(trimesh.load_path(np.eye(3)), node_name="path")
    return source


def assert_matches(scene, names, meshes, tolerance=1e-12):
    assert sorted(names) == sorted(meshes) and scene.object_count == len(names)
    for i, name in enumerate(names):
        assert np.allclose(posed_triangles(scene, i), meshes[name].triangles, atol=tolerance), name


def test_trimesh_scene_in():
    source = assembly(with_extras=True)
    scene, names = ab.scene_from_trimesh(source, device="cpu")
    meshes = {name: mesh for name, mesh in nodes_in_the_world(source).items() if isinstance(mesh, trimesh.Trimesh)}
    assert_matches(scene, names, meshes)
    # Rigid, doubled, mirrored, flattened: four of each geometry.
    assert len(scene.models) == 8 and len(names) == 12
    for i, model in enumerate(scene.models):
        vertices, faces, _ = model.mesh_at(model.lod_max)
        assert trimesh.Trimesh(vertices, faces).volume > 0, f"model {i} is inside out"


def test_sources_refused(tmp_path):
    with pytest.raises(TypeError, match=r"Trimesh, not a trimesh\.Scene"):
        ab.scene_from_trimesh(trimesh.creation.box())
    with pytest.raises(ab.MeshError, match="no node with a mesh"):
        ab.scene_from_trimesh(trimesh.Scene([trimesh.PointCloud(np.eye(3))]))
    flat = trimesh.Scene()
    flat.add_geometry(trimesh.creation.box(), node_name="plate", transform=np.diag([1, 1, 0, 1]))
    with pytest.raises(ab.MeshError, match="node 'plate': its transform is singular"):
        ab.scene_from_trimesh(flat)
    with pytest.raises(ab.MeshError, match=r"gone\.glb: no such file"):
        ab.scene_from_file(tmp_path / "gone.glb")
    for suffix in ("glb", "txt", "usda"):
        (tmp_path / f"junk.{suffix}").write_text("junk")
        if suffix == "usda":
            pytest.importorskip("pxr")
        with pytest.raises(ab.MeshError, match=rf"junk\.{suffix}: cannot be read"):
            ab.scene_from_file(tmp_path / f"junk.{suffix}")


# Where the prims of `write_usd` are in the world.
USD_PRIMS = {
    "/root/still": SHIFT([1, 2, 3]),
    "/root/turned": SHIFT([6, 2, 3]) @ TURN(math.pi / 2, [0, 0, 1]),
    "/root/left": SHIFT([1, 11, 3]),
    "/thing/mesh": np.eye(4),
    "/copy0/mesh": SHIFT([0, 0, 10]),
    "/copy1/mesh": SHIFT([0, 0, 20]),
    "/many[0]/many/prototype": SHIFT([100, 7, 1]),
    "/many[1]/many/prototype": SHIFT([100, 7, 2]),
}


def write_usd(path):
    """Write boxes, one quad, a left-handed mesh, two instances of a prim and a point instancer."""
    from pxr import Gf, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(path))

    def define(where, faces=BOX.faces, shift=None):
        mesh = UsdGeom.Mesh.Define(stage, where)
        mesh.GetPointsAttr().Set([Gf.Vec3f(*map(float, v)) for v in BOX.vertices])
        mesh.GetFaceVertexCountsAttr().Set([len(face) for face in faces])
        mesh.GetFaceVertexIndicesAttr().Set(np.ravel(faces).tolist())
        if shift is not None:
            mesh.AddTranslateOp().Set(Gf.Vec3d(*shift))
        return mesh

    UsdGeom.Xform.Define(stage, "/root").AddTranslateOp().Set(Gf.Vec3d(1, 2, 3))
    define("/root/still")
    define("/root/turned", shift=(5, 0, 0)).AddRotateZOp().Set(90.0)
    define("/root/left", BOX.faces[:, ::-1], (0, 9, 0)).GetOrientationAttr().Set("leftHanded")
    define("/root/quad", [[0, 1, 3, 2]])
    UsdGeom.Xform.Define(stage, "/thing")
    define("/thing/mesh")
    for k in range(2):
        prim = UsdGeom.Xform.Define(stage, f"/copy{k}")
        prim.AddTranslateOp().Set(Gf.Vec3d(0, 0, 10 * (k + 1)))
        prim.GetPrim().GetReferences().AddInternalReference("/thing")
        prim.GetPrim().SetInstanceable(True)
    many = UsdGeom.PointInstancer.Define(stage, "/many")
    many.AddTranslateOp().Set(Gf.Vec3d(100, 0, 0))
    many.CreatePrototypesRel().AddTarget(define("/many/prototype", shift=(0, 7, 0)).GetPath())
    many.CreateProtoIndicesAttr([0, 0])
    many.CreatePositionsAttr([Gf.Vec3f(0, 0, 1), Gf.Vec3f(0, 0, 2)])
    stage.GetRootLayer().Save()


@pytest.mark.parametrize("suffix", ["usda", "usdc"])
def test_usd_in(tmp_path, suffix):
    pytest.importorskip("pxr")
    path = tmp_path / f"scene.{suffix}"
    write_usd(path)
    scene, names = ab.scene_from_file(path, device="cpu")
    assert sorted(names) == sorted([*USD_PRIMS, "/root/quad"]) and len(scene.models) == 2
    for i, name in enumerate(names):
        if name == "/root/quad":
            assert scene.models[scene.object_model[i]].face_count == 2
            continue
        corners = trimesh.transform_points(BOX.triangles.reshape(-1, 3), USD_PRIMS[name]).reshape(-1, 3, 3)
        found = posed_triangles(scene, i)
        assert np.allclose(np.sort(found.reshape(-1, 9)), np.sort(corners.reshape(-1, 9)), atol=1e-5), name
        normal = trimesh.triangles.normals(found)[0]
        assert ((found.mean(1) - found.mean((0, 1))) * normal).sum(1).min() > 0, f"{name} is inside out"


def red_faces(mesh):
    colours = np.asarray(mesh.visual.vertex_colors)[mesh.faces][..., :3]
    red = (colours == RED).all((1, 2))
    assert (red | (colours == GREY).all((1, 2))).all(), "a face of two colours"
    return mesh.triangles[red]


def test_coloured_result_out(device, tmp_path):
    scene, ring = ab.Scene(device), ab.Model.load(trimesh.creation.torus(0.6, 0.2, 16, 8))
    for k in range(6):
        scene.add(ring, (0.5 * k + (k > 2) * 9, 0, 0, 0, 0, 0, 1), lod=ring.lod_for(fraction=0.5) if k else None)
    result = scene.intersect(output="faces")
    assert len(result.faces)
    intersecting = np.unique(result.pairs[result.any])
    ab.to_trimesh(scene, result).export(tmp_path / "hits.glb")
    meshes = nodes_in_the_world(trimesh.load_scene(tmp_path / "hits.glb", process=False))
    whole = nodes_in_the_world(ab.to_trimesh(scene, scene.intersect(output="any"), names="abcdef"))
    assert sorted(meshes) == [f"object {i}" for i in range(6)]
    for i, name in enumerate("abcdef"):
        vertices, faces, ids = ring.mesh_at(scene.lods[i])
        rows = [result.faces[result.pairs[result.faces[:, 0], k] == i][:, 1 + k] for k in (0, 1)]
        hit = np.isin(ids, np.concatenate(rows))
        corners = vertices[faces[hit]] + [0.5 * i + (i > 2) * 9, 0, 0]
        mesh = meshes[f"object {i}"]
        assert len(mesh.faces) == len(faces) and hit.any() == (i in intersecting)
        assert np.allclose(red_faces(mesh), corners, atol=1e-5)
        assert len(red_faces(whole[name])) == (len(whole[name].faces) if i in intersecting else 0)


def test_plain_scene_out_and_in(tmp_path):
    source = assembly()
    scene, names = ab.scene_from_trimesh(source, device="cpu")
    out = ab.to_trimesh(scene, names=names)
    assert len(out.geometry) == 8, "instances share a geometry"
    again, back = ab.scene_from_trimesh(out, device="cpu")
    assert back == names and len(again.models) == 8
    assert_matches(again, back, nodes_in_the_world(source))
    # glTF holds float32, and keeps instances.
    source.export(tmp_path / "scene.glb")
    again, back = ab.scene_from_file(tmp_path / "scene.glb", device="cpu")
    assert len(again.models) == 8
    assert_matches(again, back, nodes_in_the_world(source), 1e-5)
    for bad in (names[:-1], [names[0]] * 12, list(range(12))):
        with pytest.raises(ValueError, match="names: not 12 different strings"):
            ab.to_trimesh(scene, names=bad)
    small = ab.Scene("cpu")
    small.add(scene.models[0])
    with pytest.raises(ValueError, match="the scene has 1"):
        ab.to_trimesh(small, scene.intersect([[2, 3]]))


def test_one_world_out():
    scene = ab.Scene("cpu")
    for world in (-1, 0, 1, 1):
        scene.add(ab.Model.load(BOX), world=world)
    assert sorted(ab.to_trimesh(scene, world=1).graph.nodes_geometry) == ["object 0", "object 2", "object 3"]
