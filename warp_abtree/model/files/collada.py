"""Collada files (DAE), parsed by pycollada: the polygons of their nodes, an object a node and geometry."""

import io
from xml.etree import ElementTree

import numpy as np

from warp_abtree.checks.arguments import first_line
from warp_abtree.model.files.found import MeshError, Remarks, empty_scene, refusing
from warp_abtree.model.files.polygons import triangulate

PRIMITIVES = ("lines", "polygons", "polylist", "triangles", "trifans", "tristrips")
# What tells errors of pycollada that concern no shapes.
COLLADA_LOOKS = ("effect", "material", "image", "surface", "sampler", "texture", "camera", "light", "animation")


def read_collada(data: bytes, where: str, remarks: Remarks):
    """Return a Collada file as a trimesh.Scene, in the file's units and axes.

    Raises MeshError where pycollada is missing, the file is damaged, or a polygon has holes.
    """
    import trimesh

    try:
        import collada
    except ImportError:
        raise MeshError(f"{where}: reading it needs pycollada: pip install pycollada") from None
    with refusing(f"{where}: cannot be read as dae"):  # XML, or whatever goes wrong inside the parser
        file = collada.Collada(io.BytesIO(data), ignore=[collada.common.DaeError])
        if file.errors:
            data = _without_strange_primitives(data, remarks)
            file = collada.Collada(io.BytesIO(data), ignore=[collada.common.DaeError])
    for broken in map(first_line, file.errors):
        if not any(word in broken.lower() for word in COLLADA_LOOKS):
            remarks.add("left out what is broken:", broken)
    for tree in file.xmlnode.iterfind(".//{*}geometry"):
        if tree.find(".//{*}ph") is not None:
            raise MeshError(f"{where}: geometry {tree.get('id')!r} has polygons with holes (<ph>), which are not read")
    if file.xmlnode.find(".//{*}node/{*}skew") is not None:
        raise MeshError(f"{where}: a node has a <skew>, which is not read")
    for other in file.scenes:
        if other is not file.scene and other.nodes:
            remarks.add("left out", f"scene {other.id!r}")
    made, known, counts = empty_scene(), {}, {}
    open_nodes = [(node, np.eye(4), None) for node in reversed(file.scene.nodes if file.scene else [])]
    while open_nodes:
        node, above, name = open_nodes.pop()
        if isinstance(node, collada.scene.Node):
            pose = above @ _transform(node)
            # An instance of a node has none of its own.
            title = node.xmlnode.get("name") or node.xmlnode.get("id") or name or node.id
            open_nodes += [(child, pose, title) for child in reversed(node.children or [])]
        elif isinstance(node, collada.scene.ControllerNode):
            remarks.add("left out", f"{name or node.controller.id} (skin or morph)")
        elif isinstance(node, collada.scene.GeometryNode):
            geometry = node.geometry
            if geometry.id not in known:
                known[geometry.id] = _read_geometry(geometry, where, remarks)
                if known[geometry.id] is not None:
                    made.geometry[geometry.id] = known[geometry.id]
            if not (above[3] == [0, 0, 0, 1]).all():
                raise MeshError(f"{where}: node {name!r}: its transform is not affine")
            if known[geometry.id] is not None:
                frame = trimesh.util.unique_name(name or geometry.id, made.graph.nodes, counts)
                made.graph.update(frame, geometry=geometry.id, matrix=above)
    return made


def _without_strange_primitives(data, remarks) -> bytes:
    """Return a file without what makes pycollada leave out a whole geometry: line strips, and primitives of nothing."""
    tree = ElementTree.fromstring(data)
    for geometry in tree.iterfind(".//{*}geometry"):
        for mesh in geometry.iterfind("{*}mesh"):
            for primitive in list(mesh):
                tag = primitive.tag.rpartition("}")[2]
                if tag == "linestrips":
                    remarks.add("left out", f"lines of {geometry.get('id')!r}")
                elif tag not in PRIMITIVES or any(primitive.find(f"{{*}}{part}") is not None for part in ("p", "ph")):
                    continue
                mesh.remove(primitive)
    return ElementTree.tostring(tree)


def _transform(node) -> np.ndarray:
    """Return the transform of a node as its text has it, which pycollada would round to float32."""
    from trimesh.transformations import rotation_matrix, translation_matrix

    pose = np.eye(4)
    for each in getattr(node, "node", node).transforms:
        tag, given = each.xmlnode.tag.rpartition("}")[2], np.array(each.xmlnode.text.split(), np.float64)
        if tag == "matrix":
            step = given.reshape(4, 4)
        elif tag == "translate":
            step = translation_matrix(given)
        elif tag == "scale":
            step = np.diag([*given, 1.0])
        elif tag == "rotate":
            step = rotation_matrix(np.radians(given[3]), given[:3]) if given[:3].any() else np.eye(4)
        else:  # lookat: where a camera stands, what it sees, and up
            eye, seen, up = given.reshape(3, 3)
            back, side = eye - seen, np.cross(up, eye - seen)
            axes = np.array([side, np.cross(back, side), back])
            step = np.eye(4)
            step[:3, :3], step[:3, 3] = (axes / np.linalg.norm(axes, axis=1, keepdims=True)).T, eye
        pose = pose @ step
    return pose


def _positions(geometry, where) -> np.ndarray:
    """Return the positions of a geometry, which pycollada would round to float32, and make 0 of those that are NaN.

    Refuses what pycollada passes over: numbers between or before those of the positions.
    """
    tree, place = geometry.xmlnode, f"{where}: geometry {geometry.id!r}"
    places = {node.get("source") for node in tree.iterfind("{*}mesh/{*}vertices/{*}input[@semantic='POSITION']")}
    for source in tree.iterfind("{*}mesh/{*}source"):
        found = source.find("{*}technique_common/{*}accessor")
        if found is None or f"#{source.get('id')}" not in places:
            continue
        names = "".join(node.get("name", "") for node in found.iterfind("{*}param"))
        turned = sorted(names) == list("XYZ") and names != "XYZ"
        if turned or found.get("stride", "3") != "3" or found.get("offset", "0") != "0":
            raise MeshError(f"{place} has positions that are not X, Y and Z side by side")
        with refusing(f"{place} has positions that cannot be read", ValueError):
            return np.array((source.findtext("{*}float_array") or "").split(), np.float64).reshape(-1, 3)
    raise MeshError(f"{place} has no positions")


def _read_geometry(geometry, where, remarks):
    """Return a geometry as a trimesh.Trimesh, None without polygons."""
    import collada
    import trimesh

    faces, points = [], None
    for primitive in geometry.primitives:
        if isinstance(primitive, collada.lineset.LineSet):
            remarks.add("left out", f"lines of {geometry.id!r}")
            continue
        if primitive.vertex is None:
            continue
        points = _positions(geometry, where) if points is None else points
        place = f"{where}: geometry {geometry.id!r}"
        corners = np.asarray(primitive.vertex_index, np.int64)
        if isinstance(primitive, collada.polylist.Polylist):
            counts = np.asarray(primitive.vcounts, np.int64)
            if counts.sum() != len(corners):
                raise MeshError(f"{place}: its polygons have {counts.sum()} corners, their indices {len(corners)}")
        else:
            counts = np.full(len(corners), 3)
        faces.append(triangulate(points, counts, corners.reshape(-1), place))
    if not sum(map(len, faces)):
        return None
    return trimesh.Trimesh(points, np.concatenate(faces), process=False)
