"""Scene: posed objects at levels of detail, and every question that one can ask of them."""

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import check_device, flag, to_numpy, whole_number
from warp_abtree.checks.device_memory import DeviceMemory
from warp_abtree.model.model import Model
from warp_abtree.query.broad_phase import BroadPhase
from warp_abtree.query.result import Result, contact_dtypes
from warp_abtree.scene.kept_queries import KeptQueries
from warp_abtree.scene.objects import ALL_BITS, ObjectList, check_columns, check_lods, check_models
from warp_abtree.scene.penetration import Penetration, find_penetration
from warp_abtree.scene.tree_state import TreeState, read_tree_state
from warp_abtree.state.arrays import ModelArrays, ObjectArrays, StateArrays
from warp_abtree.state.batch import Batch, check_pairs, exclusion_keys
from warp_abtree.state.lod_update import LodUpdate
from warp_abtree.state.poses import HostPoses, check_poses, device_rows, place_rows


class Scene(DeviceMemory):
    """Many objects, many worlds, one device.

    Without objects `broad_phase` finds no pairs; `set_poses`, `set_lods` and `intersect` raise ValueError.

    Args:
        device: Warp device, such as "cpu" or "cuda:0"; None for Warp's default.

    Raises:
        ValueError: No such device on this machine.
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
        self._broad_phase: BroadPhase | None = None
        self._host_poses: HostPoses | None = None
        self._queries = KeptQueries(self, self._find_pairs)

    def __repr__(self):
        return f"Scene({self.device.alias!r}, objects={self.object_count}, models={len(self.models)})"

    @property
    def object_count(self) -> int:
        """Objects added so far."""
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

    def name(self, i) -> str:
        """Return the name of object i.

        Raises:
            ValueError: No such object.
        """
        i = whole_number(i, "object", 0, self.object_count - 1)
        told = self._objects.name[i]
        return f"{self.models[self.object_model[i]].name} {i}" if told is None else told

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
        """Add an object and return its index.

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
        columns = check_columns(models, [name], world, importance, (static, solid), (collision_group, collision_mask))
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
        columns = check_columns(
            models, names, worlds, importances, (statics, solids), (collision_groups, collision_masks)
        )
        return self._extend(models, poses, lods, columns)

    def _extend(self, models, poses, lods, columns) -> np.ndarray:
        lods = check_lods(lods, models)
        self._retire()
        self._objects.extend(models, {"lod": lods, "pose": list(poses), **columns})
        return np.arange(self.object_count - len(models), self.object_count)

    def _retire(self):
        """Take the device's poses back before the arrays are made anew. Waits for the device."""
        if self._batch is None:
            return
        check_device(self.device, "adding an object")
        objects = self._batch.objects
        matrices = np.tile(np.eye(4), (len(objects.state), 1, 1))
        matrices[:, :3, :3] = objects.pool.rotation.numpy()
        matrices[:, :3, 3] = objects.pool.position.numpy()
        self._batch.retire()
        self._objects.pose, self._objects.lod = list(matrices), self._batch.lods.tolist()
        self._queries.clear()
        self._broad_phase = self._host_poses = None
        self._batch = None

    def batch(self) -> Batch:
        """Return the scene's `Batch`, made at the first use after an `add`.

        Tree states that an interrupted change of LODs has left torn are made anew.
        """
        if self._batch is None:
            if not self.object_count:
                raise ValueError("the scene has no object")
            check_device(self.device, "making a scene's arrays")
            models = ModelArrays(self.models, self.device)
            states = StateArrays(models, self.device)
            told = self._objects
            objects = ObjectArrays(told.world, told.static, self.device, told.collision_bits())
            batch = Batch(models, states, objects, told.model, self._excluded, told.solid)
            batch.set_lods(np.array(told.lod))
            told.set_poses(objects.pool, self.device)
            self._batch = batch
        self._batch.mend()
        return self._batch

    def set_poses(self, poses):
        """Set the pose of every object.

        Args:
            poses: (n, 7) x y z qx qy qz qw, quaternions normalised in float64, or (n, 4, 4) rigid matrices taken as
                they are; float32 or float64 [world units]. An array of any framework; one on the scene's GPU is checked
                and read there. (synchronization point)

        Raises:
            ValueError: Wrong shape or count, a number that is not finite, a quaternion or matrix that is no rotation;
                nothing is changed.
        """
        check_device(self.device, "Scene.set_poses (PoseInput can)")
        rows = device_rows(poses, self.device)
        if rows is None:
            poses = check_poses(poses)
        given = len(poses) if rows is None else len(rows)
        if given != self.object_count:
            raise ValueError(f"poses: {given} given for {self.object_count} objects")
        pool = self.batch().objects.pool
        if rows is not None:
            place_rows(rows, pool)
            return
        if self._host_poses is None:
            self._host_poses = HostPoses(pool, self.device)
        self._host_poses.place(poses)

    def set_lods(self, lods) -> LodUpdate:
        """Bring every object to a LOD: meshes are refined and trees updated in one batch, states are shared.

        Args:
            lods: (n,) whole numbers, each from 0 to its model's lod_max; of any framework, copied from a GPU.

        Raises:
            ValueError: Wrong shape or a LOD out of range; nothing is changed.
            RuntimeError: The device is out of memory, or a launch fails; LODs and answers are as before.
        """
        check_device(self.device, "Scene.set_lods (Pipeline.lods can)")
        lods = to_numpy(lods, "lods")
        if lods.shape != (self.object_count,):
            raise ValueError(f"lods: shape {lods.shape} given for {self.object_count} objects")
        if lods.dtype.kind not in "iu" and not (lods.dtype.kind == "f" and (lods == np.floor(lods)).all()):
            raise ValueError(f"lods: type {lods.dtype} holds no whole numbers")
        top = np.array([model.lod_max for model in self.models])[self.object_model]
        bad = np.flatnonzero((lods < 0) | (lods > top))
        if len(bad):
            i = int(bad[0])
            raise ValueError(f"lods: object {i} asks for LOD {lods[i]}, outside 0 .. {top[i]}")
        return self.batch().set_lods(lods.astype(np.int64))

    def filter(self, pairs):
        """Exclude object pairs from every later broad phase.

        Args:
            pairs: (..., 2) object indices. A filter that repeats, as of neighbouring links of many arms, is one call:
                `links = scene.add_many(...).reshape(arms, -1)`, then `scene.filter(links[:, [(0, 1), (1, 2)]])`.

        Raises:
            ValueError: Wrong shape, an index that is no object, an object paired with itself.
        """
        pairs = to_numpy(pairs, "pairs")
        if pairs.ndim > 2 and pairs.shape[-1] == 2:
            pairs = pairs.reshape(-1, 2)
        excluded = np.union1d(self._excluded, exclusion_keys(check_pairs(pairs, self.object_count)))
        if self._batch is not None:
            self._batch.exclude(excluded)
        self._broad_phase = None
        self._excluded = excluded

    def broad_phase(self) -> np.ndarray:
        """Return the object pairs whose posed root boxes overlap, int32 (p, 2), sorted, i < j. Waits for the device.

        Worlds never mix (-1 is in every one), two static objects never pair, nor do objects whose collision groups and
        masks forbid it; filtered pairs stay out.
        """
        return self._broad_pairs(0.0)

    def _find_pairs(self, pairs, within: float) -> np.ndarray:
        """Return given pairs, checked, or those of the broad phase up to a distance."""
        return self._broad_pairs(within) if pairs is None else check_pairs(pairs, self.object_count)

    def _broad_pairs(self, within: float) -> np.ndarray:
        check_device(self.device, "Scene.broad_phase")
        if self.object_count < 2:
            return np.empty((0, 2), np.int32)
        batch = self.batch()
        if self._broad_phase is None:
            self._broad_phase = BroadPhase(batch)
        return self._broad_phase.find(within)

    def intersect(
        self,
        pairs=None,
        output="any",
        precision="exact",
        within=None,
        contact_dtype=np.float64,
        device: bool = False,
        **options,
    ) -> Result:
        """Test object pairs for intersection, exactly as posed and at their LODs. Waits for the device.

        Touching counts. Columns of the result follow the order in which a pair names its objects.

        Args:
            pairs: (p, 2) object indices, asked whatever their worlds, groups and masks, also where both are static or
                filtered out of the broad phase; None asks the broad phase for the pairs whose boxes overlap, or are no
                farther apart than within, gap or beyond if that is one distance.
            output: "any", "count", "faces" or "contacts": each answers those before it too; what a contact is, and
                an object pair's summary of them, stands in `query.stages.contacts`. Or "distance": how far apart
                the surfaces are, and where they are nearest, see `query.stages.distance`.
            precision: "exact": the answer is exact for A's vertices and the posed ones of B, A the object with the
                smaller index. "float32" takes the signs of rounded determinants.
            within: Distance d >= 0 [world units], or (p,) of them: `result.apart` tells the pairs whose posed surfaces,
                at their LODs, are proved farther apart than d; never true where they are not, whatever the rounding.
                With d = error_at(A) + error_at(B) it proves that the original meshes do not intersect.
            contact_dtype: Type of the real numbers in contacts, float64 or float32.
            device: Whether the result's arrays stay on the scene's device, see `Result`.
            options: What one output alone takes, None as if not given. Of "distance": tolerance, relative and beyond,
                when the search ends, and signed, whether depths of solids are negative distances, see `DistanceQuery`;
                originals, whether it is that of the original meshes, whatever the LODs, see
                `query.stages.distance`. Of "contacts": gap, a distance [world units] or (p,) of them: faces nearer
                than that have contacts too, and all have a separation.

        Raises:
            TypeError: An option with another name.
            ValueError: Bad pairs, a bad distance, an unknown option, a scene without objects; or signed and no object
                of the given pairs, else of the scene, is a solid.
        """
        check_device(self.device, "Scene.intersect (Query.launch can)")
        contact_dtypes(contact_dtype)
        flag(device, "device")
        return self._queries.find(pairs, output, precision, contact_dtype, {"within": within, **options}, device)

    def first_contact(
        self, pairs, end_poses, tolerance=1e-6, screw=False, linear=False, device: bool = False
    ) -> Result:
        """Find when object pairs first touch on the way from their poses to end poses. Waits for the device.

        In unit time each object's frame moves straight at constant speed, and turns the shortest way at constant
        angular velocity; poses in the scene stay as they are.

        Args:
            pairs: As for `intersect`; None asks the broad phase for boxes that overlap on their way.
            end_poses: Of all objects, as for `set_poses`.
            tolerance: What a time may be early by, as a part of the motion, from 2^-40 up.
            screw: Whether objects move on screws instead.
            linear: Whether vertices move straight instead, from one posed mesh to the other.
            device: As for `intersect`.

        Returns:
            `Result` with time, clear and undecided; what they are stands in `query.stages.motion`.

        Raises:
            ValueError: Bad pairs, poses or tolerance, a scene without objects; an object of a pair that turns by half a
                revolution, within 1e-6 rad, which has no shortest way.
        """
        check_device(self.device, "Scene.first_contact (FirstContactQuery.launch can)")
        flag(device, "device")
        if pairs is not None:
            pairs = check_pairs(pairs, self.object_count)
        return self._queries.find_first_contacts(pairs, end_poses, tolerance, screw, linear, device)

    def penetration(self, pairs=None, directions=None, tolerance=1e-6) -> Penetration:
        """Find the least way out of object pairs, certified by first contacts. Waits for the device.

        Args:
            pairs: As for `intersect`.
            directions: In which the second objects may leave, world axes, of any length, (m, 3) or (p, m, 3); None for
                those of `scene.penetration`, where all else stands too.
            tolerance: What a depth may be too long by, as a part of both boxes' sizes along its direction, from 2^-40.

        Raises:
            ValueError: Bad pairs or tolerance, no object, a direction that is 0 or not finite.
        """
        return find_penetration(self, pairs, directions, tolerance)

    def tree_state(self, i) -> TreeState:
        """Return the AB-Tree of an object at its LOD. Waits for the device.

        Raises:
            ValueError: No such object.
        """
        check_device(self.device, "Scene.tree_state")
        i = whole_number(i, "object", 0, self.object_count - 1)
        return read_tree_state(self.batch(), self.models, i)
