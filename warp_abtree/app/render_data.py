"""Render data of a scene at one time: `compose` makes `RenderData` of a `Snapshot`, for viewer and pictures."""

from dataclasses import dataclass
from html import escape

import numpy as np

from warp_abtree.app import scene_geometry as geometry
from warp_abtree.app.cli.report import show_number
from warp_abtree.app.styles import COLOURS, to_bytes
from warp_abtree.query.result import Result
from warp_abtree.scene.scene import Scene
from warp_abtree.simulate.frame_row import FrameRow

NOWHERE = -2  # world of a place without an object
LEGEND = 24  # entries of one in HTML
LABELS = 32  # distances that are told in numbers, at most


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A scene at one time, and the result of its query."""

    number: int  # of the frame, from 0
    time: float  # in the scene [s]
    poses: np.ndarray  # x y z qx qy qz qw of every object, float64 (n, 7)
    lods: np.ndarray  # of every object, int32 (n,)
    result: Result  # of the query
    row: FrameRow | None  # of the frame; None where the scene was only queried again


@dataclass
class Settings:
    """Settings of what is shown."""

    world: int = 0  # objects of world -1 are in every one
    intersecting: bool = True  # whether intersecting faces are coloured
    by_lod: bool = False  # whether colours tell LODs in the place of models
    distances: bool = False  # whether distances are drawn between objects that do not meet
    contacts: bool = False  # whether contact points are drawn, objects see-through
    wireframe: bool = False  # whether edges are drawn in the place of faces
    selected: int | None = None  # object of whose AB-Tree boxes are drawn,
    tree_level: int = 0  # those of the active nodes at a level; 0 is the root

    @property
    def output(self) -> str:
        """The output that a query needs for it."""
        return "faces" if self.intersecting else "count"


@dataclass(eq=False)
class RenderData:
    """A snapshot as arrays in the world."""

    poses: np.ndarray  # of every object, float64 (n, 7)
    keys: np.ndarray  # `mesh_keys` of every object
    colours: np.ndarray  # of every object, uint8 (n, 3)
    intersecting: dict  # intersecting faces by model, float32 (t, 3, 3)
    shown: np.ndarray  # indices of the objects that are shown
    intersecting_count: int  # of faces, drawn or not
    pair_count: int  # of intersecting faces, drawn or not
    faces: int  # active faces of the shown objects together
    error_mean: float  # mean certified error of the shown objects [units]; NaN where that takes long
    nearest: np.ndarray  # nearest points of object pairs that are apart, float64 (k, 2, 3)
    distance: np.ndarray  # between them, float64 (k,)
    contacts: np.ndarray | None  # contact points, which objects are see-through for, float64 (k, 3)
    boxes: np.ndarray  # edges of the boxes of the selected object's AB-Tree, float64 (k, 2, 3)
    wireframe: bool  # whether edges are drawn in the place of faces

    def labels(self) -> list:
        """Return (point, text) of the least distances, at the middles of their segments."""
        told = np.argsort(self.distance, kind="stable")[:LABELS]
        return [(self.nearest[i].mean(axis=0), show_number(self.distance[i], 4)) for i in told]


def worlds_of(scene) -> np.ndarray:
    """Return the world of every object, int (n,), NOWHERE at a place without one; refuse what is no scene or empty."""
    if not isinstance(scene, Scene):
        raise TypeError(f"scene is a {type(scene).__name__}, not a Scene")
    if not scene.present.any():
        raise ValueError("the scene has no object")
    return np.where(scene.present, scene.worlds, NOWHERE)


def objects_of_world(worlds, world: int) -> np.ndarray:
    """Return the indices of the objects of a world; those of world -1 are in every one."""
    return np.flatnonzero((worlds == world) | (worlds == -1))


def objects_to_draw(worlds, world: int, where="") -> np.ndarray:
    """Return the indices of the objects of a world; raise ValueError where there is none, with `where` it is said."""
    objects = objects_of_world(worlds, world)
    if not len(objects):
        raise ValueError(f"{where}world: no object is in world {world}")
    return objects


def error_of(model, lod: int) -> float:
    """Return the certified error of a LOD, NaN where certifying the model would take long."""
    if lod == model.lod_max:
        return 0.0
    return model.error_at(lod) if model.face_count <= geometry.CERTIFIED_FACES else np.nan


def compose(cache: geometry.MeshCache, snapshot: Snapshot, shown, settings: Settings) -> RenderData:
    """Return what to draw of the objects that are shown, whose indices rise."""
    scene, result = cache.scene, snapshot.result
    inside = np.zeros(scene.object_count, bool)
    inside[shown] = True
    intersecting = geometry.intersecting_faces(result, inside)
    keys = geometry.mesh_keys(scene, snapshot.lods)
    distinct, repeats = np.unique(keys[shown], return_counts=True)
    meshes = [(*geometry.split_key(key), n) for key, n in zip(distinct.tolist(), repeats.tolist())]
    pairs = inside[result.pairs].all(axis=1)
    chosen, level = settings.selected, settings.tree_level
    nearest, distance = geometry.nearest_points(scene, shown, result) if settings.distances else geometry.NO_SEGMENTS
    return RenderData(
        poses=snapshot.poses,
        keys=keys,
        colours=geometry.object_colours(scene, snapshot.lods, settings.by_lod),
        intersecting=geometry.intersecting_triangles(cache, snapshot, intersecting) if settings.intersecting else {},
        shown=shown,
        intersecting_count=len(intersecting),
        pair_count=int(result.count[pairs].sum()) if result.count is not None else 0,
        faces=sum(scene.models[model].progressive.active_count(lod) * n for model, lod, n in meshes),
        error_mean=sum(error_of(scene.models[model], lod) * n for model, lod, n in meshes) / max(len(shown), 1),
        nearest=nearest,
        distance=distance,
        contacts=geometry.contact_points(cache, shown) if settings.contacts else None,
        boxes=geometry.NO_SEGMENTS[0] if chosen is None else geometry.tree_boxes(scene, snapshot, chosen, level),
        wireframe=settings.wireframe,
    )


def make_legend(scene: Scene, panels: list[RenderData], by_lod=False) -> list:
    """Return (colour, label) of what panels of one scene show; a model of one object goes by that one's given name."""
    shown = panels[0].shown
    legend: list = [(geometry.COARSE, "coarsest LOD"), (geometry.FINE, "finest LOD")] if by_lod and len(shown) else []
    models, first, counts = np.unique(np.array(scene.object_model)[shown], return_index=True, return_counts=True)
    for model, i, count in sorted(zip(models.tolist(), shown[first].tolist(), counts.tolist()), key=lambda row: row[1]):
        plain, bright = COLOURS[model % len(COLOURS)]
        name = scene.models[model].name
        if count == 1 and scene.name(i) != f"{name} {i}":
            name = scene.name(i)
        legend += [] if by_lod else [(plain, name)]
        if any(model in data.intersecting for data in panels):
            legend.append((bright, f"{name}, intersecting"))
    return legend


def legend_html(entries) -> str:
    """Return a legend of `make_legend` in HTML."""
    entry = "<span style='white-space:nowrap;margin-right:1em'><span style='color:rgb{}'>&#9632;</span> {}</span> "
    lines = [entry.format(to_bytes(colour), escape(label)) for colour, label in entries[:LEGEND]]
    more = f"and {len(entries) - LEGEND:,} more" if len(entries) > LEGEND else ""
    return f"<div style='margin:0 1em 0.5em;font-size:0.85em'>{''.join(lines)}{more}</div>"
