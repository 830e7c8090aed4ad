"""Contacts written into mujoco_warp's `d.contact` by the scene that shows it: rings fall over a peg."""

import runpy
from pathlib import Path

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")
pytest.importorskip("mujoco_warp", reason="needs mujoco_warp (extra test)")

SCENE = Path(__file__).resolve().parents[2] / "scenes" / "interop" / "mujoco_warp_contacts.py"


@pytest.mark.slow
def test_rings_fall_over_a_peg_on_which_hulls_stay(device, capsys):
    space = runpy.run_path(str(SCENE))
    heights = space["main"](device, worlds=2, seconds=1.5)
    assert np.abs(heights - 0.08).max() < 2e-3, "at rest, the minor radius above the floor"
    assert " 1.0 s " in capsys.readouterr().out
    host = space["build"]()
    data = mujoco.MjData(host)
    mujoco.mj_step(host, data, nstep=round(1.5 / host.opt.timestep))
    assert data.qpos[2] > 0.85, "MuJoCo's own, by convex hulls"
