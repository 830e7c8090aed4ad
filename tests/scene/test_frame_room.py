"""Room for what float32 leaves open: made for the first frame of a graph, or told where what was given is too small."""

import warnings

import numpy as np
import pytest
import warp as wp
from helpers.gpu_query import GpuQuery
from helpers.samples import sample

import warp_abtree as ab
from warp_abtree.query import narrow_phase as intersect
from warp_abtree.scene import pipeline as frame_graph


@pytest.fixture
def coincident(device, monkeypatch):
    """A scene of objects laid on one another, asked as on CUDA: float32 leaves many pairs of faces open."""
    monkeypatch.setattr(frame_graph, "Query", GpuQuery)
    monkeypatch.setattr(intersect, "UNCERTAIN_ROOM", 16)
    scene = ab.Scene(device)
    for _ in range(3):
        scene.add(sample("twins"))
    return scene


@pytest.mark.slow
def test_the_room_of_the_first_frame_is_made(coincident):
    frame = ab.FrameGraph(coincident, output="count")
    needed = int(frame.run().float64_tests.sum())
    assert len(frame.query.hits.unsure) >= needed > 16
    frame = ab.FrameGraph(coincident, output="count")
    wp.capture_launch(frame.capture())
    frame.check()
    np.testing.assert_array_equal(frame.result().count, coincident.intersect(output="count").count)


@pytest.mark.slow
def test_a_room_that_is_too_small_is_told_at_construction(coincident):
    needed = int(ab.FrameGraph(coincident, output="count").run().float64_tests.sum())
    with pytest.warns(RuntimeWarning, match=f"=8: .* leave {needed} .*uncertain={needed}"):
        frame = ab.FrameGraph(coincident, output="count", capacity=ab.Buffers(uncertain=8))
    wp.capture_launch(frame.capture())
    with pytest.raises(ab.CapacityError, match=f"needed .*uncertain={needed}.*room for 8"):
        frame.check()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        frame = ab.FrameGraph(coincident, output="count", capacity=ab.Buffers(uncertain=needed))
    wp.capture_launch(frame.capture())
    frame.check()
