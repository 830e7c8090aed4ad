"""Scene: posed objects at levels of detail, and every question that one can ask of them."""

import numpy as np

from warp_abtree.checks.arguments import check_device, flag, to_numpy
from warp_abtree.query.broad_phase import BroadPhase
from warp_abtree.query.result import Result, contact_dtypes
from warp_abtree.scene.kept_queries import KeptQueries
from warp_abtree.scene.penetration import Penetration, find_penetration
from warp_abtree.scene.point_distance import object_distances
from warp_abtree.scene.posed_objects import PosedObjects
from warp_abtree.scene.tree_state import TreeState, read_tree_state
from warp_abtree.state.batch import check_pairs, exclusion_keys


class Scene(PosedObjects):
    """Many objects, many worlds, one device.

    Without objects `broad_phase` finds no pairs; `set_poses`, `set_lods` and `intersect` raise ValueError.

    Args:
        device: Warp device, such as "cpu" or "cuda:0"; None for Warp's default.

    Raises:
        ValueError: No such device on this machine.
    """

    def __repr__(self):
        return f"Scene({self.device.alias!r}, objects={self.object_count}, models={len(self.models)})"

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
        excluded = np.union1d(self._excluded, exclusion_keys(self._check_pairs(pairs)))
        if self._batch is not None:
            self._batch.exclude(excluded)
        self._kept.pop("broad phase", None)
        self._excluded = excluded

    def broad_phase(self) -> np.ndarray:
        """Return the object pairs whose posed root boxes overlap, int32 (p, 2), sorted, i < j. Waits for the device.

        Worlds never mix (-1 is in every one), two static objects never pair, nor do objects whose collision groups and
        masks forbid it; filtered pairs stay out.
        """
        return self._find_pairs(None, 0.0)

    @property
    def _queries(self) -> KeptQueries:
        self._drop_retired()
        if "queries" not in self._kept:
            self._kept["queries"] = KeptQueries(self, self._find_pairs)
        return self._kept["queries"]

    def _find_pairs(self, pairs, within: float) -> np.ndarray:
        """Return given pairs, checked, or those of the broad phase up to a distance."""
        if pairs is not None:
            return self._check_pairs(pairs)
        check_device(self.device, "Scene.broad_phase")
        if self.object_count < 2:
            return np.empty((0, 2), np.int32)
        batch = self.batch()
        if "broad phase" not in self._kept:
            self._kept["broad phase"] = BroadPhase(batch)
        return self._kept["broad phase"].find(within)

    def _check_pairs(self, pairs) -> np.ndarray:
        return check_pairs(pairs, self.object_count, self._objects.free)

    def intersect(
        self,
        pairs=None,
        output="any",
        precision="exact",
        within=None,
        contact_dtype=np.float64,
        device: bool = False,
        *,
        gap=None,
        tolerance=None,
        relative=None,
        beyond=None,
        signed=None,
        originals=None,
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
            gap: A distance [world units] or (p,) of them: faces nearer than that have contacts too, and all have a
                separation; for "contacts" alone.
            tolerance, relative, beyond: When the search for a distance ends, see `DistanceQuery`; for "distance" alone.
            signed: Whether depths of solids are negative distances, see `DistanceQuery`; for "distance" alone.
            originals: Whether a distance is that of the original meshes, whatever the LODs; for "distance" alone.

        Raises:
            ValueError: Bad pairs, a bad distance, an option that means nothing for the output, a scene without objects;
                or signed and no object of the given pairs, else of the scene, is a solid.
        """
        check_device(self.device, "Scene.intersect (Query.launch can)")
        contact_dtypes(contact_dtype)
        flag(device, "device")
        options = {"within": within, "gap": gap, "tolerance": tolerance, "relative": relative}
        options |= {"beyond": beyond, "signed": signed, "originals": originals}
        return self._queries.find(pairs, output, precision, contact_dtype, options, device)

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
            pairs = self._check_pairs(pairs)
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

    def signed_distance(self, points, world=0, signed: bool = True, within=None, nearest: bool = False) -> tuple:
        """Return the distances of points from the objects, negative inside solids, and which is nearest. Waits.

        The distance of a point is the least signed one of all objects: inside a solid, how deep; else how far to the
        nearest surface, at the objects' LODs.

        Args:
            points: (n, 3) [world units], of any framework. A Warp array of vec3d on the scene's GPU stays there, and so
                do the results, Warp arrays of their own.
            world: The objects of which world are asked, those of world -1 among them.
            signed: Whether the insides of solids count.
            within: Distance [world units] up to which surfaces are looked for, which takes less time: of points farther
                away distances are infinite, -inf inside, nearest points NaN, faces -1, and outside objects too.
            nearest: Whether to return the nearest points on the surfaces and their faces as well.

        Returns:
            Distances, float64 (n,), and objects, int32 (n,); with `nearest` also points [world units], float64 (n, 3),
            and faces of the object's file, int32 (n,).

        Raises:
            ValueError: Points of another shape, not finite or beyond 2^300, the first is named; a bad `within`; no
                object in that world; or signed, and none of them is a solid.
        """
        return object_distances(self, points, world, signed, within, nearest)

    def tree_state(self, i) -> TreeState:
        """Return the AB-Tree of an object at its LOD. Waits for the device.

        Raises:
            ValueError: No such object.
        """
        check_device(self.device, "Scene.tree_state")
        return read_tree_state(self.batch(), self.models, self._check_object(i))
