"""USD stages as trimesh scenes: meshes, the basic shapes as meshes, instances and point instancers."""

import warnings

import numpy as np

from warp_abtree.model.mesh import MeshError
from warp_abtree.model.obj import read_usd_mesh

# Round shapes: 64 sections around, spheres of 5,120 faces. All lie within 0.002 of the radius inside.
SECTIONS, SUBDIVISIONS = 64, 4
# Prims that a warning names.
NAMED = 4
# From a shape along z to one along another axis, cyclically, which mirrors nothing.
AXIS_COLUMNS = {"X": [2, 0, 1], "Y": [1, 2, 0], "Z": [0, 1, 2]}


def read_usd(path):
    """Return a stage at its first time as a trimesh.Scene, with the prim's path for the name of each node.

    Prims that are geometry but cannot be read, and those that are invisible, are left out with a warning.

    Raises:
        MeshError: usd-core is missing, the file cannot be read, or a mesh is damaged.
    """
    try:
        from pxr import Tf, Usd
    except ImportError:
        raise MeshError(f"{path}: reading it needs usd-core: pip install usd-core") from None
    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise MeshError(f"{path}: cannot be read: {str(error).splitlines()[-1].strip()}") from None
    reader = _StageReader(path, stage)
    reader.visit(stage.GetPseudoRoot(), "", reader.places.GetLocalToWorldTransform)
    if reader.skipped:
        listed = ", ".join(reader.skipped[:NAMED])
        more = f" and {len(reader.skipped) - NAMED} more" if len(reader.skipped) > NAMED else ""
        warnings.warn(f"{path}: left out {listed}{more}", stacklevel=3)
    return reader.scene


class _StageReader:
    """What a walk over a stage has found: `scene`, and `skipped`, the prims that it left out and why."""

    def __init__(self, path, stage):
        import trimesh
        from pxr import Usd, UsdGeom

        self.path, self.stage = path, stage
        self.time = Usd.TimeCode.EarliestTime()
        if stage.HasAuthoredTimeCodeRange():
            self.time = Usd.TimeCode(stage.GetStartTimeCode())
        self.places = UsdGeom.XformCache(self.time)
        self.scene, self.skipped = trimesh.Scene(), []
        self._known: dict[tuple, str] = {}

    def visit(self, root, prefix, transform_of):
        """Add what lies under a prim.

        Args:
            prefix: Of the names of nodes.
            transform_of: Returns where a prim is in the world, a matrix of USD.
        """
        from pxr import Usd, UsdGeom

        prims = iter(Usd.PrimRange(root, Usd.TraverseInstanceProxies()))
        for prim in prims:
            name = prefix + str(prim.GetPath())
            if self._is_hidden(prim):
                prims.PruneChildren()
                if any(part.IsA(UsdGeom.Gprim) for part in Usd.PrimRange(prim, Usd.TraverseInstanceProxies())):
                    self.skipped.append(f"{name} (invisible)")
            elif prim.IsA(UsdGeom.PointInstancer):
                prims.PruneChildren()
                self._spread(UsdGeom.PointInstancer(prim), name, transform_of(prim))
            elif prim.IsA(UsdGeom.Gprim):
                self._add(prim, name, transform_of(prim))

    def _is_hidden(self, prim) -> bool:
        """Return whether a prim hides itself and all under it."""
        from pxr import UsdGeom

        shown = UsdGeom.Imageable(prim)
        return bool(shown) and shown.GetVisibilityAttr().Get(self.time) == UsdGeom.Tokens.invisible

    def _add(self, prim, name, transform):
        import trimesh
        from pxr import UsdGeom

        if prim.IsA(UsdGeom.Mesh):
            found = read_usd_mesh(UsdGeom.Mesh(prim), self.time, f"{self.path}: {prim.GetPath()}")
            if found is None:
                return
            vertices, faces = found
            if UsdGeom.Mesh(prim).GetOrientationAttr().Get(self.time) == UsdGeom.Tokens.leftHanded:
                faces = faces[:, ::-1]
        else:
            shape = _make_shape(prim, self.time)
            if shape is None:
                self.skipped.append(f"{name} ({prim.GetTypeName()})")
                return
            vertices, faces = shape
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        geometry = self._known.setdefault((mesh.vertices.tobytes(), mesh.faces.tobytes()), str(prim.GetPath()))
        self.scene.geometry.setdefault(geometry, mesh)
        self.scene.graph.update(name, geometry=geometry, matrix=np.array(transform).T)

    def _spread(self, instancer, name, base):
        """Add the instances of a point instancer that are active and visible."""
        time, places = self.time, self.places
        targets = instancer.GetPrototypesRel().GetForwardedTargets()
        indices = instancer.GetProtoIndicesAttr().Get(time) or []
        ways = instancer.ComputeInstanceTransformsAtTime(time, time, instancer.IncludeProtoXform, instancer.IgnoreMask)
        shown = instancer.ComputeMaskAtTime(time) or [True] * len(indices)
        for k, (index, way) in enumerate(zip(indices, ways)):
            if not shown[k]:
                continue
            prototype = self.stage.GetPrimAtPath(targets[index])
            root = places.GetLocalToWorldTransform(prototype).GetInverse()
            self.visit(
                prototype,
                f"{name}[{k}]",
                lambda prim, root=root, way=way: places.GetLocalToWorldTransform(prim) * root * way * base,
            )


def _make_shape(prim, time):
    """Return vertices and faces of a Cube, Sphere, Cylinder, Cone, Capsule or Plane; None of any other kind."""
    from trimesh import creation

    def get(name):
        return prim.GetAttribute(name).Get(time)

    kind = prim.GetTypeName()
    if kind == "Cube":
        mesh = creation.box(extents=[get("size")] * 3)
    elif kind == "Sphere":
        mesh = creation.icosphere(subdivisions=SUBDIVISIONS, radius=get("radius"))
    elif kind == "Cylinder":
        mesh = creation.cylinder(radius=get("radius"), height=get("height"), sections=SECTIONS)
    elif kind == "Cone":
        mesh = creation.cone(radius=get("radius"), height=get("height"), sections=SECTIONS)
    elif kind == "Capsule":
        mesh = creation.capsule(radius=get("radius"), height=get("height"), count=(SECTIONS, SECTIONS))
    elif kind == "Plane":
        return _make_plane(get("width") / 2, get("length") / 2, get("axis"))
    else:
        return None
    vertices = np.asarray(mesh.vertices, np.float64)
    # Of USD all have their middle at the origin.
    vertices = vertices - (vertices.min(0) + vertices.max(0)) / 2
    return vertices[:, AXIS_COLUMNS[get("axis")] if prim.HasAttribute("axis") else AXIS_COLUMNS["Z"]], np.asarray(
        mesh.faces
    )


def _make_plane(width, length, axis):
    """Return two triangles of half a width and half a length, whose normal is the axis."""
    x, y = np.array([-width, width, width, -width]), np.array([-length, -length, length, length])
    flat = np.zeros(4)
    vertices = {"X": [flat, y, -x], "Y": [x, flat, -y], "Z": [x, y, flat]}[axis]
    return np.stack(vertices, 1), np.array([[0, 1, 2], [0, 2, 3]])
