"""Polygons of the OBJ files of an MJCF file against the area and volume of the prisms that they bound."""

import pytest
import trimesh

import warp_abtree as ab

pytest.importorskip("mujoco")
LETTER = [(0, 0), (4, 0), (4, 1), (1, 1), (1, 3), (4, 3), (4, 4), (0, 4)]  # area 10, perimeter 22


def prism(ring):
    """Return an OBJ file of a prism of height 1, a polygon a side, with vertices that none uses."""
    count = len(ring)
    faces = [range(count - 1, -1, -1), range(count, 2 * count)]
    faces += [(k, (k + 1) % count, (k + 1) % count + count, k + count) for k in range(count)]
    points = "".join(f"v {x} {y} {z}\n" for z in (0, 1) for x, y in ring)
    return points + "v 9 9 9\nv 0 0 0\n" + "".join(f"f {' '.join(str(k + 1) for k in face)}\n" for face in faces)


@pytest.mark.parametrize("turned", [0, 3, 6])
@pytest.mark.parametrize("more, scale", [("", 1), ('scale="2 2 -2" refpos="1 2 3" refquat="0 1 0 0"', 2)])
def test_polygons_do_not_fold(tmp_path, turned, more, scale):
    (tmp_path / "c.obj").write_text(prism(LETTER[turned:] + LETTER[:turned]))
    (tmp_path / "a.xml").write_text(
        f'<mujoco><asset><mesh name="m" file="c.obj" {more}/></asset><worldbody><geom type="mesh" mesh="m"/>'
        '<body name="arm"><joint name="j" axis="0 0 1"/><geom size="0.1" pos="9 9 9"/></body></worldbody></mujoco>'
    )
    model = ab.Robot.load(tmp_path / "a.xml", device="cpu").models[0]
    solid = trimesh.Trimesh(*model.mesh_at(model.lod_max)[:2])
    assert solid.is_watertight and len(solid.faces) == 2 * 6 + 2 * 8
    assert solid.area == pytest.approx((2 * 10 + 22) * scale**2) and solid.volume == pytest.approx(10 * scale**3)
