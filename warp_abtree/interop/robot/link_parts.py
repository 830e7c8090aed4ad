"""Parts of a robot as queries ask them: paddings, pairs, and the order of what is asked."""

import numpy as np

from warp_abtree.checks.arguments import finite_array, whole_number
from warp_abtree.checks.upload import struct_of
from warp_abtree.kernels.robot import link_pairs
from warp_abtree.state.batch import check_pairs


def padding_of(robot) -> np.ndarray:
    """Return the padding of each model of a robot, float64 (m,); raise TypeError or ValueError for a bad one."""
    given = robot.link_padding
    if not isinstance(given, dict):
        raise TypeError(f"link_padding: a {type(given).__name__} is no dict of distances by the names of links")
    for name, value in given.items():
        if name not in robot.link_names:
            raise ValueError(f"link_padding: the robot has no link {name!r}")
        if finite_array(value, f"link_padding of {name!r}", ()) < 0:
            raise ValueError(f"link_padding of {name!r}: {value} is below 0")
    return np.array([float(given.get(robot.link_names[k], 0.0)) for k in robot.model_link])


def tested_pairs(robot) -> np.ndarray:
    """Return the pairs of models that a robot tests against one another, checked."""
    return check_pairs(robot.pairs, len(robot.models), owner="the robot", kind="models")


def order_parts(robot, meets, padding) -> tuple[link_pairs.Parts, list[tuple[int, int]]]:
    """Return parts with the entries of what is asked, those of the outermost first, and the stages of entries.

    A stage (first, end) are the entries of a part, asked at once.
    """
    description, models = robot.description, robot.models
    frame = [description.links[robot.link_names[k]] for k in robot.model_link]
    paths = [description.path(f) for f in frame]
    entries, stages, pairs = [], [], tested_pairs(robot)
    mounted = {whole_number(k, "mounted", 0, len(robot.link_names) - 1) for k in robot.mounted}
    for k in sorted(range(len(frame)), key=lambda k: -len(paths[k])):
        first = len(entries)
        if len(meets) and robot.model_link[k] not in mounted:
            entries.append((k, -1, -1))
        for i, j in pairs[pairs[:, 1] == k].tolist():
            entries.append((j, i, max(set(paths[i]) & set(paths[j]), default=-1)))
        if len(entries) > first:
            stages.append((first, len(entries)))
    middles = [model.centre for model in models]
    vertices = [model.progressive.vertex_pos[: model.progressive.vertex_count] for model in models]
    parts = struct_of(
        link_pairs.Parts,
        robot.device,
        **dict(zip(("first", "second", "shared"), np.array(entries, np.int32).reshape(-1, 3).T)),
        meets=meets.astype(np.uint8),
        frame=frame,
        depth=[len(path) for path in paths],
        middle=middles,
        padding=padding * (1 + 2.0**-50),
        radius=[np.sqrt(((v - m) ** 2).sum(1).max()) * (1 + 2.0**-40) for v, m in zip(vertices, middles)],
    )
    return parts, stages or [(0, 0)]  # a launch is one even where there is nothing to ask
