"""USD stages as trimesh scenes: meshes, the basic shapes as meshes, instances and point instancers."""

import numpy as np

from warp_abtree.checks.arguments import first_line
from warp_abtree.model.files.found import MeshError
from warp_abtree.model.files.usd_mesh import read_usd_mesh

# Round shapes: 64 sections around, spheres of 5,120 faces. All lie within 0.002 of the radius inside.
SECTIONS, SUBDIVISIONS = 64, 4
SHOWN = ("default", "render")  # purposes that are read
# From a shape along z to one along another axis, cyclically, which mirrors nothing.
AXIS_COLUMNS = {"X": [2, 0, 1], "Y": [1, 2, 0], "Z": [0, 1, 2]}


def read_usd(path, remarks):
    """Return a stage at its first time as a trimesh.Scene, with the prim's path for the name of each node.

    Prims that are geometry but cannot be read, are invisible, or of another purpose than default or render, are left
    out; subdivision is not carried out, and skins are taken at rest. The `Remarks` name all of these. Raises MeshError
    where usd-core is missing, the file cannot be read, or a mesh is damaged.
    """
    try:
        from pxr import Tf, Usd
    except ImportError:
        raise MeshError(f"{path}: reading it needs usd-core: pip install usd-core") from None
    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise MeshError(f"{path}: cannot be read: {str(error).splitlines()[-1].strip()}") from None
    for broken in stage.GetCompositionErrors():
        remarks.add("left out what refers to", first_line(broken))
    reader = _StageReader(path, stage, remarks)
    try:
        reader.visit(stage.GetPseudoRoot(), "", reader.places.GetLocalToWorldTransform)
    except (Tf.ErrorException, IndexError, TypeError, ValueError) as error:
        if isinstance(error, MeshError):
            raise
        raise MeshError(f"{path}: cannot be read: {first_line(error)}") from None
    return reader.scene


class _StageReader:
    """What a walk over a stage has found: `scene`, and remarks on what it left out and why."""

    def __init__(self, path, stage, remarks):
        import trimesh
        from pxr import Usd, UsdGeom, UsdSkel

        self.usd, self.geom, self.skel = Usd, UsdGeom, UsdSkel
        self.path, self.stage, self.remarks = path, stage, remarks
        self.time = Usd.TimeCode.EarliestTime()
        if stage.HasAuthoredTimeCodeRange():
            self.time = Usd.TimeCode(stage.GetStartTimeCode())
        self.places = UsdGeom.XformCache(self.time)
        self.scene = trimesh.Scene()
        self._known: dict[tuple, str] = {}
        self._open: list[str] = []  # instancers that are being spread

    def visit(self, root, prefix, transform_of, undefined=False):
        """Add what lies under a prim, nodes named with a prefix, where `transform_of` each is, a matrix of USD.

        What is `undefined`, an "over" or of a class, is visited in prototypes alone, which such prims hide elsewhere.
        """
        geom, usd = self.geom, self.usd
        proxies = usd.TraverseInstanceProxies(*([usd.PrimIsActive & usd.PrimIsLoaded] if undefined else []))
        prims = iter(self.usd.PrimRange(root, proxies))
        for prim in prims:
            name = prefix + str(prim.GetPath())
            spreads = prim.IsA(geom.PointInstancer)
            shape, shown = spreads or prim.IsA(geom.Gprim), geom.Imageable(prim)
            purpose = shown.ComputePurpose() if shape else None
            hidden = bool(shown) and shown.GetVisibilityAttr().Get(self.time) == geom.Tokens.invisible
            if hidden or spreads:
                prims.PruneChildren()
            if hidden:  # and all under it
                below = self.usd.PrimRange(prim, proxies)
                if any(part.IsA(geom.Gprim) or part.IsA(geom.PointInstancer) for part in below):
                    self.remarks.add("left out", f"{name} (invisible)")
            elif shape and purpose not in SHOWN:
                self.remarks.add("left out", f"{name} (purpose {purpose})")
            elif spreads:
                self._spread(geom.PointInstancer(prim), name, transform_of(prim))
            elif shape:
                self._add(prim, name, transform_of(prim))

    def _add(self, prim, name, transform):
        import trimesh

        if prim.IsA(self.geom.Mesh):
            source = self.geom.Mesh(prim)
            found = read_usd_mesh(source, self.time, f"{self.path}: {prim.GetPath()}")
            if found is None:
                return
            vertices, faces = found
            self._remark_on(source, name)
            if source.GetOrientationAttr().Get(self.time) == self.geom.Tokens.leftHanded:
                faces = faces[:, ::-1]
        else:
            found = _make_shape(prim, self.time)
            if found is None:
                self.remarks.add("left out", f"{name} ({prim.GetTypeName()})")
                return
            vertices, faces = found
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        geometry = self._known.setdefault((mesh.vertices.tobytes(), mesh.faces.tobytes()), str(prim.GetPath()))
        self.scene.geometry.setdefault(geometry, mesh)
        self.scene.graph.update(name, geometry=geometry, matrix=np.array(transform).T)

    def _remark_on(self, mesh, name):
        """Remember what of a mesh is not carried out. One whose file is silent about subdivision is a polygon mesh."""
        scheme = mesh.GetSubdivisionSchemeAttr()
        if scheme.HasAuthoredValue() and scheme.Get() != "none":
            self.remarks.add("not subdivided:", f"{name} ({scheme.Get()})")
        skin = self.skel.BindingAPI(mesh.GetPrim())
        if skin.GetInheritedSkeleton() or skin.GetBlendShapeTargetsRel().HasAuthoredTargets():
            self.remarks.add("taken at rest:", f"{name} (skin or blend shapes)")

    def _spread(self, instancer, name, base):
        """Add the instances of a point instancer that are active and visible."""
        time, places, path = self.time, self.places, str(instancer.GetPath())
        if path in self._open:
            raise MeshError(f"{self.path}: {path}: it is under one of its own prototypes")
        self._open.append(path)
        targets = instancer.GetPrototypesRel().GetForwardedTargets()
        indices = instancer.GetProtoIndicesAttr().Get(time) or []
        wrong = next((index for index in indices if not 0 <= index < len(targets)), None)
        if wrong is not None:
            raise MeshError(f"{self.path}: {name}: an instance of prototype {wrong}, but there are {len(targets)}")
        ways = instancer.ComputeInstanceTransformsAtTime(time, time, instancer.IncludeProtoXform, instancer.IgnoreMask)
        if len(ways) != len(indices):
            raise MeshError(f"{self.path}: {name}: its {len(indices)} instances do not have a place each")
        shown = instancer.ComputeMaskAtTime(time) or [True] * len(indices)
        for k, (index, way) in enumerate(zip(indices, ways)):
            if not shown[k]:
                continue
            prototype = self.stage.GetPrimAtPath(targets[index])
            if not prototype:
                self.remarks.add("left out what refers to", str(targets[index]))
                continue
            root = places.GetLocalToWorldTransform(prototype).GetInverse()
            self.visit(
                prototype,
                f"{name}[{k}]",
                lambda prim, root=root, way=way: places.GetLocalToWorldTransform(prim) * root * way * base,
                undefined=True,
            )
        self._open.pop()


def _make_shape(prim, time):
    """Return vertices and faces of a Cube, Sphere, Cylinder, Cone, Capsule or Plane; None of any other kind."""
    from trimesh import creation

    def get(name):
        return prim.GetAttribute(name).Get(time)

    kind = prim.GetTypeName()
    if kind == "Plane":
        x, y = get("width") / 2 * np.array([-1, 1, 1, -1]), get("length") / 2 * np.array([-1, -1, 1, 1])
        flat = np.zeros(4)
        corners = {"X": [flat, y, -x], "Y": [x, flat, -y], "Z": [x, y, flat]}[get("axis")]
        return np.stack(corners, 1), np.array([[0, 1, 2], [0, 2, 3]])
    makers = {
        "Cube": lambda: creation.box(extents=[get("size")] * 3),
        "Sphere": lambda: creation.icosphere(subdivisions=SUBDIVISIONS, radius=get("radius")),
        "Cylinder": lambda: creation.cylinder(radius=get("radius"), height=get("height"), sections=SECTIONS),
        "Cone": lambda: creation.cone(radius=get("radius"), height=get("height"), sections=SECTIONS),
        "Capsule": lambda: creation.capsule(radius=get("radius"), height=get("height"), count=(SECTIONS, SECTIONS)),
    }
    if kind not in makers:
        return None
    mesh = makers[kind]()
    vertices = np.asarray(mesh.vertices, np.float64)
    # Of USD all have their middle at the origin.
    vertices = vertices - (vertices.min(0) + vertices.max(0)) / 2
    return vertices[:, AXIS_COLUMNS[get("axis") if prim.HasAttribute("axis") else "Z"]], np.asarray(mesh.faces)
