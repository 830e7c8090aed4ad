"""Every table of a scene file: a struct is a table, a field is a key with its type and limits; other keys are refused.

Lengths are in the scene's units, angles in degrees, times in seconds. `SceneTable` is the whole file:

    [scene]
    title = "Two balls"
    [models.ball]
    shape = "icosphere"
    [[objects]]
    model = "ball"
    worlds = 16
"""

import functools
import math
import operator
from typing import Annotated, Any, Literal, TypeVar, get_args

import numpy as np
from msgspec import Meta, Struct, defstruct, field
from msgspec.structs import replace

from warp_abtree.app.scene_view import make_view
from warp_abtree.app.toml.objects import OBJECT_LIMIT, unit
from warp_abtree.lod.view import Camera
from warp_abtree.scene.objects import ALL_BITS

T = TypeVar("T")
Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Fraction = Annotated[float, Meta(gt=0, le=1)]
Share = Annotated[float, Meta(ge=1e-9, le=1)]  # of the faces: quotients of two stay finite
Span = Annotated[float, Meta(ge=1e-9, le=1e9)]  # of time [s]
Count = Annotated[int, Meta(ge=1, le=2**31 - 1)]
Bits = Annotated[int, Meta(ge=0, le=ALL_BITS)]
Cells = Annotated[int, Meta(ge=0, le=OBJECT_LIMIT)]
Copies = Annotated[int, Meta(ge=1, le=OBJECT_LIMIT)]
TerrainCells = Annotated[int, Meta(ge=1, le=4096)]
Sections = Annotated[int, Meta(ge=3, le=10_000)]
NonEmpty = Annotated[list[T], Meta(min_length=1)]
Panels = Annotated[list[Fraction], Meta(min_length=1, max_length=64)]
Vector = tuple[float, float, float]
ORIGIN = (0.0, 0.0, 0.0)


class Table(Struct, forbid_unknown_fields=True):
    """What all tables share."""


def check_direction(key, vector):
    """Refuse a direction of no length."""
    if vector is not None and not any(vector):
        raise ValueError(f"{key}: a direction of no length")


class HeadTable(Table):
    """[scene]"""

    title: str | None = None  # the file's name without its suffix by default
    frames: Count = 60  # that `run` makes
    time_step: Span = 1 / 60  # between frames
    seed: Annotated[int, Meta(ge=0, le=2**31 - 1)] = 0  # of everything under `random`


# Models.


class ModelTable(Table):
    """[models.NAME]: a mesh, a shape of SHAPES, or both, where the shape stands in where no mesh is found."""

    # Path from the scene file's folder, or "warp:bunny", "warp:bear", "warp:rocks"; of a list the first that is found.
    mesh: str | NonEmpty[str] | None = None
    size: Positive | None = None  # scales the longest extent to this length, or
    scale: Positive | None = None  # scales all coordinates
    centre: bool = False  # moves the middle of the box to the model's origin
    faces: Count | None = None  # brings the mesh to so many, or one less: by Loop subdivision and edge collapses
    base_faces: Count = 10  # faces of the coarsest LOD
    orient: bool = False  # turns faces that disagree with their neighbours or face inwards

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
        **{"extents": tuple[Positive, Positive], "cells": tuple[TerrainCells, TerrainCells]},
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


# Objects.


class RotationTable(Table):
    """rotation of [[objects]]: an axis with an angle, or a quaternion."""

    axis: Vector | None = None
    degrees: float | None = None
    quaternion: tuple[float, float, float, float] | None = None  # x, y, z, w

    def __post_init__(self):
        if (self.quaternion is None) == (self.axis is None):
            raise ValueError("give axis and degrees, or quaternion")
        if (self.degrees is None) != (self.axis is None):
            raise ValueError(f"the key {'axis' if self.axis is None else 'degrees'!r} is missing")
        check_direction("axis", self.axis)
        if self.quaternion is not None and not abs(math.hypot(*self.quaternion) - 1) <= 1e-3:
            raise ValueError(f"quaternion: its norm is {math.hypot(*self.quaternion):.6g}, off 1 by more than 1e-3")


class TurnTable(Table, kw_only=True):
    """turn of [[objects]]: a steady rotation about the object's origin."""

    axis: Vector
    degrees: float  # a second

    def __post_init__(self):
        check_direction("axis", self.axis)


class ShuttleTable(Table, kw_only=True):
    """shuttle of [[objects]]: there and back."""

    by: Vector
    period: Positive
    phase: float = 0.0  # in periods


class GridTable(Table):
    """grid of [[objects]]: copies on a grid around the position.

    Along an axis of size 0 it grows from the position, layer by layer, with `count`.
    """

    size: tuple[Cells, Cells, Cells]
    spacing: Vector


class RandomTable(Table):
    """random of [[objects]]: seeded, each copy its own, up to so much."""

    position: tuple[NotNegative, NotNegative, NotNegative] = ORIGIN  # along each axis, to both sides
    rotation: bool = False
    velocity: NotNegative = 0.0  # in any direction
    turn: NotNegative | None = None  # degrees a second about any axis
    phase: bool = False  # of the shuttle


class ObjectTable(Table, kw_only=True):
    """[[objects]]: one object, or many."""

    model: str | NonEmpty[str]  # of a list each in turn
    name: str | None = None  # in results, of several the second and later ones with a number, and for lod_sweep
    position: Vector = ORIGIN
    rotation: RotationTable | None = None
    world: Annotated[int, Meta(ge=-1, le=2**30)] = 0  # objects of different worlds never meet; -1 is in every world
    static: bool = False  # static objects never meet each other
    solid: bool = False  # what lies inside it intersects it; of a closed model
    kinematic: bool = False  # with [dynamics]: moves as told, and pushes
    # Bits: objects a and b may meet where group a & mask b and group b & mask a are not 0.
    collision_group: Bits = 1
    collision_mask: Bits = ALL_BITS
    importance: Annotated[int, Meta(ge=1, le=3)] = 1  # 1 (most), 2 or 3, for the selection of LODs
    # A number with a decimal point is a fraction of the faces; a whole number, "finest", "coarsest" or "tol:0.01"; of a
    # list each in turn.
    lod: int | float | str | NonEmpty[int | float | str] = "finest"
    velocity: Vector = ORIGIN
    turn: TurnTable | None = None
    shuttle: ShuttleTable | None = None
    count: Copies | None = None  # copies in the same world
    grid: GridTable | None = None
    worlds: Copies = 1  # and all of them once in each of so many worlds
    random: RandomTable = field(default_factory=RandomTable)

    def __post_init__(self):
        if self.static and self.kinematic:
            raise ValueError("kinematic: a static object does not move")
        if self.world < 0 and self.worlds > 1:
            raise ValueError("worlds: the world -1 is every world already")
        if self.grid is not None and self.grid.size.count(0) != (self.count is not None):
            raise ValueError("give count or grid, not both, unless the size of the grid is 0 along one axis")

    def multiply(self, key: str, factor: float) -> "ObjectTable":
        """Return the entry with a number of copies multiplied, 1 at the least."""
        return replace(self, **{key: max(1, round(factor * getattr(self, key)))})


# LODs.


class SweepTable(Table, kw_only=True):
    """[[lod_sweep]]: fine to coarse and back, in equal ratios."""

    model: str | None = None  # all objects of a model, or
    objects: str | NonEmpty[str] | None = None  # those of these names
    start: Share = field(name="from")
    turn: Share = field(name="to")
    period: Span  # there and back

    def __post_init__(self):
        if (self.model is None) == (self.objects is None):
            raise ValueError("give one of model and objects")


ControllerName = Literal["predictive", "paper", "tolerance"]
Spacing = Literal["ratio", "operations"]


class LodTable(Table):
    """[lod]: a controller chooses LODs, in the place of sweeps."""

    controller: ControllerName | None = None  # "predictive" where a budget is given, else "tolerance"
    budget_ms: Positive | None = None  # T: selection, refinement, broad phase and query of a frame [ms]
    tolerance: NotNegative | None = None  # error of an important, still object at the eye
    steps: Annotated[int, Meta(ge=1, le=10_000)] | None = None  # levels of the LOD ladder above the coarsest
    spacing: Spacing | None = None  # of the levels; not for "paper"
    window: Annotated[int, Meta(ge=1, le=1000)] | None = None  # frames over which motion on the screen is measured
    threshold_ms: Positive | None = None  # paper: t; a tenth of the budget by default
    aim: Fraction | None = None  # predictive: fraction of the budget to aim at,
    low: Fraction | None = None  # below which LODs rise,
    hold_frames: Annotated[int, Meta(ge=0, le=2**30)] | None = None  # after so many frames
    loosest: Annotated[float, Meta(ge=1)] | None = None  # predictive, tolerance: most that a tolerance is loosened

    def __post_init__(self):
        if self.controller == "paper" and self.spacing is not None:
            raise ValueError("spacing: the LODs of the paper's controller are equal numbers of operations apart")
        if not (self.low or 0.0) <= (self.aim or 1.0):
            raise ValueError("low: is above aim")
        if self.controller is None and self.budget_ms is None and self.tolerance is None:
            raise ValueError("give budget_ms or tolerance")


class CameraKeyTable(Table, kw_only=True):
    """[[camera.keys]]: the camera goes straight from one key to the next."""

    time: float = 0.0
    eye: Vector
    target: Vector


class CameraTable(Table):
    """[camera]: the viewer that LODs are chosen for; near, still objects come first. Give eye and target, or keys.

    Called with a time [s], returns a `Camera`: it goes straight from one key to the next, and stands still before the
    first and after the last.
    """

    eye: Vector | None = None
    target: Vector | None = None
    up: Vector | None = None  # against gravity by default, without it y
    field_of_view: Annotated[float, Meta(ge=1, le=170)] = 60.0  # vertical
    size: tuple[Annotated[int, Meta(ge=1, le=2**20)], Annotated[int, Meta(ge=1, le=2**20)]] = (1920, 1080)  # pixels
    far: Positive = 100.0  # how far one sees: D of the paper
    loop: bool = False  # whether the keys begin again
    keys: list[CameraKeyTable] = field(default_factory=list)

    def __post_init__(self):
        check_direction("up", self.up)
        if not self.keys:
            if self.eye is None or self.target is None:
                raise ValueError(f"the key {'eye' if self.eye is None else 'target'!r} is missing")
            self.keys = [CameraKeyTable(eye=self.eye, target=self.target)]
        elif self.eye is not None or self.target is not None:
            raise ValueError("give eye and target, or [[camera.keys]], not both")
        times = [key.time for key in self.keys]
        for i, time in enumerate(times):
            if i and not time > times[i - 1]:
                raise ValueError(f"keys[{i}].time: {time} is not after the one before, {times[i - 1]}")

    def __call__(self, time: float) -> Camera:
        times = [key.time for key in self.keys]
        if self.loop and times[-1] > times[0]:
            time = times[0] + (time - times[0]) % (times[-1] - times[0])
        eye, target = (
            [np.interp(time, times, line) for line in zip(*points)]
            for points in ([key.eye for key in self.keys], [key.target for key in self.keys])
        )
        return self.look(eye, target)

    def look(self, eye, target) -> Camera:
        """Return the camera at a point that looks at another."""
        angle = math.radians(self.field_of_view)
        return Camera.look_at(eye, target, unit(self.up), field_of_view=angle, size=self.size, far=self.far)


class DynamicsTable(Table):
    """[dynamics]: objects that are neither static nor kinematic are rigid bodies; velocity and turn start them."""

    friction: NotNegative = 0.5
    gravity: Vector = (0.0, -9.81, 0.0)
    continuous: bool = False  # surfaces that are apart stay apart, however fast; of rigid bodies alone


class PictureTable(Table):
    """[picture]: for `run --picture`, and where `view` and `picture` look from."""

    eye: Vector | None = None  # direction from the scene to the eye; by default from the front, right and above
    up: Vector | None = None  # that of the camera by default, else against gravity, without it y
    world: Annotated[int, Meta(ge=0, le=2**31 - 1)] = 0  # the world drawn
    time: float | None = None  # the last frame by default, which rigid bodies always show
    lods: Fraction | Panels | None = None  # of swept objects, a panel each; by default both ends


class SceneTable(Table, kw_only=True):
    """The whole file."""

    scene: HeadTable = field(default_factory=HeadTable)
    models: dict[str, dict]  # each is a `ModelTable` or a `Shape`
    objects: list[ObjectTable] = field(default_factory=list)
    lod_sweep: list[SweepTable] = field(default_factory=list)
    lod: LodTable | None = None
    camera: CameraTable | None = None
    dynamics: DynamicsTable | None = None
    picture: PictureTable = field(default_factory=PictureTable)

    def __post_init__(self):
        if self.dynamics is not None and self.picture.time is not None:
            raise ValueError("picture.time: rigid bodies are drawn as the last frame leaves them")
        self._set_up_directions()

    def _set_up_directions(self):
        """Give camera and picture the directions that the file does not."""
        gravity = np.array(ORIGIN if self.dynamics is None else self.dynamics.gravity)
        up, camera, picture = tuple(-gravity) if gravity.any() else (0.0, 1.0, 0.0), self.camera, self.picture
        if camera is not None:
            up = camera.up = camera.up or up
            try:
                for key in camera.keys:
                    camera.look(key.eye, key.target)
            except ValueError as error:
                raise ValueError(f"camera: {error}") from None
        try:
            view = make_view(picture.up or up, picture.eye)
        except ValueError as error:
            raise ValueError(f"picture.{error}") from None
        picture.eye, picture.up = tuple(view.eye), tuple(view.up)


# Keys whose values are names, and the names.
CHOICES = {"controller": get_args(ControllerName), "spacing": get_args(Spacing), "shape": tuple(SHAPES)}
