"""`bench scaling`: fits, numbers of devices, and answers of several devices held against those of one."""

import numpy as np
import pytest
from helpers.samples import sample

from bench import scaling


def test_cost_is_fitted(device):
    rng = np.random.default_rng(2)
    rows = rng.uniform(1, 100, (20, 3))
    np.testing.assert_allclose(scaling.fit_cost(rows, rows @ [3.0, 0.5, 0.25]), [3.0, 0.5, 0.25])
    cost = scaling.fit_cost(rows, rows @ [3.0, -0.01, 0.25])
    assert cost[1] == 0 and cost[0] > 0 and cost[2] > 0
    sizes = scaling.QUICK
    row = scaling.run_cost(scaling.wp.get_device(device), sizes)
    assert row["samples"] == 12 and row["node_us"] >= 0 and row["off_mean"] <= row["off_worst"]


@pytest.mark.parametrize("count", [1, 2, 4, 5])
def test_numbers_of_devices(count):
    numbers = {1: [1], 2: [1, 2], 4: [1, 2, 4], 5: [1, 2, 4, 5]}[count]
    assert scaling.list_sizes(["cpu"] * count) == sorted({(n, times) for n in numbers for times in (1, n)})


def check_rows(rows, name):
    assert [(row["way"], row["devices"]) for row in rows] == [("strong", 1), ("strong", 2), ("weak", 1), ("weak", 2)]
    sizes = [row[name] for row in rows]
    assert sizes[:3] == sizes[:1] * 3 and sizes[3] == 2 * sizes[0]
    assert rows[0]["efficiency"] == rows[2]["efficiency"] == 1
    assert scaling.testing.current_regime().cpu_threads is None


def test_frames_on_devices_are_timed(device, monkeypatch):
    model = sample("small ball")
    rows = list(scaling.run_frames([device, device], model, scaling.QUICK))
    check_rows(rows, "worlds")
    assert all(row["frame_ms"] > 0 for row in rows)
    whole = scaling.Frames.answer
    monkeypatch.setattr(scaling.Frames, "answer", lambda self, rows: whole(self, rows)[:-1])
    with pytest.raises(RuntimeError, match="frames: 2 devices answer otherwise than one"):
        list(scaling.run_frames([device, device], model, scaling.QUICK))


def test_shards_on_devices_are_timed(device):
    model = sample("small ball")
    rows = list(scaling.run_shards([device, device], model, scaling.QUICK))
    check_rows(rows, "poses")
    assert rows[3]["mposes_s"] > 0
    driver = scaling.run_driver(model, 4096)
    assert driver["driver_mposes_s"] > 0 and driver["check_mposes_s"] > 0


def test_prediction():
    rows = [
        {"case": "worker", "device": "it", "worker_mposes_s": 2.0},
        {"case": "driver", "driver_mposes_s": 100.0},
    ]
    found = {(row["poses"], row["devices"]): row for row in scaling.predict_rows(rows)}
    many = found[10**12, 1000]
    assert many["seconds"] == pytest.approx(10 + 500 + 65536 / 2e6, rel=1e-3)
    assert many["drivers"] == 20 and many["one_driver_seconds"] == pytest.approx(10010, rel=1e-3)
    assert many["efficiency"] == pytest.approx(500 / many["seconds"], abs=1e-3)
    assert found[10**9, 1000]["efficiency"] < 0.05 < 0.97 < found[10**9, 1]["efficiency"]
