"""python docs/robot_figure.py: draw the picture of howto_robot.md anew, from the page's own sample."""

import re
import tempfile
from contextlib import chdir
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

FOLDER = Path(__file__).parent
FREE, BLOCKED, AROUND = "#3b76c4", "#d4472f", "#c9ccd1"


def shaded(triangles, colour, alpha=1.0):
    return Poly3DCollection(triangles, facecolors=colour, shade=True, alpha=alpha, linewidths=0)


def main():
    space: dict = {}
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        for block in re.findall(r"```python\n(.*?)```", (FOLDER / "howto_robot.md").read_text(encoding="utf-8"), re.S):
            exec(block, space)
    robot, scene, rows, blocked = (space[name] for name in ("robot", "scene", "configurations", "blocked"))
    alone = robot.check(rows)
    # Arms that reach for the shelf and the ring freely, and one that meets the shelf.
    tips = robot.forward(rows).numpy()[:, -1, :3, 3]
    wanted = [((0.62, -0.25, 0.5), ~blocked), ((-0.55, 0, 0.62), ~blocked), ((0.6, 0.25, 0.32), blocked & ~alone)]
    chosen = [np.where(fine, np.linalg.norm(tips - place, axis=1), np.inf).argmin() for place, fine in wanted]
    figure = Figure(figsize=(6, 3.6))
    axes = figure.add_axes((-0.3, -0.45, 1.6, 1.9), projection="3d")
    placed = scene.batch().objects.pool
    for k, m in enumerate(scene.object_model):
        vertices, faces, _ = scene.models[m].mesh_at(scene.lods[k])
        axes.add_collection3d(
            shaded((vertices @ placed.rotation.numpy()[k].T + placed.position.numpy()[k])[faces], AROUND, 0.55)
        )
    for i in chosen:
        poses = robot.forward(rows[i : i + 1]).numpy()[0][robot.model_link]
        for model, pose in zip(robot.models, poses):
            vertices, faces, _ = model.mesh_at(model.lod_max)
            triangles = (vertices @ pose[:3, :3].T + pose[:3, 3])[faces]
            axes.add_collection3d(shaded(triangles, BLOCKED if blocked[i] else FREE))
    axes.set(xlim=(-0.7, 0.95), ylim=(-0.45, 0.45), zlim=(0, 0.9))
    axes.set_box_aspect((1.65, 0.9, 0.9), zoom=0.93)
    axes.view_init(22, -62)
    axes.set_axis_off()
    figure.savefig(FOLDER / "robot.png", dpi=110)


if __name__ == "__main__":
    main()
