"""Nuts on bolts under blows, 240 steps a second: how many pass through a thread (`scenes/nut_and_bolt.toml`).

A nut that keeps to its thread rises with its turn by the pitch; one that is off that helix by half a pitch has gone
through. Without `continuous` all of them do.
"""

import time
from pathlib import Path

import numpy as np

from warp_abtree.app import load_scene

from ..timing import time_call

SCENE = Path(__file__).resolve().parents[2] / "scenes" / "nut_and_bolt.toml"
PITCH, WORLDS = 0.15, "worlds = 8"
STEPS = 24  # the blows arrive in the third and are over
LIMIT_S = 75


def turns_about_z(poses):
    """Return the angles of poses about z [rad]."""
    return 2 * np.arctan2(poses[:, 5], poses[:, 6])


def measure(worlds, device, steps=STEPS):
    """Return a row: nuts, steps done within a time, how far nuts were off their threads, and how many went through."""
    text = SCENE.read_text(encoding="utf-8")
    if WORLDS not in text:
        raise ValueError(f"{SCENE} has no line {WORLDS!r}")
    loaded = load_scene(SCENE, device=str(device), text=text.replace(WORLDS, f"worlds = {worlds}"))
    dynamics, nut = loaded.make_bodies(), loaded.models["nut"]
    scene = loaded.scene
    nuts = np.flatnonzero([scene.models[k] is nut for k in scene.object_model])
    start = last = dynamics.poses()[nuts]
    turned, off, times = np.zeros(len(nuts)), np.zeros(len(nuts)), []
    take_step, begin = time_call(lambda: dynamics.step(loaded.time_step), dynamics.device), time.perf_counter()
    while len(times) < steps and time.perf_counter() - begin < LIMIT_S:
        times.append(take_step())
        poses = dynamics.poses()[nuts]
        step = turns_about_z(poses) - turns_about_z(last)
        turned += (step + np.pi) % (2 * np.pi) - np.pi
        last = poses
        off = np.maximum(off, np.abs(poses[:, 2] - start[:, 2] - PITCH * turned / (2 * np.pi)))
    meet = scene.intersect(scene.broad_phase(), output="any").any
    row = {"nuts": len(nuts), "steps": len(times)}
    row |= {"tunnelled": (off > PITCH / 2).sum(), "off_max": off.max(), "pitch": PITCH}
    return row | {"meet_at_end": meet.sum(), "step_ms": np.median(times), "step_max_ms": max(times)}
