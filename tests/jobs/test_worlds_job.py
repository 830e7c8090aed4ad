"""The worlds of a scene as shards: the rows of one run of the whole scene, whatever the size of a shard."""

import numpy as np
import pytest
from helpers.jobs import load_worlds, read, run

from warp_abtree.app import load_scene
from warp_abtree.jobs import WorldsJob

LOD_SWEEP = '[[lod_sweep]]\nmodel = "ring"\nfrom = 1.0\nto = 0.2\nperiod = 0.1'


@pytest.mark.parametrize("kind", ["moved", "bodies"])
def test_rows_are_those_of_one_run(device, tmp_path, kind):
    scene = load_worlds(tmp_path, "[dynamics]" if kind == "bodies" else "", LOD_SWEEP if kind == "moved" else "")
    runs = {}
    for output in ("count", "poses"):
        for shard in (2, 5):
            out = tmp_path / f"{output}{shard}"
            run(WorldsJob(scene, 6, output, shard), out, device=device)
            rows = read(out)
            order = np.lexsort((rows["object" if output == "poses" else "world"], rows["frame"]))
            runs[output, shard] = {name: values[order] for name, values in rows.items()}
        for name, values in runs[output, 5].items():
            np.testing.assert_array_equal(runs[output, 2][name], values, err_msg=name)
    whole = load_scene(tmp_path / "scene.toml", device=device)
    bodies = whole.make_bodies()
    frame = whole.frame(bodies=bodies)
    poses, counts = runs["poses", 5], runs["count", 5]
    for number in range(6):
        expected = whole.motion.poses(number * whole.time_step) if bodies is None else bodies.poses()
        result = frame.step()
        now = poses["frame"] == number
        placed = np.stack([poses[name][now] for name in ("x", "y", "z", "qx", "qy", "qz", "qw")], 1)
        np.testing.assert_array_equal(placed, expected[whole.worlds >= 0])
        now, world = counts["frame"] == number, whole.worlds[result.pairs].max(1)
        np.testing.assert_array_equal(counts["face_pairs"][now], np.bincount(world, result.count, 5))
        np.testing.assert_array_equal(counts["intersecting"][now], np.bincount(world, result.any, 5))
    assert counts["face_pairs"].any()


def test_scenes_that_cannot_be_split_are_refused(tmp_path):
    scene = load_worlds(tmp_path, "[dynamics]", '[[objects]]\nmodel = "ring"\nworld = -1\nposition = [0, 5, 0]')
    with pytest.raises(ValueError, match="object 16 is a rigid body in world -1"):
        WorldsJob(scene)
    scene = load_worlds(
        tmp_path, "", '[lod]\ncontroller = "tolerance"\ntolerance = 0.01\n[camera]\neye = [0, 2, 9]\ntarget = [0, 0, 0]'
    )
    with pytest.raises(ValueError, match="by the clock"):
        WorldsJob(scene)
    with pytest.raises(ValueError, match="output 'any' of worlds"):
        WorldsJob(load_worlds(tmp_path), output="any")
    for name, value in (("frames", 0), ("frames", 2.5), ("shard", 0), ("shard", -1)):
        with pytest.raises(ValueError, match=f"^{name} {value} is "):
            WorldsJob(load_worlds(tmp_path), **{name: value})
