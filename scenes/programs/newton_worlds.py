"""256 worlds of Newton, in each a ring that falls over a peg a little aside: contacts between the meshes themselves.

python scenes/programs/newton_worlds.py draws four to newton_worlds.png (docs/programs.md); extra `newton`.
"""

import numpy as np
import trimesh
import warp as wp

import warp_abtree as ab
from warp_abtree.app import picture


def make_model(worlds, device):
    """Return a `newton.Model` of a floor and a peg that stand and a ring above in each world, and their meshes."""
    import newton

    floor = trimesh.creation.box((3, 3, 0.2), metadata={"name": "floor"})
    peg = trimesh.creation.cylinder(0.3, 1.5, sections=24, metadata={"name": "peg"})
    meshes = [floor, peg, trimesh.creation.torus(0.8, 0.25, 32, 16, metadata={"name": "ring"})]
    shapes = [newton.Mesh(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces).ravel()) for mesh in meshes]
    scene, rng = newton.ModelBuilder(), np.random.default_rng(0)
    for _ in range(worlds):
        builder = newton.ModelBuilder()
        builder.rigid_gap = 0.005  # [m] a shape: about what a ring falls in a step
        builder.add_shape_mesh(-1, xform=wp.transform((0.0, 0.0, -0.1), wp.quat_identity()), mesh=shapes[0])
        builder.add_shape_mesh(-1, xform=wp.transform((0.0, 0.0, 0.74), wp.quat_identity()), mesh=shapes[1])
        tilt = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), float(rng.uniform(-0.2, 0.2)))
        body = builder.add_body(xform=wp.transform((*rng.uniform(-0.3, 0.3, 2), 1.7), tilt))
        builder.add_shape_mesh(body, mesh=shapes[2])
        scene.add_world(builder)
    return scene.finalize(device=device), meshes


def main(worlds=256, seconds=2.0, png="newton_worlds.png", device=None):
    import newton

    model, meshes = make_model(worlds, device)
    found = ab.NewtonContacts(model)
    solver, contacts, control = newton.solvers.SolverXPBD(model, iterations=8), found.contacts(), model.control()
    state, after = model.state(), model.state()
    for _ in range(round(240 * seconds)):
        state.clear_forces()
        found.collide(state, contacts)
        solver.step(state, after, control, contacts, 1 / 240)
        state, after = after, state
    found.check(contacts)
    rings = state.body_q.numpy()
    around = (np.linalg.norm(rings[:, :2], axis=1) < 0.5) & (rings[:, 2] < 1.0)
    print(f"after {seconds} s {around.sum()} of {worlds} rings lie around their peg, {(~around).sum()} do not")
    scene, shown = ab.Scene(device), [ab.Model.load(mesh) for mesh in meshes]
    for k, ring in enumerate(rings[:4]):
        for part, pose in zip(shown, ((0, 0, -0.1, 0, 0, 0, 1), (0, 0, 0.74, 0, 0, 0, 1), ring)):
            scene.add(part, np.asarray(pose, float) + (3.2 * k, 0, 0, 0, 0, 0, 0))
    picture(scene, png, result=scene.intersect(np.empty((0, 2), int), "faces"))  # no faces coloured
    return rings, around


if __name__ == "__main__":
    main()
