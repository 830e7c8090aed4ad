"""Arrays of other frameworks on the same memory, and scenes from and to trimesh, glTF and USD."""

import math

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers.samples import random_poses

import warp_abtree as ab


@pytest.fixture
def scene(device):
    scene = ab.Scene(device)
    ring = ab.Model.load(trimesh.creation.torus(0.6, 0.2, 16, 8))
    for k in range(6):
        scene.add(ring, pose=(0.3 * k, 0, 0, 0, 0, 0, 1))
    return scene


def poses_of(seed, count=6):
    return random_poses(np.random.default_rng(seed), count, 0.8)


def expected(scene, poses):
    """Answers by way of the host, from another scene."""
    other = ab.Scene(scene.device)
    for pose in poses:
        other.add(scene.models[0], pose=pose)
    return other.intersect(other.broad_phase(), output="count")


def answer(scene, query):
    query.launch()
    pairs = query.pairs.numpy()[: query.pair_count.numpy()[0]]
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    return pairs[order].tolist(), query.hits.count.numpy()[: len(pairs)][order].tolist()


def assert_same(scene, query, poses):
    wanted = expected(scene, poses)
    assert answer(scene, query) == (wanted.pairs.tolist(), wanted.count.tolist())
    assert wanted.count.sum() > 0


def test_poses_from_warp(scene):
    poses, query = ab.PoseInput(scene), ab.Query(scene, "count")
    found = poses.poses.numpy()
    assert np.allclose(found[:, 0], 0.3 * np.arange(6)) and np.allclose(found[:, 1:], [0, 0, 0, 0, 0, 1])
    rows = poses_of(1)
    given = wp.array(rows, dtype=wp.float64, device=scene.device)
    poses.launch(given)
    assert_same(scene, query, rows)
    assert np.array_equal(poses.poses.numpy(), found), "float64 is read where it lies"
    single = rows.astype(np.float32)
    poses.launch(wp.array(single, dtype=wp.float32, device=scene.device))
    assert_same(scene, query, single)
    poses.poses.assign(poses_of(2))
    poses.launch()
    assert_same(scene, query, poses_of(2))
    poses.check()


def test_captured_with_a_query(scene):
    poses, query = ab.PoseInput(scene), ab.Query(scene, "count")
    poses.launch()
    query.launch()
    with wp.ScopedCapture(scene.device) as capture:
        poses.launch()
        query.launch()
    for seed in (3, 4):
        poses.poses.assign(poses_of(seed))
        wp.capture_launch(capture.graph)
        pairs, counts = answer(scene, query)
        wanted = expected(scene, poses_of(seed))
        assert (pairs, counts) == (wanted.pairs.tolist(), wanted.count.tolist())


def test_poses_that_are_refused(scene):
    poses = ab.PoseInput(scene)
    good = poses_of(5)
    for bad, message in (
        (np.zeros((6, 7), int), r"shape \(6, 7\) of int64, not \(6, 7\) of float32 or float64"),
        (np.zeros((5, 7)), r"shape \(5, 7\)"),
        (np.zeros((6, 4, 4)), r"shape \(6, 4, 4\)"),
        ([[0.0] * 7] * 6, "list is no array"),
        (np.array(["x"]), "cannot be shared"),
    ):
        with pytest.raises(ValueError, match=message):
            poses.launch(bad)
    if str(scene.device) != "cpu":
        with pytest.raises(ValueError, match="on cpu, the scene is on cuda"):
            poses.launch(good)
    poses.launch(wp.array(good, dtype=wp.float64, device=scene.device))
    rows = poses_of(6)
    rows[2, 3:] *= 1.01
    rows[4, 0] = math.nan
    poses.launch(wp.array(rows, dtype=wp.float64, device=scene.device))
    with pytest.raises(ValueError, match=r"2 rows since the last check.* first object that had one is 2"):
        poses.check()
    poses.check()
    rows[[2, 4]] = good[[2, 4]]
    assert_same(scene, ab.Query(scene, "count"), rows)
    scene.add(scene.models[0])
    with pytest.raises(RuntimeError, match="make a new one"):
        poses.launch()


def test_numpy_shares_memory():
    for writable in (True, False):
        rows = poses_of(7)
        rows.setflags(write=writable)
        shared = ab.wrap_array(rows)
        assert shared.ptr == rows.ctypes.data and shared.dtype == wp.float64 and shared.shape == rows.shape
    part = poses_of(8, 12)[::2]
    assert ab.wrap_array(part).ptr == part.ctypes.data
    assert np.array_equal(ab.wrap_array(part).numpy(), part)


def test_numpy_poses():
    scene = ab.Scene("cpu")
    ring = ab.Model.load(trimesh.creation.torus(0.6, 0.2, 16, 8))
    for _ in range(6):
        scene.add(ring)
    poses, query = ab.PoseInput(scene), ab.Query(scene, "count")
    poses.launch(poses_of(9, 12)[::2])
    assert_same(scene, query, poses_of(9, 12)[::2])


def test_torch(scene):
    torch = pytest.importorskip("torch")
    place = wp.device_to_torch(scene.device)
    rows = poses_of(10)
    poses, query = ab.PoseInput(scene), ab.Query(scene, "count")
    for kind in (torch.float64, torch.float32):
        tensor = torch.tensor(rows, dtype=kind, device=place, requires_grad=True)
        assert ab.wrap_array(tensor).ptr == tensor.data_ptr()
        poses.launch(tensor)
        assert_same(scene, query, tensor.detach().cpu().numpy())
    # Poses computed in place, results read in place.
    view = wp.to_torch(poses.poses)
    assert view.data_ptr() == poses.poses.ptr
    view.copy_(torch.tensor(poses_of(11)))
    poses.launch()
    assert_same(scene, query, poses_of(11))
    hit = wp.to_torch(query.hits.any_hit)
    assert hit.data_ptr() == query.hits.any_hit.ptr
    assert int((hit[: int(query.pair_count.numpy()[0])] != 0).sum()) == int(expected(scene, poses_of(11)).any.sum())
    frame = ab.FrameGraph(scene, output="count")
    wp.to_torch(frame.poses).copy_(torch.tensor(poses_of(12)))
    frame.launch()
    assert wp.to_torch(frame.query.hits.count).sum() == expected(scene, poses_of(12)).count.sum()
    contacts = ab.ContactQuery(scene, capacity=4096)
    contacts.launch()
    p0 = wp.to_torch(contacts.contacts.p0)
    assert p0.shape == (4096, 3) and p0.data_ptr() == contacts.contacts.p0.ptr
    count = int(wp.to_torch(contacts.start)[-1])
    assert np.array_equal(p0[:count].cpu().numpy(), contacts.result().contacts["p0"]) and count > 0


def test_jax(scene):
    jax = pytest.importorskip("jax")
    jax.config.update("jax_enable_x64", True)
    try:
        place = wp.device_to_jax(scene.device)
    except RuntimeError as error:  # a jax without this kind of device
        pytest.skip(str(error))
    rows = poses_of(13)
    poses, query = ab.PoseInput(scene), ab.Query(scene, "count")
    for kind in (np.float64, np.float32):
        array = jax.device_put(rows.astype(kind), place)
        assert ab.wrap_array(array).ptr == array.unsafe_buffer_pointer()
        poses.launch(array)
        assert_same(scene, query, np.asarray(array))
    hit = wp.to_jax(query.hits.any_hit)
    assert hit.unsafe_buffer_pointer() == query.hits.any_hit.ptr


def test_cupy(device):
    cupy = pytest.importorskip("cupy")
    if not wp.get_device(device).is_cuda:
        pytest.skip("CuPy has no arrays on the CPU")
    scene = ab.Scene(device)
    ring = ab.Model.load(trimesh.creation.torus(0.6, 0.2, 16, 8))
    for _ in range(6):
        scene.add(ring)
    poses, query = ab.PoseInput(scene), ab.Query(scene, "count")
    array = cupy.asarray(poses_of(14))
    assert ab.wrap_array(array).ptr == array.data.ptr
    poses.launch(array)
    assert_same(scene, query, poses_of(14))
    assert cupy.from_dlpack(query.hits.any_hit).data.ptr == query.hits.any_hit.ptr


# Scenes.


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
    ball, box = trimesh.creation.icosphere(subdivisions=1), trimesh.creation.box((1, 2, 3))
    turn = trimesh.transformations.rotation_matrix
    source = trimesh.Scene()
    source.graph.update("parent", matrix=turn(0.3, [1, 2, 3], [1, 0, 0]))

    source.add_geometry(ball, node_name="ball 0", geom_name="ball", parent_node_name="parent")
    source.add_geometry(box, node_name="box 0", geom_name="box", parent_node_name="parent")
    double, mirror, flat = np.diag([2, 2, 2, 1.0]), np.diag([1, -1, 1, 1.0]), np.diag([1, 0.5, 0.25, 1.0])
    for k, matrix in enumerate(
        (
            turn(1, [0, 1, 0], [0, 0, 2]),
            turn(1, [0, 1, 1]) @ double,
            turn(2, [3, 1, 0]) @ double,
            turn(0.4, [0, 0, 1]) @ mirror,
            turn(0.7, [0, 1, 0.2]) @ flat @ turn(0.2, [1, 0, 0]),
        )
    ):
        for name in ("ball", "box"):
            source.graph.update(f"{name} {k + 1}", "parent", matrix=matrix, geometry=name)
    if with_extras:
        source.add_geometry(trimesh.PointCloud(np.eye(3)), node_name="points")
        source.add_geometry(trimesh.load_path(np.eye(3)), node_name="path")
    return source


def assert_matches(scene, names, meshes):
    assert sorted(names) == sorted(meshes) and scene.object_count == len(names)
    for i, name in enumerate(names):
        assert np.allclose(posed_triangles(scene, i), meshes[name].triangles, atol=1e-12), name


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


def test_trimesh_scene_refused():
    with pytest.raises(TypeError, match=r"Trimesh, not a trimesh\.Scene"):
        ab.scene_from_trimesh(trimesh.creation.box())
    with pytest.raises(ab.MeshError, match="no node with a mesh"):
        ab.scene_from_trimesh(trimesh.Scene([trimesh.PointCloud(np.eye(3))]))
    flat = trimesh.Scene()
    flat.add_geometry(trimesh.creation.box(), node_name="plate", transform=np.diag([1, 1, 0, 1]))
    with pytest.raises(ab.MeshError, match="node 'plate': its transform is singular"):
        ab.scene_from_trimesh(flat)


def test_glb_in(tmp_path):
    source = assembly()
    source.export(tmp_path / "scene.glb")
    scene, names = ab.scene_from_file(tmp_path / "scene.glb", device="cpu")
    # glTF holds float32, and keeps instances.
    assert len(scene.models) == 8
    meshes = nodes_in_the_world(source)
    assert sorted(names) == sorted(meshes)
    for i, name in enumerate(names):
        assert np.allclose(posed_triangles(scene, i), meshes[name].triangles, atol=1e-5)


@pytest.mark.parametrize("suffix", ["usda", "usdc"])
def test_usd_in(tmp_path, suffix):
    pytest.importorskip("pxr")
    from pxr import Gf, Usd, UsdGeom

    path = tmp_path / f"scene.{suffix}"
    stage = Usd.Stage.CreateNew(str(path))
    box = trimesh.creation.box((1, 2, 3))

    def define(where, quads=False, orientation=None):
        mesh = UsdGeom.Mesh.Define(stage, where)
        mesh.GetPointsAttr().Set([Gf.Vec3f(*map(float, v)) for v in box.vertices])
        faces = box.faces if orientation is None else box.faces[:, ::-1]
        counts, corners = [3] * len(faces), faces.ravel().tolist()
        if quads:
            counts, corners = [4], [0, 1, 3, 2]
        mesh.GetFaceVertexCountsAttr().Set(counts)
        mesh.GetFaceVertexIndicesAttr().Set(corners)
        if orientation is not None:
            mesh.GetOrientationAttr().Set(orientation)
        return mesh

    UsdGeom.Xform.Define(stage, "/root").AddTranslateOp().Set(Gf.Vec3d(1, 2, 3))
    define("/root/still")
    turned = define("/root/turned")
    turned.AddTranslateOp().Set(Gf.Vec3d(5, 0, 0))
    turned.AddRotateZOp().Set(90.0)
    define("/root/left", orientation="leftHanded").AddTranslateOp().Set(Gf.Vec3d(0, 9, 0))
    define("/root/quad", quads=True)
    # A class that two prims instance, and a point instancer.
    UsdGeom.Xform.Define(stage, "/thing")
    define("/thing/mesh")
    for k in range(2):
        prim = UsdGeom.Xform.Define(stage, f"/copy{k}")
        prim.AddTranslateOp().Set(Gf.Vec3d(0, 0, 10 * (k + 1)))
        prim.GetPrim().GetReferences().AddInternalReference("/thing")
        prim.GetPrim().SetInstanceable(True)
    many = UsdGeom.PointInstancer.Define(stage, "/many")
    many.AddTranslateOp().Set(Gf.Vec3d(100, 0, 0))
    prototype = define("/many/prototype")
    prototype.AddTranslateOp().Set(Gf.Vec3d(0, 7, 0))
    many.CreatePrototypesRel().AddTarget(prototype.GetPath())
    many.CreateProtoIndicesAttr([0, 0])
    many.CreatePositionsAttr([Gf.Vec3f(0, 0, 1), Gf.Vec3f(0, 0, 2)])
    stage.GetRootLayer().Save()

    scene, names = ab.scene_from_file(path, device="cpu")
    quarter = trimesh.transformations.rotation_matrix(math.pi / 2, [0, 0, 1])
    shift = trimesh.transformations.translation_matrix
    expected = {
        "/root/still": shift([1, 2, 3]),
        "/root/turned": shift([6, 2, 3]) @ quarter,
        "/root/left": shift([1, 11, 3]),
        "/thing/mesh": np.eye(4),
        "/copy0/mesh": shift([0, 0, 10]),
        "/copy1/mesh": shift([0, 0, 20]),
        "/many[0]/many/prototype": shift([100, 7, 1]),
        "/many[1]/many/prototype": shift([100, 7, 2]),
    }
    assert sorted(names) == sorted([*expected, "/root/quad"]) and len(scene.models) == 2
    for i, name in enumerate(names):
        if name == "/root/quad":
            assert scene.models[scene.object_model[i]].face_count == 2
            continue
        corners = trimesh.transform_points(box.triangles.reshape(-1, 3), expected[name]).reshape(-1, 3, 3)
        found = posed_triangles(scene, i)
        assert np.allclose(np.sort(found.reshape(-1, 9)), np.sort(corners.reshape(-1, 9)), atol=1e-5), name
        normal = trimesh.triangles.normals(found)[0]
        assert ((found.mean(1) - found.mean((0, 1))) * normal).sum(1).min() > 0, f"{name} is inside out"


def test_files_refused(tmp_path):
    with pytest.raises(ab.MeshError, match=r"gone\.glb: no such file"):
        ab.scene_from_file(tmp_path / "gone.glb")
    for suffix in ("glb", "usda", "txt"):
        (tmp_path / f"junk.{suffix}").write_text("junk")
        if suffix == "usda":
            pytest.importorskip("pxr")
        with pytest.raises(ab.MeshError, match=rf"junk\.{suffix}: cannot be read"):
            ab.scene_from_file(tmp_path / f"junk.{suffix}")


def red_faces(mesh):
    colours = np.asarray(mesh.visual.vertex_colors)[mesh.faces][..., :3]
    red = (colours == [214, 39, 40]).all((1, 2))
    assert (red | (colours == [176, 176, 176]).all((1, 2))).all(), "a face of two colours"
    return mesh.triangles[red]


def test_coloured_result_out(scene, tmp_path):
    scene.set_lods([scene.models[0].lod_max, *[scene.models[0].lod_for(fraction=0.5)] * 5])
    scene.set_poses([(0.5 * k + (k > 2) * 9, 0, 0, 0, 0, 0, 1) for k in range(6)])
    result = scene.intersect(output="faces")
    assert len(result.faces)
    ab.to_trimesh(scene, result).export(tmp_path / "hits.glb")
    meshes = nodes_in_the_world(trimesh.load_scene(tmp_path / "hits.glb", process=False))
    assert sorted(meshes) == [f"object {i}" for i in range(6)]
    for i in range(6):
        mesh = meshes[f"object {i}"]
        model = scene.models[0]
        vertices, faces, ids = model.mesh_at(scene.lods[i])
        assert len(mesh.faces) == len(faces)
        rows = [result.faces[result.pairs[result.faces[:, 0], k] == i][:, 1 + k] for k in (0, 1)]
        hit = np.isin(ids, np.concatenate(rows))
        corners = vertices[faces[hit]] + [0.5 * i + (i > 2) * 9, 0, 0]
        assert np.allclose(red_faces(mesh), corners, atol=1e-5) and hit.any() == (
            i in np.unique(result.pairs[result.any])
        )
    whole = ab.to_trimesh(scene, scene.intersect(output="any"), names="abcdef")
    hit = np.unique(result.pairs[result.any])
    for i, name in enumerate("abcdef"):
        mesh = nodes_in_the_world(whole)[name]
        assert len(red_faces(mesh)) == (len(mesh.faces) if i in hit else 0)


def test_plain_scene_out():
    source = assembly()
    scene, names = ab.scene_from_trimesh(source, device="cpu")
    out = ab.to_trimesh(scene, names=names)
    assert len(out.geometry) == 8, "instances share a geometry"
    again, back = ab.scene_from_trimesh(out, device="cpu")
    assert back == names and len(again.models) == 8
    for i in range(len(names)):
        assert np.allclose(posed_triangles(again, i), posed_triangles(scene, i), atol=1e-12)
    for bad in (names[:-1], [names[0]] * 12, list(range(12))):
        with pytest.raises(ValueError, match="names: not 12 different strings"):
            ab.to_trimesh(scene, names=bad)
    small = ab.Scene("cpu")
    small.add(scene.models[0])
    with pytest.raises(ValueError, match="the scene has 1"):
        ab.to_trimesh(small, scene.intersect([[2, 3]]))


def test_one_world_out():
    scene = ab.Scene("cpu")
    ring = ab.Model.load(trimesh.creation.torus(0.6, 0.2, 16, 8))
    for world in (-1, 0, 1, 1):
        scene.add(ring, world=world)
    assert sorted(ab.to_trimesh(scene, world=1).graph.nodes_geometry) == ["object 0", "object 2", "object 3"]
