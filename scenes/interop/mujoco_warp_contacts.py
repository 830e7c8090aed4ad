"""mujoco_warp moves rings that fall over a peg; their contacts are found here and written into `d.contact`.

MuJoCo takes a mesh by its convex hull, on which a ring stays lying on the peg. Mesh geoms alone have contacts here: a
floor is a mesh, too. Needs mujoco_warp 4:

    python scenes/interop/mujoco_warp_contacts.py [--device cpu] [--worlds 4] [--seconds 2]
"""

import argparse

import numpy as np
import trimesh
import warp as wp

import warp_abtree as ab

vec5 = wp.types.vector(length=5, dtype=wp.float32)
FIELDS = "dist pos frame includemargin friction solref solreffriction solimp dim geom efc_address worldid type".split()


@wp.struct
class ContactRows:
    """Rows of `mujoco_warp.Contact`, how many there are, and what each geom gives them."""

    dist: wp.array(dtype=wp.float32)
    pos: wp.array(dtype=wp.vec3)
    frame: wp.array(dtype=wp.mat33)
    includemargin: wp.array(dtype=wp.float32)
    friction: wp.array(dtype=vec5)
    solref: wp.array(dtype=wp.vec2)
    solreffriction: wp.array(dtype=wp.vec2)
    solimp: wp.array(dtype=vec5)
    dim: wp.array(dtype=wp.int32)
    geom: wp.array(dtype=wp.vec2i)
    efc_address: wp.array2d(dtype=wp.int32)
    worldid: wp.array(dtype=wp.int32)
    type: wp.array(dtype=wp.int32)
    count: wp.array(dtype=wp.int32)  # nacon
    geom_friction: wp.array(dtype=wp.vec3)
    geom_solref: wp.array(dtype=wp.vec2)
    geom_solimp: wp.array(dtype=vec5)


@wp.kernel
def pose_geom_kernel(
    geoms: wp.array(dtype=wp.int32),
    xpos: wp.array2d(dtype=wp.vec3),
    xmat: wp.array2d(dtype=wp.mat33),
    poses_out: wp.array2d(dtype=wp.float64),
):
    """Write the pose of each geom of each world, objects world by world."""
    world, k = wp.tid()
    x, q = xpos[world, geoms[k]], wp.normalize(wp.quat_from_matrix(xmat[world, geoms[k]]))
    i = world * geoms.shape[0] + k
    for axis in range(3):
        poses_out[i, axis] = wp.float64(x[axis])
    for part in range(4):
        poses_out[i, 3 + part] = wp.float64(q[part])


@wp.kernel
def write_point_kernel(
    geoms: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.vec2i),
    count: wp.array(dtype=wp.int32),
    point: wp.array2d(dtype=wp.vec3d),
    normal: wp.array2d(dtype=wp.vec3d),
    depth: wp.array2d(dtype=wp.float64),
    rows_inout: ContactRows,
):
    """Write the points of one pair a thread."""
    p = wp.tid()
    first = wp.atomic_add(rows_inout.count, 0, count[p])
    a, b = geoms[pairs[p][0] % geoms.shape[0]], geoms[pairs[p][1] % geoms.shape[0]]
    for k in range(count[p]):
        at = first + k
        if at < rows_inout.dist.shape[0]:
            n = wp.normalize(wp.vec3(normal[p, k]))
            side = wp.normalize(
                wp.cross(n, wp.where(wp.abs(n[0]) < 0.5, wp.vec3(1.0, 0.0, 0.0), wp.vec3(0.0, 1.0, 0.0)))
            )
            slide = wp.max(rows_inout.geom_friction[a], rows_inout.geom_friction[b])
            rows_inout.dist[at] = -wp.float32(depth[p, k])
            rows_inout.pos[at] = wp.vec3(point[p, k])
            rows_inout.frame[at] = wp.matrix_from_rows(n, side, wp.cross(n, side))
            rows_inout.friction[at] = vec5(slide[0], slide[0], slide[1], slide[2], slide[2])
            rows_inout.solref[at] = rows_inout.geom_solref[a]
            rows_inout.solimp[at] = rows_inout.geom_solimp[a]
            rows_inout.solreffriction[at] = wp.vec2(0.0, 0.0)
            rows_inout.includemargin[at] = 0.0
            rows_inout.dim[at] = 3
            rows_inout.geom[at] = wp.vec2i(a, b)
            rows_inout.worldid[at] = pairs[p][0] / geoms.shape[0]
            rows_inout.type[at] = 1  # ContactType.CONSTRAINT
            for row in range(rows_inout.efc_address.shape[1]):
                rows_inout.efc_address[at, row] = -1


class MeshContacts:
    """Contacts of mesh geoms in the place of mujoco_warp's own.

    Args:
        host: `mujoco.MjModel`.
        model, data: `mujoco_warp.Model` and `Data` of it; `model.opt.run_collision_detection` is turned off.
        points: Most points of a pair of geoms.
    """

    def __init__(self, host, model, data, points=8):
        model.opt.run_collision_detection = False
        self.model, self.data = model, data
        meshes, geoms = {}, np.flatnonzero((host.geom_type == 7) & ((host.geom_contype | host.geom_conaffinity) != 0))
        self.scene, weld = ab.Scene(device=data.qpos.device), host.body_weldid[host.geom_bodyid[geoms]]
        for world in range(data.nworld):
            for g, body in zip(geoms, weld):
                i = host.geom_dataid[g]
                if i not in meshes:
                    start, first = host.mesh_vertadr[i], host.mesh_faceadr[i]
                    vertices = host.mesh_vert[start : start + host.mesh_vertnum[i]]
                    meshes[i] = ab.Model.from_arrays(vertices, host.mesh_face[first : first + host.mesh_facenum[i]])
                # Of solids, what has gone under whole keeps its depth.
                solid = meshes[i].winding.is_closed
                self.scene.add(meshes[i], world=world, static=bool(body == 0), solid=solid)
        together = np.argwhere(np.triu(weld[:, None] == weld, 1))  # of one body, or of what stands
        for world in range(data.nworld):
            self.scene.filter(together + world * len(geoms))
        self.query, self.poses = ab.ManifoldQuery(self.scene, points=points), ab.PoseInput(self.scene)
        self.geoms = wp.array(geoms, dtype=wp.int32, device=self.scene.device)
        self.rows = ContactRows()
        for name in FIELDS:
            setattr(self.rows, name, getattr(data.contact, name))
        self.rows.count = data.nacon
        for name, kind in (("friction", wp.vec3), ("solref", wp.vec2), ("solimp", vec5)):
            values = wp.array(getattr(host, f"geom_{name}"), dtype=kind, device=self.scene.device)
            setattr(self.rows, f"geom_{name}", values)

    def collide(self):
        """Find the contacts where the geoms stand; `mujoco_warp.step` follows. Waits for the device."""
        import mujoco_warp as mjw

        mjw.kinematics(self.model, self.data)
        size, device = (self.data.nworld, len(self.geoms)), self.scene.device
        inputs = [self.geoms, self.data.geom_xpos, self.data.geom_xmat, self.poses.poses]
        wp.launch(pose_geom_kernel, size, inputs, device=device)
        self.poses.launch()
        self.query.grow()
        found = self.query.result(device=True)
        self.data.nacon.zero_()
        points = [found.points[name] for name in ("count", "point", "normal", "depth")]
        wp.launch(write_point_kernel, len(found.pairs), [self.geoms, found.pairs, *points, self.rows], device=device)


def build():
    """Return a `mujoco.MjModel` of a floor and a peg that stand, and a ring above, a bit aslant."""
    import mujoco

    shapes = {
        "floor": trimesh.creation.box((4, 4, 1)),
        "peg": trimesh.creation.cylinder(0.1, 0.8, sections=16),
        "ring": trimesh.creation.torus(0.3, 0.08, 24, 12),
    }
    spec = mujoco.MjSpec()
    spec.option.timestep = 1 / 240
    for name, shape in shapes.items():
        mesh = spec.add_mesh(name=name, uservert=shape.vertices.ravel(), userface=shape.faces.ravel())
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    for name, z in (("floor", -0.5), ("peg", 0.39)):
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, pos=(0, 0, z))
    ring = spec.worldbody.add_body(pos=(0.03, 0, 1.0), quat=(0.99875, 0.05, 0, 0))
    ring.add_freejoint()
    ring.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="ring", mass=1.0)
    return spec.compile()


def main(device=None, worlds=4, seconds=2.0):
    """Run the worlds; return the heights of the rings at the end, (worlds,)."""
    import mujoco
    import mujoco_warp as mjw

    host = build()
    start = mujoco.MjData(host)
    with wp.ScopedDevice(device):
        model, data = mjw.put_model(host), mjw.put_data(host, start, nworld=worlds, nconmax=64, njmax=256)
        contacts, rate = MeshContacts(host, model, data), round(1 / host.opt.timestep)
        for step in range(round(seconds * rate)):
            contacts.collide()
            if step % (rate // 2) == 0:
                heights = " ".join(f"{z:5.2f}" for z in data.qpos.numpy()[:, 2])
                print(f"{step / rate:4.1f} s  {int(data.nacon.numpy()[0]):3d} contacts  heights {heights}", flush=True)
            mjw.step(model, data)
        return data.qpos.numpy()[:, 2]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default=None)
    parser.add_argument("--worlds", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=2.0)
    main(**vars(parser.parse_args()))
