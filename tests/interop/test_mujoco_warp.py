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


@pytest.mark.slow
def test_contacts_say_what_the_query_found(device):
    """Of a ring 0.01 deep in the floor: depths, normals from the lower geom to the higher, friction and room."""
    import mujoco_warp as mjw
    import warp as wp

    space = runpy.run_path(str(SCENE))
    host = space["build"]()
    host.qpos0[:7] = 1.5, 0, 0.07, 1, 0, 0, 0
    with wp.ScopedDevice(device):
        model = mjw.put_model(host)
        data = mjw.put_data(host, mujoco.MjData(host), nworld=3, nconmax=64, njmax=256)
        space["MeshContacts"](host, model, data).collide()
    count = int(data.nacon.numpy()[0])
    rows = {name: getattr(data.contact, name).numpy()[:count] for name in ("dist", "pos", "frame", "geom", "worldid")}
    assert count >= 9 and sorted(set(rows["worldid"].tolist())) == [0, 1, 2]
    assert set(map(tuple, rows["geom"].tolist())) == {(0, 2)}
    assert np.allclose(rows["dist"], -0.01, atol=1e-3) and np.allclose(rows["frame"][:, 0], (0, 0, 1), atol=0.2)
    assert np.allclose(np.linalg.det(rows["frame"]), 1, atol=1e-5) and np.abs(rows["pos"][:, 2]).max() < 0.011
