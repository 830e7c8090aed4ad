"""Newton turns nuts down their bolts, by contacts between the threads themselves; no field of distances is made.

Each nut is alone with its bolt in a world. A motor turns it, blows of a hammer push it: it must follow the pitch and
jump no thread. Nuts start at angles of their own, and differ in speed and blows. The thread is generated, or read from
two files. Needs the extra `newton`, and `mujoco-warp` for MuJoCo:

    python scenes/interop/newton_nut_and_bolt.py [--solver xpbd|mujoco] [--nuts 100] [--turns 2] [--hammer 0.5]
    python scenes/interop/newton_nut_and_bolt.py --bolt bolt.obj --nut nut.obj --pitch 0.0025 --height 0.01
"""

import argparse
import itertools
import time

import numpy as np
import warp as wp

import warp_abtree as ab

RADIUS, PITCH, DEPTH = 0.01, 0.0025, 0.00135  # of the generated thread [m]
RATE = 240  # collision steps a second
SPEED, SPREAD = 2.0, 0.2  # turns a second of the motor, and by which part of it nuts differ
SETTLE = 24  # steps before the motor starts, and between blows
GAP = 5e-5  # [m] a shape, about what threads approach one another in a step; tight ones want less
POINTS = 32  # contact points of a nut and its bolt; with the usual 8 a nut tilts under blows


def thread_rows(sections, turns, extra):
    """Return points of a right-handed thread, (rows, sections, 3), `sections` rows a turn: facets follow the helix."""
    angle, height = np.arange(sections) / sections, np.arange(sections * turns + 1) / sections
    away = np.abs((height[:, None] - angle) % 1 - 0.5) * 2  # 0 on the crest, 1 in the root
    radius = RADIUS + extra - DEPTH * np.clip((away - 0.125) / 0.625, 0, 1)
    x, y = radius * np.cos(2 * np.pi * angle), radius * np.sin(2 * np.pi * angle)
    return np.stack([x, y, np.broadcast_to(PITCH * height[:, None], radius.shape)], -1)


def join_rings(lower, upper):
    """Return faces between two rings of vertices, outwards where they run anticlockwise and `upper` is above."""
    a, b, c, d = lower, np.roll(lower, -1), np.roll(upper, -1), upper
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def make_bolt(sections, turns):
    """Return vertices and faces of a threaded rod on the plane z = 0."""
    rows = thread_rows(sections, turns, 0.0)
    ring = np.arange(rows[..., 0].size).reshape(len(rows), sections)
    bottom, top = np.full(sections, ring.size), np.full(sections, ring.size + 1)
    faces = [join_rings(low, high) for low, high in itertools.pairwise(ring)]
    faces += [np.stack([np.roll(ring[0], -1), ring[0], bottom], 1), np.stack([ring[-1], np.roll(ring[-1], -1), top], 1)]
    return np.concatenate([rows.reshape(-1, 3), [(0, 0, 0), (0, 0, PITCH * turns)]]), np.concatenate(faces)


def make_nut(sections, turns):
    """Return vertices and faces of a round nut; its thread is wider than the bolt's by more than chords ask."""
    rows = thread_rows(sections, turns, 1.4 * RADIUS * (1 - np.cos(np.pi / sections)) + 1e-4)
    angle = 2 * np.pi * np.arange(sections) / sections
    wall = np.stack([1.6 * RADIUS * np.cos(angle), 1.6 * RADIUS * np.sin(angle), 0 * angle], 1)
    ring = np.arange(rows[..., 0].size).reshape(len(rows), sections)
    low, high = ring.size + np.arange(sections), ring.size + sections + np.arange(sections)
    faces = [join_rings(a, b)[:, ::-1] for a, b in itertools.pairwise(ring)]
    faces += [join_rings(low, high), join_rings(high, ring[-1]), join_rings(ring[0], low)]
    return np.concatenate([rows.reshape(-1, 3), wall, wall + (0, 0, PITCH * turns)]), np.concatenate(faces)


def find_height(bolt, nut, pitch, height):
    """Return the middle of the widest range of heights, from a given one on, at which a nut is free on its bolt."""
    poses = np.tile(np.eye(4), (2001, 1, 1))
    poses[:, 2, 3] = height + np.linspace(0, 1.5 * pitch, 2001)
    free = np.flatnonzero(~ab.sweep(bolt, nut, poses, output="any"))
    if not len(free):
        raise ValueError(f"the nut crosses the bolt at every height from {height} to {height + 1.5 * pitch}")
    ranges = np.split(free, np.flatnonzero(np.diff(free) > 1) + 1)
    return poses[max(ranges, key=len), 2, 3].mean()


def build_model(bolt, nut, height, pitch, nuts, device, gap=GAP):
    """Return a `newton.Model` of worlds with a bolt that stands and a nut that is free, each at another angle."""
    import newton

    config = newton.ModelBuilder.ShapeConfig(density=8000.0, mu=0.1, ke=1e7, kd=1e4, gap=gap)
    builder, meshes = newton.ModelBuilder(), []
    for model in (bolt, nut):
        vertices, faces = model.mesh_at(model.lod_max)[:2]
        meshes.append(newton.Mesh(vertices.astype(np.float32), faces.ravel()))
    for k in range(nuts):
        world, turn = newton.ModelBuilder(), 0.618 * k % 1
        spin = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), 2 * np.pi * turn)
        world.add_shape_mesh(-1, mesh=meshes[0], cfg=config)
        body = world.add_body(xform=wp.transform((0.0, 0.0, height + pitch * turn), spin))
        world.add_shape_mesh(body, mesh=meshes[1], cfg=config)
        builder.add_world(world)
    return builder.finalize(device=device)


def make_solver(name, model):
    """Return a solver and its steps a collision step, as threads need them."""
    import newton

    if name == "xpbd":  # a correction becomes a velocity, more so in short steps: few steps of many iterations
        return newton.solvers.SolverXPBD(model, iterations=40), 1
    options = dict(solver="newton", integrator="implicitfast", cone="elliptic", iterations=30)
    room = dict(njmax=4 * POINTS, nconmax=POINTS)
    # Without speculative contacts, those that are still apart would not count.
    speculative = dict(use_mujoco_contacts=False, use_speculative_contacts=True)
    return newton.solvers.SolverMuJoCo(model, **options, **room, **speculative), 4


@wp.kernel
def drive_nut_kernel(
    step: wp.float32,
    drive: wp.array(dtype=wp.float32),
    speed: wp.array(dtype=wp.float32),
    blow: wp.array(dtype=wp.float32),
    mass: wp.array(dtype=wp.float32),
    inertia: wp.array(dtype=wp.mat33),
    body_qd: wp.array(dtype=wp.spatial_vector),
    body_f_out: wp.array(dtype=wp.spatial_vector),
):
    """Pull a nut to its motor's speed, by a part drive[0] a step, and add drive[1] of the downward speed of a blow."""
    i = wp.tid()
    push = -drive[1] * blow[i] * mass[i] / step
    torque = drive[0] * (speed[i] - body_qd[i][5]) * inertia[i][2, 2] / step
    body_f_out[i] = wp.spatial_vector(0.0, 0.0, push, 0.0, 0.0, torque)


class Nuts:
    """Nuts that turn on their bolts.

    Attributes:
        turned, sunk: Turns of each nut, and how far it went up [m], since the motor started, (n,).
        lag: How far each was at most from where its thread leads [m].
    """

    def __init__(self, model, bolt, nut, solver, pitch, hammer=0.0, seed=0, tolerance=None):
        self.model, self.pitch = model, pitch
        shapes = {shape: (bolt, nut)[shape % 2] for shape in range(model.shape_count)}
        self.found = ab.NewtonContacts(model, models=shapes, points=POINTS)
        if tolerance is not None:
            self.found.scene.set_lods([shapes[shape].lod_for(tolerance=tolerance) for shape in range(len(shapes))])
        self.contacts, self.control = self.found.contacts(), model.control()
        self.solver, self.substeps = make_solver(solver, model)
        self.state, self.after, self.before = (model.state() for _ in range(3))
        rng, n = np.random.default_rng(seed), model.body_count
        speed = -2 * np.pi * SPEED * rng.uniform(1 - SPREAD, 1 + SPREAD, n)
        columns = speed, hammer * rng.uniform(0.5, 1.5, n), np.zeros(2)
        self.speed, self.blow, self.drive = (wp.array(c, dtype=wp.float32, device=model.device) for c in columns)
        self.graph = None
        self.begin()

    def begin(self):
        """Count from here."""
        self.start = self.last = self.state.body_q.numpy().copy()
        self.turned, self.sunk, self.lag = (np.zeros(len(self.start)) for _ in range(3))

    def simulate(self):
        """Find contacts once, and step the solver. On CUDA this is captured."""
        step = 1 / RATE / self.substeps
        model, state = self.model, self.state
        self.found.collide(state, self.contacts)
        for _ in range(self.substeps):
            state.clear_forces()
            inputs = [step, self.drive, self.speed, self.blow, model.body_mass, model.body_inertia]
            wp.launch(drive_nut_kernel, model.body_count, [*inputs, state.body_qd, state.body_f], device=model.device)
            self.solver.step(state, self.after, self.control, self.contacts, step)
            state.assign(self.after)

    def step(self, gain, blow):
        """Advance by a collision step, and measure. Waits for the device."""
        self.drive.assign([gain, blow / self.substeps])
        if self.graph is None:
            self.simulate()
        else:
            self.before.assign(self.state)
            wp.capture_launch(self.graph)
            try:
                self.found.check(self.contacts)
            except ab.CapacityError:  # again, with more room
                self.state.assign(self.before)
                self.simulate()
                self.capture()
        pose = self.state.body_q.numpy().copy()
        turn = 2 * np.arctan2(pose[:, 5], pose[:, 6]) - 2 * np.arctan2(self.last[:, 5], self.last[:, 6])
        self.turned += ((turn + np.pi) % (2 * np.pi) - np.pi) / (2 * np.pi)
        self.sunk, self.last = pose[:, 2] - self.start[:, 2], pose
        self.lag = np.maximum(self.lag, np.abs(self.sunk - self.pitch * self.turned))

    def capture(self):
        """Make a graph of a step, on CUDA, after some that have made room."""
        if self.model.device.is_cuda:
            with wp.ScopedCapture(self.model.device) as capture:
                self.simulate()
            self.graph = capture.graph

    def run(self, turns):
        """Settle, and turn by about so much under blows."""
        for _ in range(SETTLE):
            self.step(0.0, 0.0)
        self.capture()
        self.begin()
        for k in range(round(turns / SPEED * RATE)):
            self.step(0.5, float(k % SETTLE == SETTLE // 2))
        self.found.check(self.contacts)

    def travel(self):
        """Return how far each nut went, over what its thread says, (n,)."""
        return self.sunk / (self.pitch * self.turned)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--solver", choices=["xpbd", "mujoco"], default="xpbd")
    parser.add_argument("--device", default=None)
    parser.add_argument("--nuts", type=int, default=4)
    parser.add_argument("--turns", type=float, default=2.0)
    parser.add_argument("--hammer", type=float, default=0.5, help="mean downward speed of a blow [m/s], ten a second")
    parser.add_argument("--seed", type=int, default=0, help="of speeds and blows")
    parser.add_argument("--sections", type=int, default=24, help="of the generated thread")
    parser.add_argument("--bolt", help="mesh file, with --nut; both about z, in metres")
    parser.add_argument("--nut")
    parser.add_argument("--pitch", type=float, default=PITCH)
    parser.add_argument("--gap", type=float, default=GAP, help="of a shape, within which there are contacts [m]")
    parser.add_argument("--height", type=float, default=2 * PITCH, help="of the nut, about [m]")
    parser.add_argument("--tolerance", type=float, help="certified, of the LODs that meet [m]; all faces without it")
    options = parser.parse_args()
    if options.bolt:
        bolt, nut = ab.Model.load(options.bolt), ab.Model.load(options.nut)
    else:
        parts = make_bolt(options.sections, 6), make_nut(options.sections, 3)
        bolt, nut = (ab.Model.from_arrays(*part) for part in parts)
    height = find_height(bolt, nut, options.pitch, options.height)
    model = build_model(bolt, nut, height, options.pitch, options.nuts, options.device, options.gap)
    nuts = Nuts(model, bolt, nut, options.solver, options.pitch, options.hammer, options.seed, options.tolerance)
    begin = time.perf_counter()
    nuts.run(options.turns)
    spent = time.perf_counter() - begin
    travel, through = nuts.travel(), nuts.lag > options.pitch / 2
    print(
        f"{options.nuts} nuts of {nut.face_count} faces on bolts of {bolt.face_count}, {options.solver}: {spent:.1f} s"
    )
    print(f"turned {-nuts.turned.max():.2f} to {-nuts.turned.min():.2f} times", end="; ")
    print(f"went {travel.min():.3f} to {travel.max():.3f} of the pitch's way", end="; ")
    print(f"within 5 %: {(np.abs(travel - 1) <= 0.05).sum()}")
    print(f"off the thread by {1e6 * nuts.lag.max():.0f} um at most; through a thread: {through.sum()}")


if __name__ == "__main__":
    main()
