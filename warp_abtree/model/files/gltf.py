"""glTF and GLB files: the triangles of their nodes, an object a node whatever its number of materials."""

import base64
import json
import struct
from urllib.parse import unquote

import numpy as np

from warp_abtree.checks.arguments import first_line
from warp_abtree.model.files.found import MeshError, Remarks, empty_scene, refusing
from warp_abtree.model.files.polygons import cut_strip
from warp_abtree.model.files.unpack import exceeds_limit

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
DRACO, INSTANCES, VISIBILITY = "KHR_draco_mesh_compression", "EXT_mesh_gpu_instancing", "KHR_node_visibility"
# Extensions that a file may require: read here, or without influence on shapes.
READ = {DRACO, INSTANCES, VISIBILITY, "KHR_mesh_quantization", "KHR_lights_punctual", "KHR_xmp_json_ld", "KHR_xmp"}
LOOKS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "EXT_materials_", "MSFT_texture_", "EXT_lights_")
KINDS = {0: "points", 1: "lines", 2: "lines", 3: "lines"}


def read_gltf(data: bytes, where: str, resolver, remarks: Remarks):
    """Return a glTF or GLB file as a trimesh.Scene; trimesh's resolver finds files that it refers to.

    Raises MeshError where it is damaged, such a file is missing, or it requires an extension that is not read.
    """
    unreadable = ValueError, KeyError, TypeError, RecursionError, struct.error
    with refusing(f"{where}: cannot be read as glTF", unreadable, with_type=True):
        text, binary = _split_binary(data, where) if data[:4] == b"glTF" else (data, None)
        tree = json.loads(text)
        version = str(tree["asset"]["version"])
    if not version.startswith("2."):
        raise MeshError(f"{where}: is glTF {version}, only 2 is read")
    for name in tree.get("extensionsRequired", ()):
        if name not in READ and not name.startswith(LOOKS):
            raise MeshError(f"{where}: requires the glTF extension {name}, which is not read")
    damaged = KeyError, IndexError, TypeError, AttributeError, ValueError
    with refusing(f"{where}: is damaged", damaged, with_type=True):
        return _Reader(tree, binary, where, resolver, remarks).scene()


def _split_binary(data, where):
    """Return the two chunks of a GLB file, None for one that it has not."""
    _, version, length = struct.unpack_from("<4sII", data)
    if version != 2:
        raise MeshError(f"{where}: is glTF {version}, only 2 is read")
    chunks, at = {}, 12
    while at + 8 <= min(length, len(data)):
        size, kind = struct.unpack_from("<I4s", data, at)
        if at + 8 + size > len(data):
            raise MeshError(f"{where}: cut short: {len(data)} bytes of {max(length, at + 8 + size)}")
        chunks.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 8 + size
    if length > len(data):
        raise MeshError(f"{where}: cut short: {len(data)} bytes of {length}")
    return chunks[b"JSON"], chunks.get(b"BIN\0")


class _Table(list):
    """What the file numbers from 0."""

    def __getitem__(self, index):
        if index < 0:
            raise IndexError(f"{index} is below 0")
        return super().__getitem__(index)


class _Reader:
    """One file: its tree, and the buffers that have been read."""

    def __init__(self, tree, binary, where, resolver, remarks):
        self.tree = {key: _Table(value) if isinstance(value, list) else value for key, value in tree.items()}
        self.where, self.resolver, self.remarks = where, resolver, remarks
        own = binary is not None and "uri" not in tree.get("buffers", [{}])[0]
        self._buffers = {0: binary} if own else {}
        self._meshes: dict[int, str | None] = {}

    def scene(self):
        """Return the meshes of the file's scene where its nodes put them."""
        import trimesh

        made, nodes = empty_scene(), self.tree.get("nodes", [])
        below = {child for node in nodes for child in node.get("children", ())}
        scenes = self.tree.get("scenes", [{"nodes": [k for k in range(len(nodes)) if k not in below]}])
        shown = self.tree.get("scene", 0)
        for k, other in enumerate(scenes):
            if k != shown and other.get("nodes"):
                self.remarks.add("left out", f"scene {other.get('name', k)!r}")
        open_nodes = [(k, np.eye(4)) for k in reversed(scenes[shown].get("nodes", ()))]
        seen, names, counts = set(), set(), {}
        while open_nodes:
            k, above = open_nodes.pop()
            if k in seen:
                raise MeshError(f"{self.where}: node {k} hangs on two nodes or on itself")
            seen.add(k)
            node = nodes[k]
            name = trimesh.util.unique_name(str(node.get("name") or k), names, counts)
            names.add(name)
            extensions = node.get("extensions", {})
            if not extensions.get(VISIBILITY, {}).get("visible", True):
                self.remarks.add("left out", f"{name} (invisible)")
                continue
            pose = above @ _matrix(node)
            if not (pose[3] == [0, 0, 0, 1]).all():
                raise MeshError(f"{self.where}: node {name!r}: its transform is not affine")
            open_nodes += [(child, pose) for child in reversed(node.get("children", ()))]
            geometry = self._mesh(node["mesh"], made) if "mesh" in node else None
            if geometry is None:
                continue
            if "skin" in node:
                self.remarks.add("taken at rest:", f"{name} (skin)")
            if INSTANCES not in extensions:
                made.graph.update(name, geometry=geometry, matrix=pose)
                continue
            for i, own in enumerate(self._instances(extensions[INSTANCES]["attributes"])):
                made.graph.update(f"{name}[{i}]", geometry=geometry, matrix=pose @ own)
        return made

    def _mesh(self, index, scene) -> str | None:
        """Add a mesh to the scene's geometry once; return its name there, None without triangles."""
        import trimesh

        if index in self._meshes:
            return self._meshes[index]
        mesh = self.tree["meshes"][index]
        name = trimesh.util.unique_name(str(mesh.get("name") or f"mesh {index}"), scene.geometry)
        vertices, faces, starts, count = [], [], {}, 0
        for primitive in mesh["primitives"]:
            kind = KINDS.get(primitive.get("mode", 4))
            if kind is not None:
                self.remarks.add("left out", f"{kind} of mesh {name!r}")
                continue
            if "POSITION" not in primitive["attributes"]:
                self.remarks.add("left out", f"what has no positions of mesh {name!r}")
                continue
            if primitive.get("targets"):
                self.remarks.add("taken at rest:", f"mesh {name!r} (morph targets)")
            points, triangles = self._triangles(primitive, name)
            # Primitives of several materials mostly share their vertices.
            key = None if DRACO in primitive.get("extensions", {}) else primitive["attributes"]["POSITION"]
            if key is None or key not in starts:
                starts[key] = count
                vertices.append(points)
                count += len(points)
            faces.append(triangles + starts[key])
        self._meshes[index] = name if sum(map(len, faces)) else None
        if self._meshes[index] is not None:
            scene.geometry[name] = trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)
        return self._meshes[index]

    def _triangles(self, primitive, name):
        """Return vertices and triangles of a primitive."""
        where, mode = f"{self.where}: mesh {name!r}", primitive.get("mode", 4)
        packed = primitive.get("extensions", {}).get(DRACO)
        position = primitive["attributes"]["POSITION"]
        if packed is not None and "bufferView" not in self.tree["accessors"][position]:
            vertices, corners = self._unpack_draco(packed, where)
            mode = 4  # whatever was packed
        else:
            vertices = self._accessor(position).astype(np.float64)
            if vertices.shape[1:] != (3,):
                raise MeshError(f"{where}: its positions have {vertices[:1].size} numbers, not 3")
            corners = self._accessor(primitive["indices"]) if "indices" in primitive else np.arange(len(vertices))
        if corners.dtype.kind not in "iu":
            raise MeshError(f"{where}: its indices are no integers")
        corners = corners.reshape(-1).astype(np.int64)
        if len(corners) and not 0 <= corners.min() <= corners.max() < len(vertices):
            raise MeshError(f"{where}: refers to vertex {corners.max()}, but there are {len(vertices)}")
        if mode == 5:
            return vertices, cut_strip(corners)
        if mode == 6:
            apex = np.full(max(len(corners) - 2, 0), corners[0] if len(corners) else 0)
            return vertices, np.stack([apex, corners[1:-1], corners[2:]], axis=1)
        if mode != 4:
            raise MeshError(f"{where}: a primitive of mode {mode}, which glTF does not have")
        if len(corners) % 3:
            raise MeshError(f"{where}: {len(corners)} corners do not make triangles")
        return vertices, corners.reshape(-1, 3)

    def _unpack_draco(self, packed, where):
        try:
            import DracoPy
        except ImportError:
            raise MeshError(f"{where}: {DRACO} needs DracoPy: pip install DracoPy") from None
        data, _ = self._view(packed["bufferView"])
        with refusing(f"{where}: {DRACO} cannot be read"):  # whatever goes wrong inside the decoder
            found = DracoPy.decode(bytes(data))
            return np.asarray(found.points, np.float64), np.asarray(found.faces)

    def _instances(self, attributes):
        """Return the matrices of the instances of a node."""
        columns = {key: self._accessor(index) for key, index in attributes.items()}
        for k in range(max(map(len, columns.values()), default=0)):
            parts = {"TRANSLATION": "translation", "ROTATION": "rotation", "SCALE": "scale"}
            yield _matrix({word: columns[key][k] for key, word in parts.items() if key in columns})

    def _view(self, index):
        """Return the bytes of a buffer view, and the distance of its elements, None where they lie side by side."""
        view = self.tree["bufferViews"][index]
        data, start = self._buffer(view["buffer"]), view.get("byteOffset", 0)
        if start < 0 or start + view["byteLength"] > len(data):
            raise MeshError(f"{self.where}: buffer view {index} ends outside its buffer")
        return memoryview(data)[start : start + view["byteLength"]], view.get("byteStride")

    def _buffer(self, index):
        if index not in self._buffers:
            buffer = self.tree["buffers"][index]
            uri = buffer.get("uri")
            if uri is None:
                packed = ", ".join(f"; {name} is not read" for name in buffer.get("extensions", ()))
                raise MeshError(f"{self.where}: buffer {index} has no data{packed}")
            try:
                if uri.startswith("data:"):
                    head, _, text = uri.partition(",")
                    if not head.endswith(";base64"):
                        raise ValueError("its data are not base64")
                    self._buffers[index] = base64.b64decode(text, validate=True)
                else:
                    self._buffers[index] = self.resolver.get(unquote(uri))
            except (OSError, KeyError, ValueError) as error:
                raise MeshError(f"{self.where}: buffer {uri[:60]!r} cannot be read: {first_line(error)}") from None
        return self._buffers[index]

    def _accessor(self, index):
        """Return the values of an accessor: integers as they are, others and normalized ones float64, (n, width)."""
        about = self.tree["accessors"][index]
        count, width, kind = about["count"], WIDTHS[about["type"]], np.dtype(COMPONENTS[about["componentType"]])
        if "bufferView" in about:
            values = self._strided(about, count, width, kind)
        else:
            if exceeds_limit(count * width * kind.itemsize, 0):
                raise MeshError(f"{self.where}: accessor {index} declares {count:,} values and has none")
            values = np.zeros((count, width), kind)
        if "sparse" in about:
            sparse, values = about["sparse"], values.copy()
            places = np.dtype(COMPONENTS[sparse["indices"]["componentType"]])
            places = self._strided(sparse["indices"], sparse["count"], 1, places)[:, 0]
            values[places] = self._strided(sparse["values"], sparse["count"], width, kind)
        if about.get("normalized") and kind.kind in "iu":
            return np.maximum(values / float(np.iinfo(kind).max), -1.0)
        return values if kind.kind in "iu" else values.astype(np.float64)

    def _strided(self, about, count, width, kind):
        data, stride = self._view(about["bufferView"])
        start, row = about.get("byteOffset", 0), width * kind.itemsize
        stride = row if stride is None else stride
        if count < 0 or start < 0 or stride < row or (count and start + stride * (count - 1) + row > len(data)):
            raise MeshError(f"{self.where}: {count} values of buffer view {about['bufferView']} end outside of it")
        if count == 0:
            return np.zeros((0, width), kind)
        return np.ndarray((count, width), kind, data, start, (stride, kind.itemsize))


def _matrix(node):
    """Return the matrix of a node."""
    from trimesh.transformations import quaternion_matrix

    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    pose = np.eye(4)
    if "rotation" in node:
        x, y, z, w = np.array(node["rotation"], np.float64)
        pose = quaternion_matrix([w, x, y, z])
    pose[:3, :3] = pose[:3, :3] * np.array(node.get("scale", (1, 1, 1)), np.float64)
    pose[:3, 3] = node.get("translation", (0, 0, 0))
    return pose
