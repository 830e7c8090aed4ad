"""Spheres in the place of a robot's links, as planners have them, made here; and how often they answer wrongly.

How the cover is made, so that its errors are those of spheres and not of a bad cover:

* A link is solid where its meshes wind around a point by more than half, on a grid. Candidates for centres are points
  of the grid whose ball, as deep as they lie, is in no other's (the medial axis), and points of the surface.
* A candidate covers a piece of surface by sticking out of the solid by: the distance of its farthest corner less the
  candidate's depth. What is minimised is the most that any sphere sticks out, its margin.
* The next sphere goes to the link with the largest margin, where its worst piece is (farthest first); now and then
  pieces go to the sphere that sticks out least for them, and each sphere to the candidate that is best for its pieces
  (Lloyd). Links share a number of spheres, so that none has a worse margin than need be.
* Every triangle of each link, cut to short edges, then lies wholly in a sphere: a cover is conservative, it misses
  nothing. A radius is no larger than that takes.

Models that are published, as those of cuRobo, are tuned by hand and not conservative; they are not measured here. That
radii may be smaller, for fewer false alarms and some contacts missed, is shown by the same spheres less half of what
they stick out.
"""

import numpy as np
import trimesh
import warp as wp
from scipy.ndimage import distance_transform_edt
from scipy.spatial.distance import cdist

import warp_abtree as ab

GRID, PIECE = 0.003, 0.005  # [m]: of the grid, and edges of pieces
CANDIDATES = 2500  # on the medial axis of a link
GROWTH, ROUNDS = 1.2, 12  # spheres of a link between two Lloyd steps, and rounds of one
ROUNDING = 1e-6  # [m], of float32 positions


@wp.kernel
def is_inside_kernel(mesh: wp.uint64, points: wp.array(dtype=wp.vec3), inside_out: wp.array(dtype=wp.uint8)):
    i = wp.tid()
    query = wp.mesh_query_point_sign_winding_number(mesh, points[i], 1.0e6, 2.0, 0.5)
    inside_out[i] = wp.uint8(wp.where(query.sign < 0.0, 1, 0))


@wp.kernel
def meet_world_kernel(
    mesh: wp.uint64,
    poses: wp.array2d(dtype=wp.mat44d),
    link: wp.array(dtype=wp.int32),
    centre: wp.array(dtype=wp.vec3d),
    radius: wp.array(dtype=wp.float64),
    hit_out: wp.array(dtype=wp.uint8),
):
    """Note the configurations at which a sphere is nearer to a mesh than its radius."""
    i = wp.tid()
    for k in range(link.shape[0]):
        at = wp.vec3(wp.transform_point(poses[i, link[k]], centre[k]))
        query = wp.mesh_query_point_no_sign(mesh, at, wp.float32(radius[k]))
        if query.result:
            hit_out[i] = wp.uint8(1)
            return


@wp.kernel
def meet_selves_kernel(
    pairs: wp.array(dtype=wp.vec4i),
    poses: wp.array2d(dtype=wp.mat44d),
    link: wp.array(dtype=wp.int32),
    centre: wp.array(dtype=wp.vec3d),
    radius: wp.array(dtype=wp.float64),
    hit_out: wp.array2d(dtype=wp.uint8),
):
    """Note the pairs of links, as ranges of spheres, that overlap at each configuration."""
    i, p = wp.tid()
    pair = pairs[p]
    for a in range(pair[0], pair[1]):
        at = wp.transform_point(poses[i, link[a]], centre[a])
        for b in range(pair[2], pair[3]):
            apart = wp.length(at - wp.transform_point(poses[i, link[b]], centre[b]))
            if apart <= radius[a] + radius[b]:
                hit_out[i, p] = wp.uint8(1)
                return


def thin(points, size):
    """Return indices of points, one in each cell of a size."""
    return np.unique(np.floor(points / size).astype(np.int64), axis=0, return_index=True)[1]


def find_medial_axis(vertices, faces, grid):
    """Return points inside a mesh whose balls are in no other's, (n, 3), and how deep they lie, (n,)."""
    mesh = wp.Mesh(
        wp.array(vertices, dtype=wp.vec3, device="cpu"),
        wp.array(faces.ravel(), dtype=wp.int32, device="cpu"),
        support_winding_number=True,
    )
    low, high = vertices.min(0) - 2 * grid, vertices.max(0) + 3 * grid
    points = np.stack(np.meshgrid(*(np.arange(*span, grid) for span in zip(low, high)), indexing="ij"), -1)
    inside = wp.zeros(points.size // 3, dtype=wp.uint8, device="cpu")
    at = wp.array(points.reshape(-1, 3), dtype=wp.vec3, device="cpu")
    wp.launch(is_inside_kernel, len(at), [mesh.id, at, inside], device="cpu")
    solid = inside.numpy().reshape(points.shape[:3]) != 0
    depth = grid * distance_transform_edt(solid)  # the grid's border is outside
    alone = solid.copy()
    for step in np.array(list(np.ndindex(3, 3, 3))) - 1:
        if step.any():
            alone &= np.roll(depth, step, (0, 1, 2)) < depth + 0.9 * grid * np.linalg.norm(step)
    # The nearest point outside is up to a cell away from the surface.
    return points[alone], np.maximum(depth[alone] - grid, 0.0)


class LinkCover:
    """Spheres that cover a link.

    Attributes:
        margin: How far they stick out [m].
    """

    def __init__(self, vertices, faces, scale, rng):
        corners, cut = trimesh.remesh.subdivide_to_size(vertices, faces, PIECE * scale, max_iter=20)
        self.pieces = corners[cut]
        inner, depth = find_medial_axis(vertices, faces, GRID * scale)
        some = rng.permutation(len(inner))[:CANDIDATES]
        outer = corners[thin(corners, PIECE * scale)]
        self.centre = np.concatenate([inner[some], outer])
        self.depth = np.concatenate([depth[some], np.zeros(len(outer))])
        looked = self.pieces[thin(self.pieces.mean(1), PIECE * scale)]
        self._cost = (self._reach(looked, self.centre) - self.depth).astype(np.float32)
        self.chosen, self._settled = [int(self._cost.max(0).argmin())], 1
        self._note()

    @staticmethod
    def _reach(pieces, centres):
        return np.maximum.reduce([cdist(pieces[:, k], centres) for k in range(3)])

    def _note(self):
        least = self._cost[:, self.chosen].min(1)
        self._worst, self.margin = int(least.argmax()), float(least.max())

    def grow(self):
        """Add a sphere where it is needed most."""
        self.chosen.append(int(self._cost[self._worst].argmin()))
        self._note()
        if len(self.chosen) >= GROWTH * self._settled:
            self.settle()

    def settle(self):
        """Move spheres to where they stick out least for the pieces that are theirs."""
        best, owner = (self.margin, list(self.chosen)), None
        for _ in range(ROUNDS):
            before, owner = owner, self._cost[:, self.chosen].argmin(1)
            if np.array_equal(owner, before):
                break
            for k in np.unique(owner):
                self.chosen[k] = int(self._cost[owner == k].max(0).argmin())
            self._note()
            if self.margin < best[0]:
                best = self.margin, list(self.chosen)
        self.chosen, self._settled = best[1], len(self.chosen)
        self._note()

    def spheres(self):
        """Return centres, radii that cover every triangle, and how far each sticks out [m]."""
        centre, depth = self.centre[self.chosen], self.depth[self.chosen]
        reach = self._reach(self.pieces, centre)
        owner = (reach - depth).argmin(1)
        radius = np.zeros(len(centre))
        np.maximum.at(radius, owner, reach[np.arange(len(owner)), owner])
        used = radius > 0
        radius = radius[used] + ROUNDING
        return centre[used], radius, np.maximum(radius - depth[used], 0.0)


def grow_covers(robot, counts, scale):
    """Yield the covers of a robot's models as they have so many spheres together, for counts that rise."""
    rng = np.random.default_rng(0)
    covers = [LinkCover(*model.mesh_at(model.lod_max)[:2], scale, rng) for model in robot.models]
    for count in counts:
        while sum(len(cover.chosen) for cover in covers) < count:
            max(covers, key=lambda cover: cover.margin).grow()
        for cover in covers:
            cover.settle()
        yield covers


def joints_between(robot, i, j) -> int:
    """Return how many joints are between two models."""
    description = robot.description
    links = [description.links[robot.link_names[robot.model_link[k]]] for k in (i, j)]
    way = set(description.path(links[0])) ^ set(description.path(links[1]))
    return sum(description.frames[f].kind != "fixed" for f in way)


class SphereRobot:
    """Spheres of a robot, asked what the robot is asked."""

    def __init__(self, robot, mesh, spheres):
        self.robot, self.device = robot, robot.device
        upload = self._upload
        self.mesh = wp.Mesh(upload(mesh.vertices, wp.vec3), upload(mesh.faces.ravel(), wp.int32))
        self.ends = np.cumsum([0, *(len(centre) for centre, _ in spheres)])
        model = np.repeat(np.arange(len(spheres)), np.diff(self.ends))
        link, centre, radius = robot.model_link[model], *map(np.concatenate, zip(*spheres))
        moving = ~np.isin(link, robot.mounted)
        kinds = wp.int32, wp.vec3d, wp.float64
        self.all, self.moving = (
            [upload(values[chosen], kind) for values, kind in zip((link, centre, radius), kinds)]
            for chosen in (slice(None), moving)
        )

    def _upload(self, values, dtype):
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.device)

    def check(self, poses):
        """Return which configurations meet the surroundings (c,), and which pairs of links meet (c, pairs)."""
        count, pairs, ends = len(poses), self.robot.pairs, self.ends
        around = wp.zeros(count, dtype=wp.uint8, device=self.device)
        wp.launch(meet_world_kernel, count, [self.mesh.id, poses, *self.moving, around], device=self.device)
        ranges = np.array([(ends[i], ends[i + 1], ends[j], ends[j + 1]) for i, j in pairs], np.int32).reshape(-1, 4)
        selves = wp.zeros((count, len(pairs)), dtype=wp.uint8, device=self.device)
        inputs = [self._upload(ranges, wp.vec4i), poses, *self.all, selves]
        wp.launch(meet_selves_kernel, selves.shape, inputs, device=self.device)
        return around.numpy() != 0, selves.numpy() != 0


def compare(found, exact) -> tuple[float, float]:
    """Return the fraction of the free ones that is called blocked, and of the blocked ones that is called free."""
    return tuple(round(float(values.mean()) if len(values) else 0.0, 4) for values in (found[~exact], ~found[exact]))


def run_spheres(robot, mesh, around, counts, posed, scale):
    """Yield a row for each number of spheres, and for radii as they cover, and less half of what they stick out.

    Args:
        mesh, around: What surrounds the robot, as trimesh and as `Model`.
        counts: Numbers of spheres of the whole robot, which rise.
        posed: Random configurations.
        scale: Of grid and pieces.
    """
    rows = np.random.default_rng(3).uniform(*robot.limits.T, (posed, len(robot.joint_names)))
    poses = robot.forward(rows)
    bare = ab.Robot(robot.description, robot.device, [robot.link_names[k] for k in robot.mounted])
    bare.pairs = bare.pairs[:0]
    exact_world, exact = bare.check(rows, around), robot.check(rows, around)
    apart = np.array([joints_between(robot, i, j) > 2 for i, j in robot.pairs])
    for covers in grow_covers(robot, counts, scale):
        made = [cover.spheres() for cover in covers]
        for less in (0.0, 0.5):
            spheres = [(centre, radius - less * out) for centre, radius, out in made]
            world, selves = SphereRobot(robot, mesh, spheres).check(poses)
            row = {"output": "spheres", "configurations": posed, "spheres": sum(len(c) for c, _ in spheres)}
            row |= {"less": less, "margin_mm": round(1e3 * float(max(out.max() for *_, out in made)), 1)}
            whole, far = world | selves.any(1), world | selves[:, apart].any(1)
            cases = {"world": (world, exact_world), "all": (whole, exact), "apart": (far, exact)}
            for name, (answers, truth) in cases.items():
                row[f"{name}_false"], row[f"{name}_missed"] = compare(answers, truth)
                row[f"{name}_wrong"] = round(float((answers != truth).mean()), 4)
            yield row | {"apart_pairs": int(apart.sum())}
