"""Posed objects of a scene: added, removed and changed on the host, moved and brought to LODs on the device."""

from bisect import bisect_left
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import check_device, to_numpy, whole_number
from warp_abtree.checks.device_memory import DeviceMemory
from warp_abtree.checks.quaternions import quaternions_of
from warp_abtree.kernels.base.arrays import NO_OBJECT
from warp_abtree.model.model import Model
from warp_abtree.scene.objects import ALL_BITS, ObjectList, check_columns, check_lods, check_models
from warp_abtree.state.arrays import ModelArrays, ObjectArrays, StateArrays
from warp_abtree.state.batch import Batch
from warp_abtree.state.lod_update import LodUpdate
from warp_abtree.state.poses import PoseSetter, check_poses, place_row


class PosedObjects(DeviceMemory):
    """Objects of a device, at poses and LODs; `Scene` asks questions of them.

    Each object has a place, its index. Where objects are added, removed or changed, operators and captured graphs of
    before say that they are stale; arrays are made anew at the next use, which `set_pose`, `set_poses` and `set_lods`
    do not ask for.
    """

    def __init__(self, device=None):
        try:
            self.device = wp.get_device(device)
        except Exception as error:
            present = ", ".join(d.alias for d in wp.get_devices())
            raise ValueError(f"no device {device!r} on this machine; there is {present} ({error})") from None
        check_device(self.device)
        self._objects = ObjectList()
        self._excluded = np.empty(0, np.int64)
        self._batch: Batch | None = None
        self._kept: dict[str, Any] = {}  # what was made for the batch, and goes with it

    @property
    def object_count(self) -> int:
        """Places of objects, those of removed ones among them."""
        return len(self._objects)

    @property
    def models(self) -> list[Model]:
        """Models of the objects, each once."""
        return self._objects.models

    @property
    def object_model(self) -> list[int]:
        """Index into `models` of each object."""
        return self._objects.model

    @property
    def object_importance(self) -> list[int]:
        """Importance of each object."""
        return self._objects.importance

    @property
    def object_solid(self) -> list[bool]:
        """Whether each object is a solid."""
        return self._objects.solid

    @property
    def worlds(self) -> np.ndarray:
        """World of each object, int32 (n,)."""
        return np.array(self._objects.world, np.int32)

    @property
    def lods(self) -> np.ndarray:
        """LOD of each object, int32 (n,)."""
        return np.array(self._objects.lod if self._batch is None else self._batch.lods, np.int32)

    @property
    def present(self) -> np.ndarray:
        """Whether each place has an object, bool (n,)."""
        present = np.ones(self.object_count, bool)
        present[self._objects.free] = False
        return present

    def name(self, i) -> str:
        """Return the name of object i.

        Raises:
            ValueError: No such object.
        """
        return self._objects.name[self._check_object(i)]

    def add(
        self,
        model,
        pose=(0, 0, 0, 0, 0, 0, 1),
        world=0,
        lod=None,
        importance=1,
        static=False,
        collision_group=1,
        collision_mask=ALL_BITS,
        solid=False,
        name=None,
    ) -> int:
        """Add an object and return its index, the lowest that is free.

        Args:
            model: `Model`.
            pose: x y z qx qy qz qw [world units, unit quaternion], or a rigid (4, 4) matrix.
            world: The broad phase never pairs objects of different worlds; -1 is in every world.
            lod: LOD to stand at; None is the finest.
            importance: Application context beta of the LOD selection, 1, 2 or 3 (paper, section 4.2).
            static: Whether the broad phase never pairs it with another static object, a bool.
            solid: Whether what lies inside it intersects it, a bool; of a closed model, at every LOD, see
                `warp_abtree.state.solids`.
            collision_group, collision_mask: Bits, from 0 to 2^32 - 1. The broad phase pairs objects a and b only where
                group_a & mask_b and group_b & mask_a both hold a bit.
            name: What results and pictures call it; None is its model's name and its index.

        Raises:
            TypeError: model is no Model.
            MeshError: A solid whose mesh is not closed; the message names edges.
            ValueError: Anything else is out of range; nothing is added.
            RuntimeError: A graph is being captured.
        """
        models = check_models(model, 1)
        poses = check_poses(to_numpy(pose, "pose")[None], "pose")
        columns = check_columns(models, [name], world, importance, static, solid, collision_group, collision_mask)
        return int(self._extend(models, poses, lod, columns)[0])

    def add_many(
        self,
        models,
        poses,
        worlds=0,
        lods=None,
        importances=1,
        statics=False,
        collision_groups=1,
        collision_masks=ALL_BITS,
        solids=False,
        names=None,
    ) -> np.ndarray:
        """Add an object for each pose and return their indices, int (n,): all of them, or none.

        Args:
            models: `Model` of all, or a list of n.
            poses: (n, 7) or (n, 4, 4), of any framework, see `add`.
            worlds, lods, importances, statics, solids, collision_groups, collision_masks: As for `add`, one for all or
                (n,).
            names: (n,) strings, or None.

        Raises:
            TypeError, ValueError, RuntimeError: As `add`; or not n were given.
        """
        poses = check_poses(poses)
        models = check_models(models, len(poses))
        columns = check_columns(models, names, worlds, importances, statics, solids, collision_groups, collision_masks)
        return self._extend(models, poses, lods, columns)

    def _extend(self, models, poses, lods, columns) -> np.ndarray:
        lods = check_lods(lods, models)
        self._retire()
        return self._objects.extend(models, {"lod": lods, "pose": list(poses), **columns})

    def remove(self, i):
        """Remove objects. Indices of others stay; the next `add` takes the lowest place that is free.

        A place without an object keeps its index: the broad phase never pairs it, pairs that name it are refused, and
        what is given an object goes on having an entry for it, which is not read: a pose, a LOD, a number. Its model is
        one of a single triangle. A filter of the object goes with it.

        Args:
            i: Index of an object, or (k,) of them.

        Raises:
            ValueError: No such object, or one that is named twice; nothing is removed.
            RuntimeError: A graph is being captured.
        """
        given = to_numpy(i, "objects")
        removed = [self._check_object(k) for k in (given.tolist() if given.ndim else [given.item()])]
        if len(set(removed)) != len(removed):
            raise ValueError("objects: one is named twice")
        if not removed:
            return
        before = self._excluded
        named = np.isin(before >> 32, removed) | np.isin(before & (2**32 - 1), removed)
        self._retire("removing an object")
        try:
            self._excluded = before[~named]
            self._objects.remove(removed)
        except BaseException:
            self._excluded = before
            raise

    def change(
        self,
        i,
        world=None,
        importance=None,
        static=None,
        collision_group=None,
        collision_mask=None,
        solid=None,
        name=None,
    ):
        """Change what `add` was told of object i; None leaves it.

        Raises:
            ValueError, MeshError: No such object, or as `add`; nothing is changed.
            RuntimeError: A graph is being captured.
        """
        i, told = self._check_object(i), self._objects
        given = {"world": world, "importance": importance, "static": static, "solid": solid}
        given |= {"group": collision_group, "mask": collision_mask}
        now = {key: getattr(told, key)[i] if value is None else value for key, value in given.items()}
        columns = check_columns([self.models[told.model[i]]], [told.name[i] if name is None else name], **now)
        if any(value is not None for value in given.values()):
            self._retire("changing an object")
        told.change(i, columns)
        if self._batch is not None:
            self._batch.names = told.name

    def _check_object(self, i) -> int:
        i = whole_number(i, "object", 0, self.object_count - 1)
        free = self._objects.free
        if i in free[(k := bisect_left(free, i)) : k + 1]:
            raise ValueError(f"object {i} was removed")
        return i

    def _retire(self, what="adding an object"):
        """Take the device's poses back before the arrays are made anew. Waits for the device."""
        if self._batch is None:
            return
        check_device(self.device, what)
        self._objects.pose, self._objects.lod = list(self._read_matrices()), self._batch.lods.tolist()
        self._batch.retire()
        self._drop_retired()

    def _drop_retired(self):
        """Forget arrays that are retired, also by an edit that was interrupted then."""
        if self._batch is not None and self._batch.retired:
            vars(self).update(_batch=None, _kept={})

    def _read_matrices(self) -> np.ndarray:
        objects = self.batch().objects
        matrices = np.tile(np.eye(4), (len(objects.state), 1, 1))
        matrices[:, :3, :3] = objects.pool.rotation.numpy()
        matrices[:, :3, 3] = objects.pool.position.numpy()
        return matrices

    def batch(self) -> Batch:
        """Return the scene's `Batch`, made at the first use after an `add`.

        Tree states that an interrupted change of LODs has left torn are made anew.
        """
        self._drop_retired()
        if self._batch is None:
            if not self.object_count:
                raise ValueError("the scene has no object")
            check_device(self.device, "making a scene's arrays")
            models = ModelArrays(self.models, self.device)
            states = StateArrays(models, self.device)
            told = self._objects
            statics = np.array(told.static, np.int32)
            statics[told.free] = NO_OBJECT
            objects = ObjectArrays(told.world, statics, self.device, told.collision_bits())
            batch = Batch(models, states, objects, told.model, self._excluded, told.solid, told.free, told.name)
            batch.set_lods(np.array(told.lod))
            told.set_poses(objects.pool, self.device)
            self._batch = batch
        self._batch.mend()
        return self._batch

    @property
    def poses(self) -> np.ndarray:
        """Pose of every object, x y z qx qy qz qw, qw >= 0, float64 (n, 7) [world units]. Waits for the device."""
        if not self.object_count:
            return np.empty((0, 7))
        check_device(self.device, "Scene.poses")
        matrices = self._read_matrices()
        return np.concatenate([matrices[:, :3, 3], quaternions_of(matrices[:, :3, :3])], axis=1)

    def set_pose(self, i, pose):
        """Set the pose of object i, (7,) or (4, 4), as `set_poses` sets all. Waits for the device.

        Raises:
            ValueError: No such object, or as `set_poses`; nothing is changed.
        """
        check_device(self.device, "Scene.set_pose (PoseInput can)")
        i = self._check_object(i)
        pose = check_poses(to_numpy(pose, "pose")[None], "pose", first=i)
        place_row(pose, self.batch().objects.pool, i)

    def set_poses(self, poses):
        """Set the pose of every object.

        Args:
            poses: (n, 7) x y z qx qy qz qw, quaternions normalised in float64, or (n, 4, 4) rigid matrices taken as
                they are; float32 or float64 [world units]. An array of any framework; one on the scene's GPU is checked
                and read there. Of a place without an object it is not read. (synchronization point)

        Raises:
            ValueError: Wrong shape or count, a number that is not finite, a quaternion or matrix that is no rotation;
                nothing is changed.
        """
        check_device(self.device, "Scene.set_poses (PoseInput can)")
        batch = self.batch()
        if "poses" not in self._kept:
            self._kept["poses"] = PoseSetter(batch.objects.pool, self.device, batch.removed)
        self._kept["poses"].set(poses)

    def set_lods(self, lods) -> LodUpdate:
        """Bring every object to a LOD: meshes are refined and trees updated in one batch, states are shared.

        Args:
            lods: (n,) whole numbers, each from 0 to its model's lod_max; of any framework, copied from a GPU. Of a
                place without an object it is not read.

        Raises:
            ValueError: Wrong shape or a LOD out of range; nothing is changed.
            RuntimeError: The device is out of memory, or a launch fails; LODs and answers are as before.
        """
        check_device(self.device, "Scene.set_lods (Pipeline.lods can)")
        lods = to_numpy(lods, "lods")
        if lods.shape != (self.object_count,):
            raise ValueError(f"lods: shape {lods.shape} given for {self.object_count} objects")
        lods = np.where(self.present, lods, 0)
        if not (lods == np.floor(lods)).all():
            raise ValueError(f"lods: type {lods.dtype} holds no whole numbers")
        top = np.array([model.lod_max for model in self.models])[self.object_model]
        bad = np.flatnonzero((lods < 0) | (lods > top))
        if len(bad):
            i = int(bad[0])
            raise ValueError(f"lods: object {i} asks for LOD {lods[i]}, outside 0 .. {top[i]}")
        return self.batch().set_lods(lods.astype(np.int64))


def expect_scene(scene) -> Any:
    """Return a scene; raise TypeError for anything else."""
    if not isinstance(scene, PosedObjects):
        raise TypeError(f"scene: a Scene is expected, not a {type(scene).__name__}")
    return scene
