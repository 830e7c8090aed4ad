"""The tables [models.NAME] of scene files: meshes, and generated shapes."""

import itertools
from typing import Annotated, Any

from msgspec import Meta

from warp_abtree.app.toml.fields import Count, NonEmpty, NotNegative, Positive, Sections, Table


class ModelTable(Table):
    """[models.NAME] without a shape. With both a mesh and a shape, the shape stands in where no mesh is found."""

    # Path from the scene file's folder, or "warp:bunny", "warp:bear", "warp:rocks"; of a list the first that is found.
    mesh: str | NonEmpty[str] | None = None
    size: Positive | None = None  # scales the longest extent to this length, or
    scale: Positive | None = None  # scales all coordinates
    centre: bool = False  # moves the middle of the box to the model's origin
    faces: Count | None = None  # brings the mesh to so many, or one less: by Loop subdivision and edge collapses
    base_faces: Count = 10  # faces of the coarsest LOD

    def __post_init__(self):
        if self.mesh is None and not isinstance(self, Shape):
            raise ValueError("give mesh or shape")
        if self.size is not None and self.scale is not None:
            raise ValueError("give size or scale, not both")


class Shape(ModelTable, tag_field="shape"):
    """[models.NAME] with a shape; an optional parameter has the default of trimesh."""

    def parameters(self) -> dict[str, Any]:
        """Return the parameters of the shape that the file gives."""
        own = [name for name in self.__struct_fields__ if name not in ModelTable.__struct_fields__]
        return {name: getattr(self, name) for name in own if getattr(self, name) is not None}


class Box(Shape, tag="box"):
    """A box."""

    extents: tuple[Positive, Positive, Positive] | None = None


class Icosphere(Shape, tag="icosphere"):
    """A subdivided icosahedron."""

    subdivisions: Annotated[int, Meta(ge=0, le=8)] | None = None
    radius: Positive | None = None


class UvSphere(Shape, tag="uv_sphere"):
    """A sphere of latitudes and longitudes."""

    radius: Positive | None = None
    count: tuple[Sections, Sections] | None = None


class Cylinder(Shape, tag="cylinder", kw_only=True):
    """A cylinder along z."""

    radius: Positive
    height: Positive
    sections: Sections | None = None


class Cone(Shape, tag="cone", kw_only=True):
    """A cone along z."""

    radius: Positive
    height: Positive
    sections: Sections | None = None


class Capsule(Shape, tag="capsule"):
    """A capsule along z."""

    radius: Positive | None = None
    height: Positive | None = None  # between the middles of its ends
    count: tuple[Sections, Sections] | None = None


class Annulus(Shape, tag="annulus", kw_only=True):
    """A tube along z with a thick wall."""

    r_min: Positive
    r_max: Positive
    height: Positive
    sections: Sections | None = None


class Torus(Shape, tag="torus", kw_only=True):
    """A torus about z."""

    major_radius: Positive
    minor_radius: Positive
    major_sections: Sections | None = None
    minor_sections: Sections | None = None


class Knot(Shape, tag="knot", kw_only=True):
    """A trefoil tube."""

    radius: Positive
    tube_radius: Positive
    sections: tuple[Sections, Sections]  # along the tube, around it


class Terrain(Shape, tag="terrain", kw_only=True):
    """An open sheet in a basin, y upwards."""

    extents: tuple[Positive, Positive]  # along x and z
    cells: tuple[Annotated[int, Meta(ge=1, le=4096)], Annotated[int, Meta(ge=1, le=4096)]]
    bumps: NotNegative  # height
    waves: NotNegative  # of the bumps across the sheet
    rim: NotNegative  # height


class Bolt(Shape, tag="bolt", kw_only=True):
    """A threaded rod along z with a hexagonal head."""

    radius: Positive
    length: Positive
    pitch: Positive
    head: Positive  # width across the flats
    sections: tuple[Sections, Sections]  # around, along


class Nut(Shape, tag="nut", kw_only=True):
    """A hexagonal nut for a bolt of the same radius and pitch."""

    radius: Positive
    height: Positive
    pitch: Positive
    width: Positive  # across the flats
    sections: tuple[Sections, Sections]  # around, along


class Revolve(Shape, tag="revolve", kw_only=True):
    """A profile turned about z."""

    profile: Annotated[list[tuple[Positive, float]], Meta(min_length=2)]  # points [radius, z], z rising
    sections: Sections

    def __post_init__(self):
        super().__post_init__()
        heights = [z for _, z in self.profile]
        if any(after <= before for before, after in itertools.pairwise(heights)):
            raise ValueError("profile: z does not rise")


AnyShape = (
    Box | Icosphere | UvSphere | Cylinder | Cone | Capsule | Annulus | Torus | Knot | Terrain | Bolt | Nut | Revolve
)
