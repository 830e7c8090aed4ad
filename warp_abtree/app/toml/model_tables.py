"""The tables [models.NAME] of scene files: meshes, and generated shapes."""

import functools
import operator
from typing import Annotated, Any

from msgspec import Meta, defstruct

from warp_abtree.app.toml.fields import Count, NonEmpty, NotNegative, Positive, Sections, Table


class ModelTable(Table):
    """[models.NAME]: a mesh, a shape of SHAPES, or both, where the shape stands in where no mesh is found."""

    # Path from the scene file's folder, or "warp:bunny", "warp:bear", "warp:rocks"; of a list the first that is found.
    mesh: str | NonEmpty[str] | None = None
    size: Positive | None = None  # scales the longest extent to this length, or
    scale: Positive | None = None  # scales all coordinates
    centre: bool = False  # moves the middle of the box to the model's origin
    faces: Count | None = None  # brings the mesh to so many, or one less: by Loop subdivision and edge collapses
    base_faces: Count = 10  # faces of the coarsest LOD

    def __post_init__(self):
        if self.mesh is None and self.__struct_config__.tag is None:
            raise ValueError("give mesh or shape")
        if self.size is not None and self.scale is not None:
            raise ValueError("give size or scale, not both")

    def parameters(self) -> dict:
        """Return the parameters of the shape that the file gives, by name."""
        own = [name for name in self.__struct_fields__ if name not in ModelTable.__struct_fields__]
        return {name: getattr(self, name) for name in own if getattr(self, name) is not None}


Pair = tuple[Sections, Sections]
Cells = Annotated[int, Meta(ge=1, le=4096)]
# The parameters of each shape; those of trimesh have its names and defaults.
SHAPES: dict[str, dict] = {
    "box": {"extents": tuple[Positive, Positive, Positive]},
    "icosphere": {"subdivisions": Annotated[int, Meta(ge=0, le=8)], "radius": Positive},
    "uv_sphere": {"radius": Positive, "count": Pair},
    "cylinder": {"radius": Positive, "height": Positive, "sections": Sections},
    "cone": {"radius": Positive, "height": Positive, "sections": Sections},
    "capsule": {"radius": Positive, "height": Positive, "count": Pair},
    "annulus": {"r_min": Positive, "r_max": Positive, "height": Positive, "sections": Sections},
    "torus": {
        **{"major_radius": Positive, "minor_radius": Positive},
        **{"major_sections": Sections, "minor_sections": Sections},
    },
    # A trefoil tube; sections along it and around it.
    "knot": {"radius": Positive, "tube_radius": Positive, "sections": Pair},
    # An open sheet in a basin, y upwards; extents and cells along x and z, bumps and rim are heights.
    "terrain": {
        **{"extents": tuple[Positive, Positive], "cells": tuple[Cells, Cells]},
        **{"bumps": NotNegative, "waves": NotNegative, "rim": NotNegative},
    },
    # A threaded rod along z, its head of a width across the flats; sections around and along.
    "bolt": {"radius": Positive, "length": Positive, "pitch": Positive, "head": Positive, "sections": Pair},
    # A nut for a bolt of the same radius and pitch, of a width across the flats; sections around and along.
    "nut": {"radius": Positive, "height": Positive, "pitch": Positive, "width": Positive, "sections": Pair},
    # A profile of points [radius, z], z rising, turned about z.
    "revolve": {"profile": Annotated[list[tuple[Positive, float]], Meta(min_length=2)], "sections": Sections},
}
_TABLES = (
    defstruct(
        name,
        [(key, kind | None, None) for key, kind in parameters.items()],
        bases=(ModelTable,),
        tag_field="shape",
        tag=name,
    )
    for name, parameters in SHAPES.items()
)
AnyShape: Any = functools.reduce(operator.or_, _TABLES)
