"""Assemblies from files: names, one object a node, models shared by equal meshes, solids, and STEP in millimetres."""

import os

import numpy as np
import pytest
import trimesh
from helpers import refused
from helpers.scenes import define_mesh, names_of, posed_triangles

import warp_abtree as ab

PLATE, PIN = trimesh.creation.box((10, 20, 30)), trimesh.creation.cylinder(0.5, 8, sections=12)
PLACE = trimesh.transformations.rotation_matrix(0.5, [0, 0, 1]) @ trimesh.transformations.translation_matrix([70, 0, 0])
SHEET = trimesh.Trimesh([[0, 0, 90], [1, 0, 90], [0, 1, 90]], [[0, 1, 2]], process=False)


def assembly(**more):
    """Return a trimesh.Scene of a plate, a copy of it with arrays of its own, a pin, and more."""
    source = trimesh.Scene()
    for name, mesh in {"plate": PLATE, "spare": PLATE, "pin": PIN, **more}.items():
        place = PLACE if name == "spare" else np.eye(4)
        source.add_geometry(mesh.copy(), name, f"{name} mesh", transform=place)
    return source


@pytest.mark.parametrize("suffix", ["glb", "gltf", "3mf"])
def test_equal_meshes_share_a_model_whatever_their_node(tmp_path, suffix):
    if suffix == "3mf":
        pytest.importorskip("lxml"), pytest.importorskip("networkx")
        if int(trimesh.__version__.split(".")[0]) < 5:
            pytest.skip("trimesh 4 writes 3MF whose components are not there")
    path = tmp_path / f"assembly.{suffix}"
    assembly().export(path)
    scene = ab.scene_from_file(path, device="cpu", solid=True)
    names = names_of(scene)
    assert sorted(names) == ["pin", "plate", "spare"] and scene.object_solid == [True] * 3
    models = dict(zip(names, scene.object_model))
    assert models["plate"] == models["spare"] != models["pin"] and len(scene.models) == 2
    found = {name: posed_triangles(scene, i).reshape(-1, 3) for i, name in enumerate(names)}
    spare = trimesh.transform_points(PLATE.triangles.reshape(-1, 3), PLACE)
    for name, corners in {"plate": PLATE.triangles, "pin": PIN.triangles, "spare": spare}.items():
        np.testing.assert_allclose(found[name], corners.reshape(-1, 3), atol=1e-5)


@pytest.mark.parametrize("suffix", ["glb", "obj", "usda"])
def test_solids_are_asked_for_and_open_ones_named(tmp_path, suffix):
    path, title = tmp_path / f"assembly.{suffix}", "sheet mesh" if suffix == "obj" else "sheet"
    if suffix == "usda":
        pytest.importorskip("pxr")
        from pxr import Usd

        stage, title = Usd.Stage.CreateNew(str(path)), "/sheet"
        for name, mesh in {"plate": PLATE, "pin": PIN, "sheet": SHEET}.items():
            define_mesh(stage, f"/{name}", mesh.vertices, mesh.faces)
        stage.GetRootLayer().Save()
    else:
        assembly(sheet=SHEET).export(path)
    assert not any(ab.scene_from_file(path, "cpu").object_solid)
    scene = ab.scene_from_file(path, "cpu", solid="closed")
    assert [scene.name(i) for i, solid in enumerate(scene.object_solid) if not solid] == [title]
    said = rf"assembly\.{suffix}: node '{title}': .* is no solid: it is not closed"
    refused(ab.MeshError, said, ab.scene_from_file, path, "cpu", solid=True)
    refused(ValueError, "solid 'yes' is neither", ab.scene_from_file, path, "cpu", solid="yes")


def test_orient_and_what_the_pair_of_before_holds():
    inside_out = trimesh.Trimesh(PLATE.vertices, PLATE.faces[:, ::-1], process=False)
    source = assembly(turned=inside_out)
    volumes = []
    for orient in (False, True):
        scene, names = ab.scene_from_trimesh(source, device="cpu", orient=orient)
        assert names == names_of(scene) == ["plate", "spare", "pin", "turned"]
        model = scene.models[scene.object_model[3]]
        vertices, faces, _ = model.mesh_at(model.lod_max)
        volumes.append(trimesh.Trimesh(vertices, faces).volume)
    assert volumes == pytest.approx([-6000, 6000])


@pytest.mark.parametrize("hidden", ["over", "class", "over under the instancer"])
def test_prototypes_may_be_hidden_from_all_but_their_instancer(tmp_path, hidden):
    pytest.importorskip("pxr")
    from pxr import Gf, Sdf, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    many, place = UsdGeom.PointInstancer.Define(stage, "/many"), "/many/kept" if "under" in hidden else "/kept"
    for name in ("plate", "spare"):
        define_mesh(stage, f"{place}/{name}", PLATE.vertices, PLATE.faces)
        many.GetPrototypesRel().AddTarget(f"{place}/{name}")
    specifier = Sdf.SpecifierClass if hidden == "class" else Sdf.SpecifierOver
    stage.GetPrimAtPath(place).SetSpecifier(specifier)
    many.GetPrototypesRel().AddTarget("/gone")
    many.CreateProtoIndicesAttr([1, 0, 2]), many.CreatePositionsAttr([Gf.Vec3f(x, 0, 0) for x in (9, 5, 7)])
    stage.GetRootLayer().Save()
    with pytest.warns(UserWarning, match="a.usda: left out what refers to /gone$"):
        scene = ab.scene_from_file(tmp_path / "a.usda", device="cpu")
    assert names_of(scene) == [f"/many[0]{place}/spare", f"/many[1]{place}/plate"]
    for i, x in enumerate((9, 5)):
        np.testing.assert_allclose(posed_triangles(scene, i), PLATE.triangles + [x, 0, 0])
    for change, message in (
        (lambda: many.GetProtoIndicesAttr().Set([0, 3, 1]), "/many: an instance of prototype 3, but there are 3"),
        (lambda: many.GetPrototypesRel().SetTargets(["/a", "/b", "/c", "/many"]), "/many: it is under one of its own"),
    ):
        change()
        stage.GetRootLayer().Save()
        refused(ab.MeshError, message, ab.scene_from_file, tmp_path / "a.usda", device="cpu")


def step_file(parts):
    """Return a STEP file (AP214, millimetres) of a faceted boundary representation for each mesh by name."""
    lines = []

    def add(text):
        lines.append(f"#{len(lines) + 1}={text};")
        return f"#{len(lines)}"

    def numbers(kind, values):
        return add(f"{kind}('',({','.join(repr(float(x)) for x in values)}))")

    def frame(origin, z, x):
        return add(f"AXIS2_PLACEMENT_3D('',{origin},{numbers('DIRECTION', z)},{numbers('DIRECTION', x)})")

    application = add("APPLICATION_CONTEXT('')")
    add(f"APPLICATION_PROTOCOL_DEFINITION('','automotive_design',2000,{application})")
    product_context = add(f"PRODUCT_CONTEXT('',{application},'mechanical')")
    design = add(f"PRODUCT_DEFINITION_CONTEXT('part definition',{application},'design')")
    length = add("(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.MILLI.,.METRE.))")
    angle = add("(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.))")
    solid_angle = add("(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT())")
    units = f"GLOBAL_UNIT_ASSIGNED_CONTEXT(({length},{angle},{solid_angle}))"
    context = add(f"(GEOMETRIC_REPRESENTATION_CONTEXT(3){units}REPRESENTATION_CONTEXT('',''))")
    for name, mesh in parts.items():
        points, faces = [numbers("CARTESIAN_POINT", vertex) for vertex in mesh.vertices], []
        for face, normal in zip(mesh.faces, mesh.face_normals):
            corners = [points[i] for i in face]
            loop = add(f"POLY_LOOP('',({','.join(corners)}))")
            bound = add(f"FACE_OUTER_BOUND('',{loop},.T.)")
            plane = add(f"PLANE('',{frame(corners[0], normal, mesh.vertices[face[1]] - mesh.vertices[face[0]])})")
            faces.append(add(f"FACE_SURFACE('',({bound}),{plane},.T.)"))
        shell = add(f"CLOSED_SHELL('',({','.join(faces)}))")
        brep = add(f"FACETED_BREP('',{shell})")
        origin = frame(numbers("CARTESIAN_POINT", (0, 0, 0)), (0, 0, 1), (1, 0, 0))
        shown = add(f"FACETED_BREP_SHAPE_REPRESENTATION('',({origin},{brep}),{context})")
        product = add(f"PRODUCT('{name}','{name}','',({product_context}))")
        formation = add(f"PRODUCT_DEFINITION_FORMATION('','',{product})")
        defined = add(f"PRODUCT_DEFINITION('','',{formation},{design})")
        shape = add(f"PRODUCT_DEFINITION_SHAPE('','',{defined})")
        add(f"SHAPE_DEFINITION_REPRESENTATION({shape},{shown})")
    head = "ISO-10303-21;HEADER;FILE_DESCRIPTION((''),'2;1');FILE_NAME('','',(''),(''),'','','');"
    return "\n".join([head + "FILE_SCHEMA(('AUTOMOTIVE_DESIGN'));ENDSEC;DATA;", *lines, "ENDSEC;END-ISO-10303-21;"])


def test_step_is_read_in_millimetres(tmp_path, monkeypatch, capfd):
    cascadio = pytest.importorskip("cascadio")

    def load_and_chat(*given, load=cascadio.load):
        os.write(1, b"RWGltf_CafWriter chats\n")
        return load(*given)

    monkeypatch.setattr(cascadio, "load", load_and_chat)
    path = tmp_path / "assembly.step"
    spare = PLATE.copy().apply_transform(PLACE)
    path.write_text(step_file({"plate": PLATE, "spare": spare, "pin": PIN}))
    scene = ab.scene_from_file(path, device="cpu", solid=True)
    assert names_of(scene) == ["plate", "spare", "pin"] and not capfd.readouterr().out
    for i, mesh in enumerate((PLATE, spare, PIN)):
        corners = posed_triangles(scene, i).reshape(-1, 3)
        np.testing.assert_allclose([corners.min(0), corners.max(0)], mesh.bounds, atol=1e-5)
    assert np.ptp(scene.models[0].mesh_at(scene.models[0].lod_max)[0], axis=0).tolist() == [10, 20, 30]
    (tmp_path / "bad.stp").write_text("ISO-10303-21;")
    refused(ab.MeshError, r"bad\.stp: cannot be read as STEP", ab.Model.load, tmp_path / "bad.stp")
