"""LOD ladders and objects of a scene, as selection kernels read them, and sums over all threads of a launch."""

import warp as wp


@wp.struct
class LodPool:
    """LOD ladders and objects of a scene.

    A level is a place on a model's LOD ladder, 0 the coarsest; arrays over levels are indexed by
    model * level_count + level. The tolerance scale is common to all models, 0 the coarsest.
    """

    object_model: wp.array(dtype=wp.int32)  # [object] model
    importance: wp.array(dtype=wp.int32)  # [object] beta: 1, 2 or 3
    lod: wp.array(dtype=wp.int32)  # [level] LOD
    error: wp.array(dtype=wp.float64)  # [level] certified error [model units]
    faces: wp.array(dtype=wp.int32)  # [level] active faces
    entry: wp.array(dtype=wp.int32)  # [level] where the LOD starts in its model's split_face
    face_count: wp.array(dtype=wp.int32)  # [model] faces of the finest LOD
    refits: wp.array(dtype=wp.int32)  # [model] 1 if a change of LOD refits a tree, 0 if each level has a tree state
    tolerance_level: wp.array(dtype=wp.int32)  # [model * tolerance_count + tolerance] coarsest level within it
    level_count: wp.int32  # levels of each ladder
    tolerance_count: wp.int32  # tolerances of the scale


WARP = 32
"""Threads of a launch that adds lanes are a multiple of it."""
