"""Scenes and made-up loads that tests of LOD selection start from."""

from functools import cache
from types import SimpleNamespace

import numpy as np
import trimesh

import warp_abtree as ab
from warp_abtree.lod.controllers import Feedback


@cache
def selection_models():
    """Return a ring, a ball off its origin, and a box."""
    ring = trimesh.creation.torus(major_radius=0.5, minor_radius=0.2, major_sections=24, minor_sections=12)
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.4)
    ball.apply_translation([0.3, -0.2, 0.1])
    return ab.Model.load(ring), ab.Model.load(ball), ab.Model.load(trimesh.creation.box(), base_faces=6)


def strewn(models, count, device, seed=0):
    """Return a scene with objects of all models and importances at random places."""
    rng = np.random.default_rng(seed)
    scene = ab.Scene(device=device)
    for i in range(count):
        turn = rng.normal(size=4)
        pose = np.concatenate([rng.uniform(-4, 4, 3), turn / np.linalg.norm(turn)])
        scene.add(models[i % len(models)], pose, importance=1 + i // len(models) % 3)
    return scene


class Plant:
    """A load whose cost is a function of the LODs: pairs of neighbours, each with tests as a power of its faces.

    Args:
        finest_ms: Time of the tests where all LODs are the finest and the load is 1 [ms].
    """

    def __init__(self, models, finest_ms=20.0, count=40, exponent=0.55):
        self.scene, self.exponent = ab.Scene(device="cpu"), exponent
        for i in range(count):
            self.scene.add(models[i % 2])
        self.pairs = np.stack([np.arange(count - 1), np.arange(1, count)], 1)
        self.rows, self.heard, self.lods = [], {}, self.scene.lods * 0
        self.load = 1e4 * finest_ms / self._tests([models[i % 2].face_count for i in range(count)]).sum()

    def _tests(self, faces):
        return 0.5 * (np.array(faces, float)[self.pairs] ** self.exponent).sum(1)

    def step(self, controller, load=1.0, hitch=1.0):
        """Run a frame: load scales all tests, hitch the time that they take."""
        time = len(self.rows) / 60
        lods = controller.next_lods(Feedback(time, **self.heard)).numpy().astype(int)
        models = [self.scene.models[m] for m in self.scene.object_model]
        faces = [model.progressive.active_count(lod) for model, lod in zip(models, lods.tolist())]
        tests = load * self.load * self._tests(faces)
        changed = not np.array_equal(lods, self.lods)
        stage_ms = {"select_ms": 0.05, "refine_ms": 0.3 * changed, "broad_ms": 0.1, "query_ms": 0.2 + tests.sum() / 1e4}
        stage_ms["query_ms"] *= hitch
        result = SimpleNamespace(pairs=self.pairs, node_tests=tests, triangle_tests=0 * tests)
        self.heard = {"stage_ms": stage_ms, "nodes_refitted": 0, "lods_changed": changed, "result": result}
        self.lods = lods
        errors = [model.error_at(lod) for model, lod in zip(models, lods.tolist())]
        row = {"frame": len(self.rows), "time": time, "objects": len(lods), "budget_ms": controller.budget_ms}
        row |= {"cost_ms": sum(stage_ms.values()), "error_mean": float(np.mean(errors)), "oscillations": 0}
        self.rows.append(SimpleNamespace(**row))

    def run(self, controller, frames, load=1.0, hitch=1.0):
        """Run frames, and return the costs of all so far [ms]."""
        for _ in range(frames):
            self.step(controller, load, hitch)
        return np.array([row.cost_ms for row in self.rows])
