"""Odd but valid mesh files, against the triangles that they hold; and what is wrong with them said by its name."""

import re
import zipfile

import numpy as np
import pytest
import trimesh
from helpers.scenes import names_of, posed_triangles

import warp_abtree as ab

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
