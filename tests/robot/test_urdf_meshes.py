"""Meshes of URDF files: where they are sought, units of Collada, and mirrored ones."""

import gzip
import warnings
import zipfile

import numpy as np
import pytest
import trimesh
from helpers import refused

import warp_abtree as ab

pytest.importorskip("yourdfpy")
ROBOT = """<robot name="r"><link name="l"><collision>{}<geometry><mesh filename="{}" {}/></geometry></collision></link>
{}</robot>"""
TURN = '<origin xyz="0 0 1" rpy="0 0 1.5707963267948966"/>'
BOX = trimesh.creation.box((1, 2, 3), trimesh.transformations.translation_matrix((2, 0.5, 0)))


def load(folder, file, options="", origin="", rest=""):
    """Return the link's mesh as trimesh has it."""
    (folder / "r.urdf").write_text(ROBOT.format(origin, file, options, rest), encoding="utf-8")
    return mesh_of(ab.Robot.load(folder / "r.urdf", device="cpu").models[0])


def mesh_of(model):
    return trimesh.Trimesh(*model.mesh_at(model.lod_max)[:2], process=False)


def write_dae(path, unit, node="", up="Z_UP"):
    """Write a box as trimesh does, with a unit, an axis and a transform of its node."""
    text = trimesh.exchange.dae.export_collada(BOX).decode()
    start, end = text.index("<asset"), text.index("</asset>")
    text = text[:start] + f"<asset>{unit}<up_axis>{up}</up_axis>" + text[end:]
    assert "<instance_geometry" in text
    text = text.replace("<instance_geometry", f"{node}<instance_geometry", 1)
    path.write_bytes(gzip.compress(text.encode()) if path.suffix == ".gz" else text.encode())


@pytest.mark.parametrize("scale", ["-1 1 1", "1 -2 1", "-1 -1 1", "-1 -1 -1", "2", "-2"])
@pytest.mark.parametrize("ending", ["stl", "obj", "ply", "dae"])
def test_mirrored_meshes_keep_their_outside(ending, scale, tmp_path):
    BOX.export(tmp_path / f"part.{ending}")
    found = load(tmp_path, f"part.{ending}", f'scale="{scale}"', TURN)
    by = np.ones(3) * np.array(scale.split(), float)
    corners = [BOX.bounds[[i, j, k], [0, 1, 2]] * by for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    expected = np.array([(-y, x, z + 1) for x, y, z in corners])
    np.testing.assert_allclose(found.bounds, [expected.min(0), expected.max(0)], atol=1e-6)
    np.testing.assert_allclose(found.volume, 6 * abs(by.prod()), rtol=1e-6)


@pytest.mark.parametrize(
    "unit, meters",
    [
        ("", 1),
        ('<unit name="meter"/>', 1),
        ('<unit meter="0.0254" name="inch"/>', 0.0254),
        ('<unit name="millimeter" meter="1e-3"/>', 0.001),
        ('<unit meter="1000"/>', 1000),
    ],
)
@pytest.mark.parametrize("name", ["part.dae", "part.DAE", "part.dae.gz"])
def test_collada_is_scaled_to_meters(name, unit, meters, tmp_path):
    write_dae(tmp_path / name, unit, up="Y_UP")
    found = load(tmp_path, name, 'scale="1 2 1"', TURN)
    low, high = BOX.bounds * meters
    expected = [(-2 * high[1], low[0], low[2] + 1), (-2 * low[1], high[0], high[2] + 1)]
    np.testing.assert_allclose(found.bounds, expected, atol=1e-6 * meters)
    # A mesh by itself keeps the numbers of its file.
    np.testing.assert_allclose(mesh_of(ab.Model.load(tmp_path / name)).bounds, BOX.bounds, rtol=1e-6)


@pytest.mark.parametrize("scale", ["1 1 1", "1 1 -1"])
def test_collada_nodes_may_be_mirrored(scale, tmp_path):
    write_dae(tmp_path / "part.dae", '<unit meter="0.5"/>', "<matrix>-2 0 0 3  0 1 0 0  0 0 1 0  0 0 0 1</matrix>")
    found = load(tmp_path, "part.dae", f'scale="{scale}"')
    np.testing.assert_allclose(found.bounds, [[-1, -0.25, -0.75], [0, 0.75, 0.75]], atol=1e-6)
    np.testing.assert_allclose(found.volume, 12 / 8, rtol=1e-6)


@pytest.mark.parametrize("unit", ["0", "-1", "nan", "inf", "inch"])
def test_units_that_are_none_are_refused(unit, tmp_path):
    write_dae(tmp_path / "part.dae", f'<unit meter="{unit}"/>')
    refused(ValueError, f"link 'l': part.dae has a unit of '{unit}' meters", load, tmp_path, "part.dae")
    with zipfile.ZipFile(tmp_path / "part.zae", "w") as archive:
        archive.write(tmp_path / "part.dae", "part.dae")
    refused(ValueError, r"link .l.: part\.zae is an archive; unpack the \.dae of it", load, tmp_path, "part.zae")


@pytest.mark.parametrize(
    "name",
    [
        "meshes/part.stl",
        r"meshes\part.stl",
        "package://arm/meshes/part.stl",
        r"package://arm\meshes\part.stl",
        r"package:\\arm\meshes\part.stl",
        "package:///arm/meshes/part.stl",
        "model://arm/meshes/part.stl",
        "file://{}/arm/meshes/part.stl",
        "file://{}/arm/%6Deshes/part.stl",
        "package://arm/meshes/p%61rt.stl",
        " package://arm/meshes/part.stl ",
        "{}/arm/meshes/part.stl",
    ],
)
def test_files_are_found_by_all_ways_to_name_them(name, tmp_path, caplog):
    for package, size in (("arm", 1), ("hand", 2)):
        (tmp_path / package / "meshes").mkdir(parents=True)
        trimesh.creation.box((size, size, size)).export(tmp_path / package / "meshes" / "part.stl")
    (tmp_path / "arm" / "urdf").mkdir()
    assert load(tmp_path / "arm" / "urdf", name.format(tmp_path)).volume == pytest.approx(1)
    assert not caplog.records
    if name.strip().startswith("package:"):  # of the package that is named, not of the one at hand
        assert load(tmp_path / "arm" / "urdf", name.replace("arm", "hand")).volume == pytest.approx(8)
        assert load(tmp_path / "arm" / "urdf", name.replace("arm", "renamed")).volume == pytest.approx(1)


def test_what_joints_do_not_place_is_named(tmp_path):
    BOX.export(tmp_path / "part.stl")
    loops = '<drake:loop_joint name="bar"/><gazebo><joint name="ring" type="ball"/></gazebo>'
    with pytest.warns(RuntimeWarning, match="r.urdf: not enforced: joints 'bar', 'ring' of") as caught:
        load(tmp_path, "part.stl", rest=loops)
    assert len(caught) == 1
    with pytest.warns(RuntimeWarning, match="r.urdf: 'm', 'n' hang on no joint, and are placed where 'l' is"):
        load(tmp_path, "part.stl", rest='<link name="m"/><link name="n"/>')
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        refused(RuntimeWarning, "not enforced", load, tmp_path, "part.stl", rest=loops)
        others = '<gazebo reference="l"/><transmission name="t"><joint name="x"/></transmission>'
        load(tmp_path, "part.stl", rest=others)
