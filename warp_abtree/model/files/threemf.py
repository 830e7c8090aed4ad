"""3MF files: the meshes of the objects that the build places, an object of a scene for each place of each."""

import posixpath
import re
from xml.etree import ElementTree

import numpy as np

from warp_abtree.model.files.found import MeshError, Remarks, empty_scene, refusing

MODEL = "3D/3dmodel.model"  # where most writers put it, whatever the relationships of the package say
EXTENSIONS = ("/production/", "/material/")  # extensions that a file may require
CHILDREN = {"object": ("mesh", "components", "metadatagroup"), "mesh": ("vertices", "triangles", "trianglesets")}
PLACES_MAX = 2**20  # components of components may multiply


def read_3mf(members: dict[str, bytes], where: str, remarks: Remarks):
    """Return the members of a 3MF package as a trimesh.Scene, in the file's units.

    Raises MeshError where it is damaged, requires an extension that is not read, or its build places nothing.
    """
    damaged = KeyError, ValueError, TypeError, OverflowError, ElementTree.ParseError
    with refusing(f"{where}: is damaged", damaged, with_type=True):
        return _Package(members, where, remarks).scene()


class _Package:
    """One file: the trees of its parts, and the meshes that have been read."""

    def __init__(self, members, where, remarks):
        self.members = {name.lstrip("/").lower(): data for name, data in members.items()}
        self.where, self.remarks, self.made = where, remarks, empty_scene()
        self._objects: dict[str, tuple] = {}
        self._meshes: dict[tuple, str | None] = {}

    def scene(self):
        """Return the meshes where the items of the build and the components of objects put them."""
        import trimesh

        path = self._root()
        open_items: list[tuple] = [(item, path, np.eye(4), None, ()) for item in reversed(self._part(path)[1])]
        names, counts = set[str](), dict[str | None, int]()
        while open_items:
            item, path, above, name, chain = open_items.pop()
            path = _attribute(item, "path") or path
            key = (path.lstrip("/").lower(), item.get("objectid"))
            if key in chain:
                raise MeshError(f"{self.where}: object {key[1]} is a component of itself")
            found = self._part(path)[0].get(key[1])
            if found is None:
                self.remarks.add("left out", f"object {key[1]}, which is not there")
                continue
            name, pose = item.get("partnumber") or found.get("name") or name, above @ _transform(item)
            parts = found.findall("{*}components/{*}component")
            open_items += [(part, path, pose, name, (*chain, key)) for part in reversed(parts)]
            geometry = self._mesh(found, key)
            if geometry is not None:
                title = trimesh.util.unique_name(name or key[1], names, counts)
                names.add(title)
                self.made.graph.update(title, geometry=geometry, matrix=pose)
            if len(open_items) + len(names) > PLACES_MAX:
                raise MeshError(f"{self.where}: places more than {PLACES_MAX:,} objects")
        if not self.made.geometry:
            said = f" ({self.remarks})" if str(self.remarks) else ""
            raise MeshError(f"{self.where}: no faces: its build places no mesh{said}")
        return self.made

    def _root(self) -> str:
        """Return the path of the part that has the build."""
        rels = self.members.get("_rels/.rels")
        for entry in [] if rels is None else ElementTree.fromstring(rels):
            if (entry.get("Type") or "").endswith("/3dmodel"):
                return posixpath.normpath(entry.attrib["Target"])
        return MODEL

    def _part(self, path):
        """Return the objects of a part by their ids, and the items of its build; none of one that is not there."""
        key = path.lstrip("/").lower()
        if key not in self._objects:
            data = self.members.get(key)
            if data is None and not self._objects:
                raise MeshError(f"{self.where}: holds no 3D model {path.lstrip('/')}")
            tree = ElementTree.Element("model") if data is None else ElementTree.fromstring(data)
            self._check_extensions(tree, data)
            found = {each.get("id"): each for each in tree.iterfind("{*}resources/{*}object")}
            self._objects[key] = found, tree.findall("{*}build/{*}item")
        return self._objects[key]

    def _check_extensions(self, tree, data):
        """Refuse a part that requires an extension which is not read, such as beam lattices."""
        for prefix in (tree.get("requiredextensions") or "").split():
            space = re.search(rb"xmlns:" + re.escape(prefix).encode() + rb"""\s*=\s*["']([^"']*)""", data)
            title = space[1].decode(errors="replace") if space else prefix
            if not any(known in title for known in EXTENSIONS):
                raise MeshError(f"{self.where}: requires the 3MF extension {title}, which is not read")

    def _mesh(self, found, key) -> str | None:
        """Add the mesh of an object to the scene's geometry once; return its name there, None without triangles."""
        import trimesh

        if key in self._meshes:
            return self._meshes[key]
        self._meshes[key], mesh = None, found.find("{*}mesh")
        for tree, known in ((found, CHILDREN["object"]), (mesh, CHILDREN["mesh"])):
            for part in () if tree is None else tree:
                tag = part.tag.rpartition("}")[2]
                if tag not in known:
                    self.remarks.add("left out", f"{tag} of object {key[1]}")
        corners = [] if mesh is None else mesh.findall("{*}triangles/{*}triangle")
        if corners:
            points = [float(p.attrib[axis]) for p in mesh.iterfind("{*}vertices/{*}vertex") for axis in "xyz"]
            faces = [int(t.attrib[corner]) for t in corners for corner in ("v1", "v2", "v3")]
            name = trimesh.util.unique_name(found.get("name") or key[1], self.made.geometry)
            self.made.geometry[name] = trimesh.Trimesh(
                np.array(points).reshape(-1, 3), np.array(faces).reshape(-1, 3), process=False
            )
            self._meshes[key] = name
        return self._meshes[key]


def _attribute(element, name) -> str | None:
    """Return an attribute of any namespace."""
    return next((value for key, value in element.attrib.items() if key.rpartition("}")[2] == name), None)


def _transform(item) -> np.ndarray:
    """Return the transform of an item or a component; in the file vectors are rows, and the last column is left out."""
    pose = np.eye(4)
    if item.get("transform"):
        pose[:3] = np.array(item.get("transform").split(), np.float64).reshape(4, 3).T
    return pose
