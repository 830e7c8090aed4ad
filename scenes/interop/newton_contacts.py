"""Newton moves rings that fall over a peg; their contacts are found here, between the meshes themselves.

Newton 1.8's own pipeline threads the rings too, by edges against a BVH, or by fields of distances made beforehand on
CUDA. Needs the extra `newton`:

    python scenes/interop/newton_contacts.py [--device cpu] [--rings 6] [--seconds 3]
"""

import argparse

import numpy as np
import trimesh
import warp as wp

import warp_abtree as ab


def build_model(rings, device):
    """Return a `newton.Model` of a floor and a peg that stand, and rings that wait above, a bit aslant."""
    import newton

    def mesh_of(shape):
        return newton.Mesh(np.asarray(shape.vertices, np.float32), np.asarray(shape.faces).ravel())

    builder = newton.ModelBuilder()
    builder.rigid_gap = 0.005  # [m] a shape: what a ring falls in a step; Newton's 0.1 makes very many contacts
    floor, peg = trimesh.creation.box((8, 8, 1)), trimesh.creation.cylinder(0.3, 4.0, sections=16)
    builder.add_shape_mesh(-1, xform=wp.transform((0.0, 0.0, -0.5), wp.quat_identity()), mesh=mesh_of(floor))
    builder.add_shape_mesh(-1, xform=wp.transform((0.0, 0.0, 1.99), wp.quat_identity()), mesh=mesh_of(peg))
    ring = mesh_of(trimesh.creation.torus(0.8, 0.25, 24, 12))
    for k in range(rings):
        tilt = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 0.15 * (-1) ** k)
        body = builder.add_body(xform=wp.transform((0.1 * (-1) ** k, 0.0, 1.0 + 0.7 * k), tilt))
        builder.add_shape_mesh(body, mesh=ring)
    return builder.finalize(device=device)


def main():
    import newton

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default=None)
    parser.add_argument("--rings", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=3.0)
    arguments = parser.parse_args()
    model = build_model(arguments.rings, arguments.device)
    found = ab.NewtonContacts(model)
    solver, contacts, control = newton.solvers.SolverXPBD(model, iterations=8), found.contacts(), model.control()
    state, after = model.state(), model.state()
    rate = 240
    for step in range(round(arguments.seconds * rate) + 1):
        if step % (rate // 2) == 0:
            heights = " ".join(f"{z:5.2f}" for z in state.body_q.numpy()[:, 2])
            print(
                f"{step / rate:4.1f} s  {int(contacts.rigid_contact_count.numpy()[0]):3d} contacts  heights {heights}"
            )
        state.clear_forces()
        found.collide(state, contacts)
        solver.step(state, after, control, contacts, 1 / rate)
        state, after = after, state


if __name__ == "__main__":
    main()
