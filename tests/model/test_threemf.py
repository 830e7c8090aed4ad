"""3MF packages written by hand: items, components, parts of the production extension, and what is refused or named."""

import io
import zipfile

import numpy as np
import pytest
import trimesh
from helpers import refused
from helpers.scenes import names_of, posed_triangles

import warp_abtree as ab

BOX = trimesh.creation.box((1, 2, 3))
CORE, PRODUCTION = (f"http://schemas.microsoft.com/3dmanufacturing/{name}" for name in ("core/2015/02", "production/x"))
RELS = '<Relationships><Relationship Type="http://x/3dmodel" Target="/{}"/></Relationships>'


def made_of(size=1, name="", more=""):
    """Return an object (its number stays open) that is a box of a size."""
    points = "".join('<vertex x="{}" y="{}" z="{}"/>'.format(*point) for point in (BOX.vertices * size).tolist())
    faces = "".join('<triangle v1="{}" v2="{}" v3="{}"/>'.format(*face) for face in BOX.faces.tolist())
    mesh = f"<mesh><vertices>{points}</vertices><triangles>{faces}</triangles>{more}</mesh>"
    return f'<object id="{{}}" {name}>{mesh}</object>'


def joined(*components, name=""):
    return f'<object id="{{}}" {name}><components>{"".join(components)}</components></object>'


def place(kind, number, x=0, more=""):
    return f'<{kind} objectid="{number}" transform="1 0 0 0 1 0 0 0 1 {x} 0 0" {more}/>'


def model(objects, items=(), attributes=""):
    listed = "".join(text.format(number) for number, text in objects.items())
    head = f'<model xmlns="{CORE}" xmlns:p="{PRODUCTION}" {attributes}>'
    return f"{head}<resources>{listed}</resources><build>{''.join(items)}</build></model>"


def package(path, main, root="3D/3dmodel.model", rels=True, **parts):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        if rels:
            archive.writestr("_rels/.rels", RELS.format(root))
        for name, text in {root: main, **{f"3D/Objects/{key}.model": text for key, text in parts.items()}}.items():
            archive.writestr(name, text)
    path.write_bytes(file.getvalue())
    return path


def item(number, x=0, more=""):
    return place("item", number, x, more)


def part(number, x=0, path=""):
    return place("component", number, x, f'p:path="/3D/Objects/{path}.model"' if path else "")


BODY, NAMED = made_of(), made_of(2, 'name="nut"')
ONE, TWO = model({1: BODY}), model({1: made_of(2), 2: joined(part(1, 1))})
BODIES = {1: made_of(1, 'name="Body1"'), 2: made_of(2, 'name="Body2"')}
BODIES |= {3: joined(part(1), name='name="Part(1)body"'), 4: joined(part(2), name='name="Part(2)body"')}
# The model, other parts of the package, and where boxes of which size and name are along x.
PACKAGES = {
    "items": (model({1: BODY}, [item(1), item(1, 9)]), {}, [("1", 1, 0), ("1_1", 1, 9)]),
    "one part number": (
        model({1: BODY}, [item(1, 0, 'partnumber="P"'), item(1, 9, 'partnumber="P"')]),
        {},
        [("P", 1, 0), ("P_1", 1, 9)],
    ),
    "names that repeat": (model({1: NAMED, 2: NAMED}, [item(1), item(2, 9)]), {}, [("nut", 2, 0), ("nut_1", 2, 9)]),
    "called as the frame of all": (model({1: made_of(1, 'name="world"')}, [item(1, 9)]), {}, [("world", 1, 9)]),
    "not built": (model({1: BODY, 2: NAMED}, [item(2)]), {}, [("nut", 2, 0)]),
    "components": (
        model({1: BODY, 2: joined(part(1, 1), part(1, 5)), 3: joined(part(2, 10), part(1))}, [item(3, 100)]),
        {},
        [("1", 1, 111), ("1_1", 1, 115), ("1_2", 1, 100)],
    ),
    "names of bodies": (model(BODIES, [item(3), item(4, 9)]), {}, [("Body1", 1, 0), ("Body2", 2, 9)]),
    "two objects of a part": (
        model({7: joined(part(1, 1, "b"), part(2, 5, "b"), name='name="pair"')}, [item(7)]),
        {"b": TWO},
        [("pair", 2, 1), ("pair_1", 2, 6)],
    ),
    "one number in two parts": (
        model({1: joined(part(1, 1, "a"), part(1, 5, "b"), part(1, 9, "a"))}, [item(1)]),
        {"a": ONE, "b": TWO},
        [("1", 1, 1), ("1_1", 2, 5), ("1_2", 1, 9)],
    ),
    "an item of a part": (model({}, [item(1, 9, 'p:path="/3d/objects/A.model"')]), {"a": ONE}, [("1", 1, 9)]),
}


@pytest.mark.parametrize("name", PACKAGES)
def test_boxes_stand_where_the_build_puts_them(tmp_path, name):
    main, parts, expected = PACKAGES[name]
    path = package(tmp_path / "a.3mf", main, **parts)
    scene = ab.scene_from_file(path, device="cpu")
    assert names_of(scene) == [title for title, _, _ in expected]
    for i, (_, size, x) in enumerate(expected):
        np.testing.assert_allclose(posed_triangles(scene, i), BOX.triangles * size + [x, 0, 0], atol=1e-12)
    assert ab.Model.load(path).face_count == 12 * len(expected)


def test_turns_units_and_names_of_the_main_part(tmp_path):
    turned = '<item objectid="1" transform="0 1 0 -1 0 0 0 0 1 5 0 0"/>'
    main = model({1: BODY}, [turned], 'unit="inch" requiredextensions="p"')
    for rels, root in ((True, "model/thing.model"), (False, "3d/3DModel.model")):
        scene = ab.scene_from_file(package(tmp_path / "a.3mf", main, root, rels), device="cpu")
        np.testing.assert_allclose(posed_triangles(scene, 0), BOX.triangles[..., [1, 0, 2]] * [-1, 1, 1] + [5, 0, 0])


def test_what_is_not_read_is_named(tmp_path):
    lattice = made_of(1, more='<b:beamlattice xmlns:b="http://x"/>')
    path = package(tmp_path / "a.3mf", model({1: lattice}, [item(1), item(7)]))
    with pytest.warns(UserWarning, match="a.3mf: left out beamlattice of object 1, object 7, which is not there$"):
        assert ab.Model.load(path).face_count == 12


DOUBLING = {k: joined(part(k + 1), part(k + 1)) for k in range(40)} | {40: BODY}


@pytest.mark.parametrize(
    "main, message",
    [
        (model({1: BODY}), "no faces: its build places no mesh"),
        (model({1: joined(part(2)), 2: joined(part(1))}, [item(1)]), "object 1 is a component of itself"),
        (model(DOUBLING, [item(0)]), "places more than 1,048,576 objects"),
        (model({1: BODY.replace('x="0.5"', 'x="0,5"')}, [item(1)]), "is damaged: ValueError: .*0,5"),
        (model({1: BODY.replace('v2="1"', 'v2="99"')}, [item(1)]), r"has corners \[.*99.*\], but vertices run"),
        (model({1: BODY}, [item(1).replace("0 0 1 0", "0 0 1")]), "is damaged: ValueError"),
        (model({1: BODY}, [item(1)], 'requiredextensions="p q"'), "requires the 3MF extension q, which is not read"),
        (model({1: BODY}, [item(1)])[:-3], "is damaged: ParseError"),
    ],
)
def test_damaged_packages_are_refused(tmp_path, main, message, monkeypatch):
    monkeypatch.setattr("warp_abtree.model.files.threemf.PLACES_MAX", 2**10)
    message = message.replace("1,048,576", "1,024")
    path = package(tmp_path / "a.3mf", main)
    for load in (ab.Model.load, ab.scene_from_file):
        assert str(refused(ab.MeshError, message, load, path)).startswith(f"{path}: ")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "")
    refused(ab.MeshError, "a.3mf: holds no 3D model 3D/3dmodel.model", ab.Model.load, path)
