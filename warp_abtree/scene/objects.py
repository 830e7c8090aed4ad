"""Objects as a scene was told of them: checked, and kept on the host until the device's arrays are made."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import flag, to_numpy, whole_number
from warp_abtree.model.model import Model
from warp_abtree.model.winding import check_solid
from warp_abtree.query.broad_phase import EVERY_WORLD
from warp_abtree.state.poses import launch_place

ALL_BITS = 2**32 - 1
HOLE_LEAST = 2.0**-99  # edge of what is left of an object that was removed: models may not be smaller


@dataclass
class ObjectList:
    """The objects of a scene: `models` without repeats, and lists with an entry a place."""

    models: list[Model] = field(default_factory=list)
    model: list[int] = field(default_factory=list)  # index into models
    name: list[str] = field(default_factory=list)  # another list where one changes: results keep what they had
    world: list[int] = field(default_factory=list)
    lod: list[int] = field(default_factory=list)
    importance: list[int] = field(default_factory=list)
    static: list[bool] = field(default_factory=list)
    solid: list[bool] = field(default_factory=list)
    group: list[int] = field(default_factory=list)
    mask: list[int] = field(default_factory=list)
    pose: list[np.ndarray] = field(default_factory=list)  # (7,) or (4, 4)
    place: dict[int, int] = field(default_factory=dict)  # index into models, by identity
    free: list[int] = field(default_factory=list)  # places without an object, rising
    hole: Model | None = None  # of these

    def __len__(self):
        return len(self.model)

    def extend(self, models: list[Model], columns: dict[str, list]) -> np.ndarray:
        """Put objects into free places and append the rest, wholly or not at all; return their places.

        `columns` has the other lists by name, an entry an object.
        """
        count, known, taken = len(self), len(self.models), self.free[: len(models)]
        places = [*taken, *range(count, count + len(models) - len(taken))]
        told = zip(columns["name"], models, places)
        columns["name"] = [f"{model.name} {i}" if name is None else name for name, model, i in told]
        try:
            for model in models:
                if id(model) not in self.place:
                    self.models.append(model)
                    self.place[id(model)] = len(self.models) - 1
            columns["model"] = [self.place[id(model)] for model in models]
            for name, values in columns.items():
                getattr(self, name).extend(list(values)[len(taken) :])
            if taken:
                lists = self._written(taken, columns)
                vars(self).update(lists | _without_unused(self.models, lists["model"]), free=self.free[len(taken) :])
        except BaseException:
            for name in ("model", *columns):
                del getattr(self, name)[count:]
            del self.models[known:]
            self.place = {id(model): i for i, model in enumerate(self.models)}
            raise
        return np.array(places, np.int64)

    def change(self, i: int, columns: dict[str, list]):
        """Change lists at one place, wholly or not at all."""
        vars(self).update(self._written([i], columns))

    def remove(self, places: list[int]):
        """Take objects out of their places, wholly or not at all.

        What is left there is static, meets nothing, and has one triangle.
        """
        hole, models = self.hole, list(self.models)
        if hole is None:
            size = float(np.ptp(models[self.model[places[0]]].mesh_at(0)[0], axis=0).max())
            edge = max(size / 1024, HOLE_LEAST)
            hole = Model.from_arrays(np.eye(3) * edge, np.array([[0, 1, 2]]), name="removed")
        if id(hole) not in self.place:
            models.append(hole)
        left: dict[str, Any] = {"name": "removed", "model": self.place.get(id(hole), len(self.models)), "lod": 0}
        left |= {"importance": 1, "static": True, "solid": False, "group": 0, "mask": 0}
        lists = self._written(places, {name: [value] * len(places) for name, value in left.items()})
        lists |= _without_unused(models, lists["model"])
        vars(self).update(lists, hole=hole, free=sorted([*self.free, *places]))

    def _written(self, places: list[int], columns: dict[str, list]) -> dict[str, list]:
        """Return copies of lists, by name, with other values at some places: one step puts them all in place."""
        copies = {name: list(getattr(self, name)) for name in columns}
        for name, values in columns.items():
            for i, value in zip(places, values):
                copies[name][i] = value
        return copies

    def collision_bits(self) -> np.ndarray:
        """Return collision group and mask of each object, uint32 (n, 2); (0, 2) where they keep no pair apart."""
        bits = np.array([self.group, self.mask], np.uint32).T
        return bits if (bits != (1, ALL_BITS)).any() else bits[:0]

    def set_poses(self, pool, device):
        """Set the objects of a pool: the device turns quaternions into matrices, matrices are taken as they are."""
        matrix = np.array([pose.ndim == 2 for pose in self.pose])
        rows = np.zeros((len(self), 7))
        rows[:, 6] = 1.0
        if not matrix.all():
            rows[~matrix] = [pose for pose in self.pose if pose.ndim == 1]
        launch_place(wp.array(rows, dtype=wp.float64, device=device), pool)
        if matrix.any():
            rotation, position = pool.rotation.numpy(), pool.position.numpy()
            stacked = np.array([pose for pose in self.pose if pose.ndim == 2])
            rotation[matrix], position[matrix] = stacked[:, :3, :3], stacked[:, :3, 3]
            pool.rotation.assign(rotation)
            pool.position.assign(position)


def _without_unused(models: list[Model], model: list[int]) -> dict[str, Any]:
    """Return the lists of `ObjectList` about models, without those that no place has."""
    used = sorted(set(model))
    if len(used) < len(models):
        number = {old: new for new, old in enumerate(used)}
        models, model = [models[k] for k in used], [number[k] for k in model]
    return {"models": models, "model": model, "place": {id(one): i for i, one in enumerate(models)}}


def check_models(models, count: int) -> list[Model]:
    """Return the model of each of a number of objects: one for all of them, or a list.

    Raises TypeError where one is no Model, and ValueError for another number of them.
    """
    listed = [models] * count if isinstance(models, Model) or not isinstance(models, list | tuple) else list(models)
    for model in listed:
        if not isinstance(model, Model):
            raise TypeError(f"model is a {type(model).__name__}, not a Model: Model.load makes one")
    if len(listed) != count:
        raise ValueError(f"models: {len(listed)} given for {count} poses")
    return listed


def check_lods(lods, models: list[Model]) -> list[int]:
    """Return the LOD of each object, the finest of its model for None; raise ValueError for bad ones."""
    if lods is None or _is_one(lods):
        return [model.lod_max if lods is None else model.check_lod(lods) for model in models]
    return list(map(Model.check_lod, models, check_numbers(lods, "lod", 0, 2**31 - 1, len(models))))


def _is_one(values) -> bool:
    return len(getattr(values, "shape", (1,) if isinstance(values, list | tuple) else ())) == 0


def check_numbers(values, what: str, low: int, high: int, count: int) -> list[int]:
    """Return whole numbers from low to high: one for all objects, or (count,); raise ValueError for others."""
    if _is_one(values):
        return [whole_number(values, what, low, high)] * count
    numbers = to_numpy(values, f"{what}s")
    if numbers.shape != (count,):
        raise ValueError(f"{what}s: shape {numbers.shape} given for {count} objects")
    bad = np.flatnonzero(~((numbers >= low) & (numbers <= high) & (numbers == np.floor(numbers))))
    if len(bad):
        whole_number(numbers[bad[0]].item(), f"{what}s[{bad[0]}]", low, high)
    return numbers.astype(np.int64).tolist()


def check_bools(values, what: str, count: int) -> list[bool]:
    """Return bools: one for all objects, or (count,); raise ValueError for another shape or type."""
    try:
        flags = np.asarray(values)
    except ValueError:  # lists of several lengths
        flags = np.empty(())
    if flags.ndim == 0 or flags.dtype != bool:
        return [flag(values, what)] * count
    if flags.shape != (count,):
        raise ValueError(f"{what}s: shape {flags.shape} given for {count} objects")
    return flags.tolist()


def check_object_names(names, count: int) -> list[str | None]:
    """Return names: None for all objects, or (count,); raise ValueError for other than strings with a character."""
    if isinstance(names, str) or not (names is None or np.iterable(names)):
        raise ValueError(f"names: {names!r} is no list of strings")
    listed = [None] * count if names is None else list(names)
    if len(listed) != count:
        raise ValueError(f"names: {len(listed)} given for {count} objects")
    for name in listed:
        if name is not None and not (isinstance(name, str) and name):
            raise ValueError(f"name {name!r} is no string with a character")
    return [None if name is None else str(name) for name in listed]


def check_columns(models, name, world, importance, static, solid, group, mask) -> dict[str, list]:
    """Return the columns of `ObjectList` for objects of these models.

    Raises MeshError for a solid whose mesh is not closed, and ValueError for another number or what is out of range.
    """
    count = len(models)
    columns: dict[str, list] = {
        "name": check_object_names(name, count),
        "world": check_numbers(world, "world", EVERY_WORLD, 2**31 - 1, count),
        "importance": check_numbers(importance, "importance", 1, 3, count),
        "static": check_bools(static, "static", count),
        "solid": check_bools(solid, "solid", count),
        "group": check_numbers(group, "collision_group", 0, ALL_BITS, count),
        "mask": check_numbers(mask, "collision_mask", 0, ALL_BITS, count),
    }
    for model in {id(model): model for model, solid in zip(models, columns["solid"]) if solid}.values():
        check_solid(model.winding, model.name)
    return columns
