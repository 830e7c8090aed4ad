"""An arm that holds a cup in a cluttered shelf: which configurations are free, what blocks the others, a free way.

python scenes/programs/arm_in_a_shelf.py draws one to arm_in_a_shelf.png (docs/programs.md); extra `robot`.
"""

from pathlib import Path

import numpy as np
from trimesh import creation

import warp_abtree as ab
from warp_abtree.app import picture

LINK = '<link name="{}"><collision><origin xyz="0 0 {}"/><geometry><box size="{}"/></geometry></collision></link>'
JOINT = (
    '<joint name="{}" type="revolute"><parent link="{}"/><child link="{}"/><origin xyz="0 0 {}"/>'
    '<axis xyz="{}"/><limit lower="-2.6" upper="2.6" effort="1" velocity="1"/></joint>'
)
LINKS = [("base", 0.05, "0.2 0.2 0.1"), ("upper", 0.2, "0.08 0.08 0.38"), ("fore", 0.2, "0.06 0.06 0.34")]
LINKS += [("turntable", 0.1, "0.1 0.1 0.2"), ("hand", 0.05, "0.12 0.03 0.08")]
JOINTS = [("turn", "base", "turntable", 0.1, "0 0 1"), ("lift", "turntable", "upper", 0.2, "0 1 0")]
JOINTS += [("bend", "upper", "fore", 0.41, "0 1 0"), ("tilt", "fore", "hand", 0.38, "0 1 0")]


def load_arm(device):
    parts = [LINK.format(*link) for link in LINKS] + [JOINT.format(*joint) for joint in JOINTS]
    Path("arm.urdf").write_text(f'<robot name="arm">{"".join(parts)}</robot>')
    return ab.Robot.load("arm.urdf", device=device, mounted=["base"])


def make_shelf(device, rng):
    meshes = creation.box((0.4, 1.0, 0.02)), creation.cylinder(0.035, 0.12), creation.icosphere(3, 0.05)
    meshes[0].metadata["name"], meshes[1].metadata["name"], meshes[2].metadata["name"] = "board", "can", "ball"
    scene, (board, *models) = ab.Scene(device), map(ab.Model.load, meshes)
    for k, height in enumerate((0.2, 0.6, 1.0)):
        scene.add(board, (0.75, 0, height, 0, 0, 0, 1), name=f"board {k}")
        for i, y in enumerate(np.linspace(-0.4, 0.4, 6) + rng.uniform(-0.04, 0.04, 6)):
            pose = (0.75 + rng.uniform(-0.1, 0.1), y, height + (0.071, 0.061)[i % 2], 0, 0, 0, 1)
            scene.add(models[i % 2], pose, name=f"{('can', 'ball')[i % 2]} {k}{i}")
    return scene


def main(count=20_000, png="arm_in_a_shelf.png", device=None):
    rng, robot = np.random.default_rng(0), load_arm(device)
    shelf, cup = make_shelf(device, rng), ab.Model.load(creation.annulus(0.035, 0.04, 0.1))
    robot.attach(cup, "hand", (0, 0, 0.14, 0, 0.5**0.5, 0, 0.5**0.5), name="cup")
    configurations = rng.uniform(*robot.limits.T, (count, len(robot.joint_names)))
    free = configurations[~robot.check(configurations, shelf)]
    blocked = next(pairs for pairs in robot.check(configurations, shelf, which=True) if pairs)
    print(f"{len(free):,} of {count:,} configurations are free; of the others the first for {blocked}")
    inside = free[np.argmax(robot.forward(free).numpy()[:, -1, 0, 3])]  # the cup as far in as it comes
    edges = robot.check_edges(free[:1000], np.tile(inside, (len(free[:1000]), 1)), shelf)
    print(f"from {edges['clear'].sum():,} of 1,000 the straight way in joint space to where the cup is deepest is free")
    robot.add_to(shelf, inside)
    picture(shelf, png, eye=(-0.6, -1, 0.4))
    return free, edges


if __name__ == "__main__":
    main()
