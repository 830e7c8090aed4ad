"""Scenes from and to trimesh, glTF and USD: every mesh in its place, intersecting faces in colour."""

import math

import numpy as np
import pytest
import trimesh
from helpers import refused
from helpers.scenes import define_mesh, names_of, posed_triangles, scene_with

import warp_abtree as ab

TURN, SHIFT = trimesh.transformations.rotation_matrix, trimesh.transformations.translation_matrix
BOX = trimesh.creation.box((1, 2, 3))
GREY, RED = [176, 176, 176], [214, 39, 40]


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


def assert_matches(scene, meshes, tolerance=1e-12):
    names = names_of(scene)
    assert sorted(names) == sorted(meshes)
    for i, name in enumerate(names):
        assert np.allclose(posed_triangles(scene, i), meshes[name].triangles, atol=tolerance), name


def test_sources_refused(tmp_path):
    refused(TypeError, r"Trimesh, not a trimesh\.Scene", ab.scene_from_trimesh, trimesh.creation.box())
    refused(ab.MeshError, "no node with a mesh", ab.scene_from_trimesh, trimesh.Scene([trimesh.PointCloud(np.eye(3))]))
    flat = trimesh.Scene()
    flat.add_geometry(trimesh.creation.box(), node_name="plate", transform=np.diag([1, 1, 0, 1]))
    refused(ab.MeshError, "node 'plate': its transform is singular", ab.scene_from_trimesh, flat)
    refused(ab.MeshError, r"gone\.glb: no such file", ab.scene_from_file, tmp_path / "gone.glb")
    for suffix in ("glb", "txt", "usda"):
        (tmp_path / f"junk.{suffix}").write_text("junk")
        if suffix == "usda":
            pytest.importorskip("pxr")
        refused(ab.MeshError, rf"junk\.{suffix}: cannot be read", ab.scene_from_file, tmp_path / f"junk.{suffix}")


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
        mesh = define_mesh(stage, where, BOX.vertices, faces)
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
    scene = ab.scene_from_file(path, device="cpu")
    names = names_of(scene)
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


def off_sphere(points, radius, half=0.0):
    """Return how far points lie outside a sphere, or a capsule along z of this half length."""
    axis = np.clip(points[:, 2], -half, half)
    return np.linalg.norm(np.column_stack([points[:, :2], points[:, 2] - axis]), axis=1) - radius


def off_cylinder(points, radius, half):
    return np.maximum(np.linalg.norm(points[:, :2], axis=1) - radius, np.abs(points[:, 2]) - half)


def off_cone(points, radius, half):
    """The cone's apex is at +half; its slope takes the radius to 0 there."""
    wide = np.linalg.norm(points[:, :2], axis=1) - radius * (half - points[:, 2]) / (2 * half)
    return np.maximum(wide * 2 * half / math.hypot(radius, 2 * half), np.abs(points[:, 2]) - half)


# Attributes of a prim, its volume, and how far a point lies outside of it.
USD_SHAPES = {
    "Cube": ({"size": 3.0}, 27.0, lambda p: np.abs(p).max(1) - 1.5),
    "Sphere": ({"radius": 2.0}, 32 / 3 * math.pi, lambda p: off_sphere(p, 2.0)),
    "Cylinder": ({"radius": 0.5, "height": 3.0}, 0.75 * math.pi, lambda p: off_cylinder(p, 0.5, 1.5)),
    "Cone": ({"radius": 1.0, "height": 3.0}, math.pi, lambda p: off_cone(p, 1.0, 1.5)),
    "Capsule": ({"radius": 1.0, "height": 2.0}, 10 / 3 * math.pi, lambda p: off_sphere(p, 1.0, 1.0)),
}
# Coordinates of a point in the frame in which the axis is z.
AXES = {"X": [1, 2, 0], "Y": [2, 0, 1], "Z": [0, 1, 2]}


@pytest.mark.parametrize("kind", USD_SHAPES)
def test_usd_shapes_are_read_as_meshes(tmp_path, kind):
    """Of every axis, closed, faces outwards, on the shape's surface or inside by 0.002 of the radius at most."""
    pytest.importorskip("pxr")
    from pxr import Gf, Usd, UsdGeom

    stage, (values, volume, outside) = Usd.Stage.CreateNew(str(tmp_path / "shapes.usda")), USD_SHAPES[kind]
    axes = AXES if "height" in values else "Z"
    for axis in axes:
        shape = getattr(UsdGeom, kind).Define(stage, f"/{axis}")
        for name, value in {**values, **({"axis": axis} if len(axes) == 3 else {})}.items():
            shape.GetPrim().GetAttribute(name).Set(value)
        UsdGeom.Xformable(shape).AddTranslateOp().Set(Gf.Vec3d(5, 6, 7))
    stage.GetRootLayer().Save()
    scene = ab.scene_from_file(tmp_path / "shapes.usda", device="cpu")
    names = names_of(scene)
    assert sorted(names) == sorted(f"/{axis}" for axis in axes)
    for i, name in enumerate(names):
        points = (posed_triangles(scene, i) - [5, 6, 7])[..., AXES[name[1]]]
        mesh = trimesh.Trimesh(*trimesh.triangles.to_kwargs(points).values(), process=True)
        assert mesh.is_watertight and volume > mesh.volume * (1 - 1e-6) > 0.99 * volume
        assert np.abs(outside(points.reshape(-1, 3))).max() < 1e-5, "corners lie on the surface"
        inside = -outside(np.concatenate([points.mean(1), (points + np.roll(points, 1, 1)).reshape(-1, 3) / 2]))
        curved = inside if kind != "Cube" else inside[:0]
        assert inside.min() > -1e-5 and curved.max(initial=0) < 0.002 * values.get("radius", 0) + 1e-5


def test_what_usd_hides_is_left_out_and_named(tmp_path):
    """Invisible prims with all under them, hidden and inactive instances, and geometry of other kinds."""
    pytest.importorskip("pxr")
    from pxr import Gf, Usd, UsdGeom

    path = tmp_path / "hidden.usda"
    write_usd(path)
    stage = Usd.Stage.Open(str(path))
    UsdGeom.Imageable(stage.GetPrimAtPath("/root/turned")).MakeInvisible()
    UsdGeom.Imageable(stage.GetPrimAtPath("/copy1")).MakeInvisible()
    UsdGeom.Xform.Define(stage, "/lights").MakeInvisible()
    many = UsdGeom.PointInstancer.Get(stage, "/many")
    many.CreateProtoIndicesAttr([0] * 4)
    many.CreatePositionsAttr([Gf.Vec3f(0, 0, z) for z in (5, 1, 6, 2)])
    many.CreateIdsAttr([10, 11, 12, 13])
    many.CreateInvisibleIdsAttr([10])
    many.DeactivateId(12)
    UsdGeom.Points.Define(stage, "/root/dust")
    UsdGeom.Camera.Define(stage, "/root/eye")
    stage.GetRootLayer().Save()
    with pytest.warns(UserWarning) as caught:
        scene = ab.scene_from_file(path, device="cpu")
        names = names_of(scene)
    (said,) = [str(warning.message) for warning in caught]
    assert said.startswith(f"{path}: left out ") and caught[0].filename == __file__
    for part in ("/root/turned (invisible)", "/copy1 (invisible)", "/root/dust (Points)"):
        assert part in said
    assert "lights" not in said and "eye" not in said
    gone = {"/root/turned", "/copy1/mesh", "/many[0]/many/prototype"}
    shown = {"/many[3]/many/prototype", "/root/quad"}
    assert sorted(names) == sorted({*USD_PRIMS} - gone | shown)
    for k in (1, 3):
        place = posed_triangles(scene, names.index(f"/many[{k}]/many/prototype")).reshape(-1, 3)
        assert np.allclose((place.min(0) + place.max(0)) / 2, [100, 7, {1: 1, 3: 2}[k]] + BOX.bounds.mean(0))
    many.CreatePositionsAttr([Gf.Vec3f(0, 0, 1)])
    stage.GetRootLayer().Save()
    refused(ab.MeshError, "/many: its 4 instances do not have a place each", ab.scene_from_file, path, device="cpu")


def test_usd_purposes_and_what_is_not_carried_out(tmp_path):
    """Default and render are read, guide and proxy named, inherited ones too; subdivision, skins and holes."""
    pytest.importorskip("pxr")
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel

    path = tmp_path / "purposes.usda"
    stage = Usd.Stage.CreateNew(str(path))

    def define(where, purpose=None):
        mesh = define_mesh(stage, where, BOX.vertices, BOX.faces)
        if purpose is not None:
            mesh.CreatePurposeAttr(purpose)
        return mesh

    define("/plain").CreateSubdivisionSchemeAttr("none")
    for purpose in ("default", "render", "guide", "proxy"):
        define(f"/{purpose}", purpose)
    UsdGeom.Xform.Define(stage, "/helpers").CreatePurposeAttr("guide")
    define("/helpers/arrow"), define("/helpers/kept", "render")
    many = UsdGeom.PointInstancer.Define(stage, "/many")
    many.CreatePurposeAttr("proxy")
    many.CreatePrototypesRel().AddTarget(define("/many/prototype").GetPath())
    many.CreateProtoIndicesAttr([0]), many.CreatePositionsAttr([Gf.Vec3f(0, 0, 1)])
    define("/smooth").CreateSubdivisionSchemeAttr("catmullClark")
    define("/holed").CreateHoleIndicesAttr([0, 5])
    skin = UsdSkel.BindingAPI.Apply(define("/skinned").GetPrim())
    skin.CreateSkeletonRel().AddTarget(UsdSkel.Skeleton.Define(stage, "/bones").GetPath())
    stage.OverridePrim("/gone").GetReferences().AddReference("./gone.usda")
    stage.GetPrimAtPath("/gone").SetSpecifier(Sdf.SpecifierDef)
    stage.GetRootLayer().Save()
    with pytest.warns(UserWarning) as caught:
        scene = ab.scene_from_file(path, device="cpu")
        names = names_of(scene)
    shown = ["/plain", "/default", "/render", "/helpers/kept", "/smooth", "/holed", "/skinned"]
    assert sorted(names) == sorted(shown)
    counts = {name: scene.models[scene.object_model[i]].face_count for i, name in enumerate(names)}
    assert counts == dict.fromkeys(shown, 12) | {"/holed": 10}
    (said,) = [str(warning.message) for warning in caught]
    purposes = "/guide (purpose guide), /proxy (purpose proxy), /helpers/arrow (purpose guide), /many (purpose proxy)"
    assert purposes in said and "gone.usda" in said
    assert "not subdivided: /smooth (catmullClark)" in said and "taken at rest: /skinned (skin or blend" in said


def test_usd_polygons_do_not_fold_and_planes_have_an_axis(tmp_path):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    letter = [(4, 1), (1, 1), (1, 3), (4, 3), (4, 4), (0, 4), (0, 0), (4, 0)]
    stage = Usd.Stage.CreateNew(str(tmp_path / "flat.usda"))
    define_mesh(stage, "/L", np.insert(letter, 2, 0, 1), [range(8)])
    sizes = {"X": (0, 3, 2), "Y": (2, 0, 3), "Z": (2, 3, 0)}
    for axis in sizes:
        plane = UsdGeom.Plane.Define(stage, f"/{axis}")
        plane.GetAxisAttr().Set(axis), plane.GetWidthAttr().Set(2.0), plane.GetLengthAttr().Set(3.0)
    stage.GetRootLayer().Save()
    scene = ab.scene_from_file(tmp_path / "flat.usda", device="cpu")
    found = {name[1]: posed_triangles(scene, i) for i, name in enumerate(names_of(scene))}
    assert trimesh.triangles.area(found.pop("L")).sum() == pytest.approx(10)
    for axis, triangles in found.items():
        assert np.ptp(triangles.reshape(-1, 3), axis=0).tolist() == list(sizes[axis]) and len(triangles) == 2
        assert np.allclose(trimesh.triangles.normals(triangles)[0], np.eye(3)["XYZ".index(axis)])
        assert trimesh.triangles.area(triangles).sum() == pytest.approx(6.0)


def red_faces(mesh):
    colours = np.asarray(mesh.visual.vertex_colors)[mesh.faces][..., :3]
    red = (colours == RED).all((1, 2))
    assert (red | (colours == GREY).all((1, 2))).all(), "a face of two colours"
    return mesh.triangles[red]


def test_coloured_result_out(device, tmp_path):
    ring = ab.Model.load(trimesh.creation.torus(0.6, 0.2, 16, 8))
    scene = scene_with(device, *[(ring, (0.5 * k + (k > 2) * 9, 0, 0, 0, 0, 0, 1)) for k in range(6)])
    scene.set_lods([ring.lod_max] + 5 * [ring.lod_for(fraction=0.5)])
    result = scene.intersect(output="faces")
    assert len(result.faces)
    intersecting = np.unique(result.pairs[result.any])
    ab.to_trimesh(scene, result).export(tmp_path / "hits.glb")
    meshes = nodes_in_the_world(trimesh.load_scene(tmp_path / "hits.glb", process=False))
    whole = nodes_in_the_world(ab.to_trimesh(scene, scene.intersect(output="any"), names="abcdef"))
    assert sorted(meshes) == [f"trimesh {i}" for i in range(6)]
    for i, name in enumerate("abcdef"):
        vertices, faces, ids = ring.mesh_at(scene.lods[i])
        rows = [result.faces[result.pairs[result.faces[:, 0], k] == i][:, 1 + k] for k in (0, 1)]
        hit = np.isin(ids, np.concatenate(rows))
        corners = vertices[faces[hit]] + [0.5 * i + (i > 2) * 9, 0, 0]
        mesh = meshes[f"trimesh {i}"]
        assert len(mesh.faces) == len(faces) and hit.any() == (i in intersecting)
        assert np.allclose(red_faces(mesh), corners, atol=1e-5)
        assert len(red_faces(whole[name])) == (len(whole[name].faces) if i in intersecting else 0)


def test_plain_scene_in_and_out_and_in(tmp_path):
    source = assembly()
    scene = ab.scene_from_trimesh(assembly(with_extras=True), device="cpu")
    assert_matches(scene, nodes_in_the_world(source))
    # Rigid, doubled, mirrored, flattened: four of each geometry.
    assert len(scene.models) == 8 and scene.object_count == 12
    for i, model in enumerate(scene.models):
        vertices, faces, _ = model.mesh_at(model.lod_max)
        assert trimesh.Trimesh(vertices, faces).volume > 0, f"model {i} is inside out"
    out = ab.to_trimesh(scene)
    assert len(out.geometry) == 8, "instances share a geometry"
    again, names = ab.scene_from_trimesh(out, device="cpu"), names_of(scene)
    assert names_of(again) == names and len(again.models) == 8
    assert_matches(again, nodes_in_the_world(source))
    # glTF holds float32, and keeps instances.
    source.export(tmp_path / "scene.glb")
    again = ab.scene_from_file(tmp_path / "scene.glb", device="cpu")
    assert len(again.models) == 8
    assert_matches(again, nodes_in_the_world(source), 1e-5)
    for bad in (names[:-1], [names[0]] * 12, list(range(12))):
        refused(ValueError, "names: not 12 different strings", ab.to_trimesh, scene, names=bad)
    small = scene_with("cpu", scene.models[0])
    refused(ValueError, "the scene has 1", ab.to_trimesh, small, scene.intersect([[2, 3]]))


def test_no_name_is_the_frame_of_all(device):
    """An object may be called as trimesh calls the frame of the scene, and a removed one leaves its name to others."""
    scene = scene_with(device, *[(ab.Model.load(BOX), (k, 0, 0, 0, 0, 0, 1), {"name": "removed"}) for k in range(3)])
    scene.add(ab.Model.load(BOX), (5, 2, 0, 0, 0, 0, 1), name="world")
    scene.remove(0)
    given = ab.to_trimesh(scene, names=["world", "a", "b", "world_1"])
    for out, names in (ab.to_trimesh(scene), ["removed", "removed_1", "world"]), (given, ["a", "b", "world_1"]):
        assert list(out.graph.nodes_geometry) == names
        assert [out.graph[name][0][:3, 3].tolist() for name in names] == [[1, 0, 0], [2, 0, 0], [5, 2, 0]]
        back = ab.scene_from_trimesh(out, device)
        assert back.poses[:, :3].tolist() == [[1, 0, 0], [2, 0, 0], [5, 2, 0]]
    scene = scene_with("cpu", *[(ab.Model.load(BOX), np.eye(4), {"world": world}) for world in (-1, 0, 1, 1)])
    assert sorted(ab.to_trimesh(scene, world=1).graph.nodes_geometry) == ["trimesh 0", "trimesh 2", "trimesh 3"]
