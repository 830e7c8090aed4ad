"""Objects of scene files: the copies that an entry of [[objects]] stands for, and how each moves."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_abtree.app.toml.errors import SceneError, fail

OBJECT_LIMIT = 1_000_000  # of a file; an object takes 1 KB


def unit(vector) -> np.ndarray:
    """Return the direction of a vector that is not 0, of length 1."""
    vector = np.array(vector) / np.abs(vector).max()  # no square overflows or underflows
    return vector / np.linalg.norm(vector)


@dataclass(eq=False)
class ObjectGroup:
    """The objects of one entry; arrays have a row each."""

    key: str  # of the entry in its file
    table: Any  # `ObjectTable`
    world: np.ndarray  # int (n,)
    motion: dict  # arguments of `Kinematic`
    kinematic: np.ndarray  # whether it moves as told among rigid bodies, bool (n,)


def make_group(path, key: str, table, dynamics, rng, room: int) -> ObjectGroup:
    """Lay out the copies of the entry `key`, an `ObjectTable`; `rng` draws what is random.

    Raises SceneError for more copies than there is room for, or keys of rigid bodies where there are none.
    """
    if dynamics is None:
        if table.kinematic:
            fail(path, f"{key}.kinematic", "the scene has no [dynamics]")
    elif not table.static and not table.kinematic and table.shuttle is not None:
        fail(path, f"{key}.shuttle", "a rigid body goes its own way; kinematic = true lets it shuttle")
    layer = 1 if table.grid is None else math.prod(n for n in table.grid.size if n)
    if max(table.count or 1, layer) * table.worlds > room:
        cause = "worlds" if table.worlds > 1 else "grid.size" if layer > 1 else "count" if table.count else "model"
        fail(path, f"{key}.{cause}", f"more than {OBJECT_LIMIT:,} objects in all")
    offsets = _copy_offsets(table)
    count = len(offsets) * table.worlds
    motion = {
        "position": np.tile(offsets + table.position, (table.worlds, 1)),
        "rotation": np.tile(_quaternion(table.rotation), (count, 1)),
        "velocity": np.tile(table.velocity, (count, 1)),
        "axis": np.tile([0.0, 0.0, 1.0], (count, 1)),
        "shuttle": np.zeros((count, 3)),
        "period": np.full(count, np.inf),
        "rate": np.zeros(count),
        "phase": np.zeros(count),
    }
    if table.turn is not None:
        motion["axis"][:], motion["rate"][:] = unit(table.turn.axis), math.radians(table.turn.degrees)
    if table.shuttle is not None:
        motion["shuttle"][:], motion["period"][:] = table.shuttle.by, table.shuttle.period
        motion["phase"][:] = table.shuttle.phase
    _scatter(table.random, motion, rng)
    world = np.repeat(np.arange(table.world, table.world + table.worlds), len(offsets))
    return ObjectGroup(key, table, world, motion, np.full(count, table.kinematic))


def _quaternion(rotation) -> np.ndarray:
    """Return the quaternion x y z w of a `RotationTable`, or of None."""
    if rotation is None:
        return np.array([0.0, 0.0, 0.0, 1.0])
    if rotation.quaternion is not None:
        return np.array(rotation.quaternion)
    half = math.radians(rotation.degrees) / 2
    return np.append(unit(rotation.axis) * math.sin(half), math.cos(half))


def _copy_offsets(table) -> np.ndarray:
    """Return the offset of every copy within one world, (count, 3)."""
    count, grid = table.count, table.grid
    if grid is None:
        return np.zeros((count or 1, 3))
    size, spacing = np.array(grid.size), np.array(grid.spacing)
    grows = size == 0
    layer = math.prod(size[~grows].tolist())
    if count is not None:
        size = np.where(grows, -(-count // layer), size)
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in size), indexing="ij"), axis=-1).reshape(-1, 3)
    if count is not None:
        cells = cells[np.argsort(cells[:, grows][:, 0], kind="stable")][:count]
    return (cells - np.where(grows, 0, (size - 1) / 2)) * spacing


def _scatter(table, motion, rng):
    """Add what a `RandomTable` asks for; always draw the same numbers, so that one key does not change another."""
    count = len(motion["position"])
    box = rng.uniform(-1, 1, (count, 3))
    direction, axis, rotation = (
        vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
        for vectors in (rng.normal(size=(count, width)) for width in (3, 3, 4))
    )
    speed, rate, phase = rng.uniform(0, 1, (3, count))
    motion["position"] += box * table.position
    motion["velocity"] += direction * (speed * table.velocity)[:, None]
    if table.rotation:
        motion["rotation"][:] = rotation
    if table.turn is not None:
        motion["axis"][:], motion["rate"][:] = axis, rate * math.radians(table.turn)
    if table.phase:
        motion["phase"][:] = phase


def make_groups(path, tables, dynamics, seed: int, objects: int | None = None) -> list[ObjectGroup]:
    """Lay out all entries of [[objects]], what is random by a seed; `objects` as for `load_scene`."""

    def make(tables):
        made, room = [], OBJECT_LIMIT
        for i, table in enumerate(tables):
            made.append(make_group(path, f"objects[{i}]", table, dynamics, np.random.default_rng([seed, i]), room))
            room -= len(made[-1].world)
        return made

    groups = make(tables)
    if objects is None:
        return groups
    keys = ["worlds" if table.worlds > 1 else "count" for table in tables]
    scaled = [
        len(group.world) if (getattr(table, key) or 1) > 1 else 0 for group, key, table in zip(groups, keys, tables)
    ]
    if not any(scaled):
        raise SceneError(f"{path}: no entry of [[objects]] has a count or worlds, which another number would change")
    factor = (objects - (sum(len(group.world) for group in groups) - sum(scaled))) / sum(scaled)
    return make([table.multiply(key, factor) if n else table for table, key, n in zip(tables, keys, scaled)])
