"""Contacts appended to mujoco_warp's own by the scene that shows it: rings fall over a peg onto a plane."""

import runpy
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from helpers import refused

mujoco = pytest.importorskip("mujoco")
mjw = pytest.importorskip("mujoco_warp", reason="needs mujoco_warp (extra test)")

SCENE = Path(__file__).resolve().parents[2] / "scenes" / "interop" / "mujoco_warp_contacts.py"
PLANE, PEG, RING = range(3)


@pytest.fixture(scope="module")
def space():
    return runpy.run_path(str(SCENE))


def put(host, worlds, space, **options):
    """Return a model and data of mujoco_warp, and `MeshContacts` of them."""
    model = mjw.put_model(host)
    data = mjw.put_data(host, mujoco.MjData(host), nworld=worlds, nconmax=64, njmax=256)
    return model, data, space["MeshContacts"](host, model, data, **options)


@pytest.mark.slow
def test_rings_fall_over_a_peg_on_which_hulls_stay(device, space, capsys):
    heights = space["main"](device, worlds=2, seconds=1.5)
    assert np.abs(heights - 0.08).max() < 2e-3, "at rest, the minor radius above the plane"
    assert " 1.0 s " in capsys.readouterr().out
    host = space["build"]()
    data = mujoco.MjData(host)
    mujoco.mj_step(host, data, nstep=round(1.5 / host.opt.timestep))
    assert data.qpos[2] > 0.85, "MuJoCo's own, by convex hulls"


@pytest.mark.slow
def test_a_graph_of_a_step_holds_the_contacts(device, space):
    """As mjlab makes one."""
    with wp.ScopedDevice(device):
        heights = []
        for captured in (False, True):
            model, data, contacts = put(space["build"](), 1, space)
            if captured:
                with wp.ScopedCapture(wp.get_device(device)) as capture:
                    mjw.step(model, data)
            for _ in range(120):
                wp.capture_launch(capture.graph) if captured else mjw.step(model, data)
            contacts.check()
            heights.append(data.qpos.numpy()[:, 2])
    assert heights[0] < 0.2 and np.abs(np.subtract(*heights)).max() < 1e-3


@pytest.mark.slow
def test_contacts_say_what_the_query_found(device, space):
    """Of a ring 0.01 deep in the peg's top: depths, normals from the lower geom to the higher, friction by world."""
    host = space["build"]()
    host.qpos0[:7] = 0.3, 0, 0.86, 1, 0, 0, 0
    with wp.ScopedDevice(device):
        model, data, _ = put(host, 3, space, points=4)
        friction = np.tile(host.geom_friction.astype(np.float32), (3, 1, 1))
        friction[:, RING, 0] = 1, 2, 3
        model.geom_friction = wp.array(friction, dtype=wp.vec3)
        mjw.forward(model, data)
        mjw.forward(model, data)
    count = int(data.nacon.numpy()[0])
    names = ("dist", "pos", "frame", "geom", "worldid", "friction", "dim")
    rows = {name: getattr(data.contact, name).numpy()[:count] for name in names}
    assert 9 <= count <= 12 and sorted(set(rows["worldid"].tolist())) == [0, 1, 2]
    assert set(map(tuple, rows["geom"].tolist())) == {(PEG, RING)}
    assert np.allclose(rows["dist"], -0.01, atol=1e-3) and (rows["frame"][:, 0, 2] > 0.95).all()
    assert np.allclose(np.linalg.det(rows["frame"]), 1, atol=1e-5) and np.abs(rows["pos"][:, 2] - 0.785).max() < 0.006
    assert (rows["friction"][:, 0] == 1 + rows["worldid"]).all() and (rows["dim"] == 3).all()


def test_pairs_are_those_that_the_file_allows(space):
    """Both pairs of the ring at first; then its masks leave the plane alone. What sleeps is refused."""
    with wp.ScopedDevice("cpu"):
        model, _, contacts = put(space["build"](), 2, space)
        assert model.nxn_geom_pair_filtered.numpy().tolist() == [[PLANE, RING]]
        assert contacts.geoms.numpy().tolist() == [PEG, RING]
        assert contacts.scene.broad_phase().tolist() in ([], [[0, 1], [2, 3]])
        host = space["build"]()
        host.geom_contype[PEG] = host.geom_conaffinity[PEG] = 2
        refused(ValueError, "no two mesh geoms may touch", put, host, 2, space)
        host = space["build"]()
        host.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
        refused(ValueError, "turn off the flag sleep", put, host, 2, space)
