"""Sphere models of the robot benchmark: covers leave nothing out, and spheres are tested as spheres are."""

import numpy as np
import trimesh
from helpers.robots import described_arm, pose_frames, random_configurations

import warp_abtree as ab
from bench.motions.spheres import LinkCover, SphereRobot, grow_covers, joints_between


def test_spheres_cover_every_point_and_their_margin_falls():
    mesh = trimesh.util.concatenate([trimesh.creation.capsule(0.3, 0.05), trimesh.creation.box((0.2, 0.06, 0.04))])
    cover, points, margins = LinkCover(mesh.vertices, mesh.faces, 2, np.random.default_rng(0)), mesh.sample(20_000), []
    for _ in range(12):
        cover.grow()
        centres, radii, out = cover.spheres()
        inside = radii - np.linalg.norm(points[:, None] - centres, axis=2)
        assert inside.max(1).min() >= 0
        # A radius is no larger than its own pieces take: less of it leaves something out.
        assert (inside.max(1) < 0.1 * radii.max()).any() and (radii > 0).all()
        margins.append(out.max())
    assert margins[-1] < 0.6 * margins[0] and len(radii) <= 13


def test_answers_of_spheres_are_those_of_their_distances():
    robot = ab.Robot(described_arm(), "cpu", mounted=["base"])
    # Its surface, of two sides, is what is met.
    plate = trimesh.creation.box((9, 9, 0.2), trimesh.transformations.translation_matrix((0, 0, 1.0)))
    (covers,) = grow_covers(robot, [12], 5)
    assert sum(len(cover.chosen) for cover in covers) == 12
    spheres = [cover.spheres()[:2] for cover in covers]
    rows = random_configurations(200, seed=3)
    around, selves = SphereRobot(robot, plate, spheres).check(robot.forward(rows))
    for row, meets, pairs in zip(rows, around, selves):
        posed = pose_frames(robot.description, row)[robot.model_link]
        at = [centres @ m[:3, :3].T + m[:3, 3] for m, (centres, _) in zip(posed, spheres)]
        gap = [np.abs(np.abs(x[:, 2] - 1.0) - 0.1) - radii for x, (_, radii) in zip(at, spheres)]
        moving = min(g.min() for g, link in zip(gap, robot.model_link) if link != 0)
        assert meets == (moving <= 0) or abs(moving) < 1e-5
        for (i, j), found in zip(robot.pairs, pairs):
            apart = np.linalg.norm(at[i][:, None] - at[j], axis=2) - spheres[i][1][:, None] - spheres[j][1]
            assert found == (apart.min() <= 0) or abs(apart.min()) < 1e-9
    assert 0 < around.mean() < 1 and 0 < selves.mean() < 1


def test_joints_between_links_are_counted_along_the_chain():
    robot = ab.Robot(described_arm(), "cpu")
    names = [robot.link_names[k] for k in robot.model_link]
    for a, b, count in (("base", "upper", 1), ("base", "fore", 2), ("left", "right", 2), ("base", "left", 3)):
        assert joints_between(robot, names.index(a), names.index(b)) == count
