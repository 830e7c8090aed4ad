"""A loop of one's own with 400 objects within 8 ms a frame: LODs are chosen by what it looks at, answers drive it.

python scenes/programs/own_loop.py draws the last frame to own_loop.png (docs/programs.md).
"""

import gc

import numpy as np
import trimesh

import warp_abtree as ab
from warp_abtree.app import picture

SIZE = 12.0  # of the cube in which objects fly [m]


class Swarm:
    """Objects that fly straight, bounce off walls, and slow down where they meet: a motion of `Frame`."""

    def __init__(self, count):
        rng = np.random.default_rng(0)
        self.position, self.velocity = rng.uniform(-SIZE / 2, SIZE / 2, (count, 3)), rng.normal(size=(count, 3))
        turn = rng.normal(size=(count, 4))
        self.turn, self.meetings = turn / np.linalg.norm(turn, axis=1, keepdims=True), 0

    def __len__(self):
        return len(self.position)

    def poses(self, time, out):
        return np.concatenate([self.position, self.turn], axis=1)

    def answer(self, result, time_step):
        self.meetings += int(result.any.sum())
        pace = np.full((len(self), 1), time_step)
        pace[np.unique(result.pairs[result.any])] *= 0.3  # what meets others slows down
        outside = np.abs(self.position) > SIZE / 2
        self.velocity[outside] = -np.sign(self.position[outside]) * np.abs(self.velocity[outside])
        self.position += pace * self.velocity


def main(count=400, frames=240, budget_ms=8.0, png="own_loop.png", device=None):
    ring, ball = trimesh.creation.torus(0.5, 0.18, 128, 64), trimesh.creation.icosphere(4, 0.5)
    ring.metadata["name"], ball.metadata["name"] = "ring", "ball"
    models = [ab.Model.load(ring), ab.Model.load(ball)]
    scene, swarm = ab.Scene(device), Swarm(count)
    scene.add_many([models[i % 2] for i in range(count)], swarm.poses(0.0, None))
    camera = ab.Camera.look_at((0, -1.2 * SIZE, 0.5 * SIZE), (0, 0, 0), (0, 0, 1))
    frame = ab.Frame(scene, swarm, ab.PredictiveController(scene, budget_ms, camera), "contacts", 1 / 60)
    frame.warm_up()
    gc.freeze()  # a full pass of the garbage collector takes longer than a frame
    rows = frame.run(frames)[frames // 4 :]
    within = np.mean([row.total_ms <= 1.1 * budget_ms for row in rows])
    print(f"{within:.0%} of frames within {budget_ms} ms and a tenth; {swarm.meetings:,} meetings,", end=" ")
    print(f"{rows[-1].faces:,} faces at LODs that are off by {rows[-1].error_mean:.2g} in the mean")
    picture(scene, png)
    return rows, swarm


if __name__ == "__main__":
    main()
