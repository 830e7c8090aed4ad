"""mujoco_warp moves rings that fall over a peg; their contacts are found here and written into `d.contact`.

MuJoCo takes a mesh by its convex hull, on which a ring stays lying on the peg. Here pairs of mesh geoms have the
contact points of the meshes themselves; the floor is a plane, whose contacts stay MuJoCo's. Needs mujoco_warp
(3.11 or 4):

    python scenes/interop/mujoco_warp_contacts.py [--device cpu] [--worlds 4] [--seconds 2]
"""

import argparse

import numpy as np
import trimesh
import warp as wp

import warp_abtree as ab

vec5 = wp.types.vector(length=5, dtype=wp.float32)
FIELDS = "dist pos frame includemargin friction solref solreffriction solimp dim geom efc_address worldid type".split()
FIELDS += ["geomcollisionid", "adhesion", "surfacevel"]
MATERIALS = "condim friction solref solimp".split()


@wp.struct
class ContactRows:
    """Rows of `mujoco_warp.Contact`, how many there are, and what each geom gives them, by world or once for all."""

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
    geomcollisionid: wp.array(dtype=wp.int32)
    adhesion: wp.array(dtype=wp.float32)  # this and the next only from mujoco_warp 4 on
    surfacevel: wp.array(dtype=wp.vec3)
    count: wp.array(dtype=wp.int32)  # nacon
    geom_condim: wp.array(dtype=wp.int32)
    geom_friction: wp.array2d(dtype=wp.vec3)
    geom_solref: wp.array2d(dtype=wp.vec2)
    geom_solimp: wp.array2d(dtype=vec5)


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
    pair_count: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.vec2i),
    count: wp.array(dtype=wp.int32),
    point: wp.array2d(dtype=wp.vec3d),
    normal: wp.array2d(dtype=wp.vec3d),
    depth: wp.array2d(dtype=wp.float64),
    rows_inout: ContactRows,
):
    """Write the points of one pair a thread, behind the rows that are there."""
    p = wp.tid()
    if p >= pair_count[0]:
        return
    first = wp.atomic_add(rows_inout.count, 0, count[p])
    a, b = geoms[pairs[p][0] % geoms.shape[0]], geoms[pairs[p][1] % geoms.shape[0]]
    world = pairs[p][0] / geoms.shape[0]
    of_friction = rows_inout.geom_friction[world % rows_inout.geom_friction.shape[0]]
    slide = wp.max(of_friction[a], of_friction[b])
    for k in range(count[p]):
        at = first + k
        if at < rows_inout.dist.shape[0]:
            n = wp.normalize(wp.vec3(normal[p, k]))
            side = wp.normalize(
                wp.cross(n, wp.where(wp.abs(n[0]) < 0.5, wp.vec3(1.0, 0.0, 0.0), wp.vec3(0.0, 1.0, 0.0)))
            )
            rows_inout.dist[at] = -wp.float32(depth[p, k])
            rows_inout.pos[at] = wp.vec3(point[p, k])
            rows_inout.frame[at] = wp.matrix_from_rows(n, side, wp.cross(n, side))
            rows_inout.friction[at] = vec5(slide[0], slide[0], slide[1], slide[2], slide[2])
            rows_inout.solref[at] = rows_inout.geom_solref[world % rows_inout.geom_solref.shape[0], a]
            rows_inout.solimp[at] = rows_inout.geom_solimp[world % rows_inout.geom_solimp.shape[0], a]
            rows_inout.solreffriction[at] = wp.vec2(0.0, 0.0)
            rows_inout.includemargin[at] = 0.0
            rows_inout.dim[at] = wp.max(rows_inout.geom_condim[a], rows_inout.geom_condim[b])
            rows_inout.geom[at] = wp.vec2i(a, b)
            rows_inout.worldid[at] = world
            rows_inout.type[at] = 1  # ContactType.CONSTRAINT
            rows_inout.geomcollisionid[at] = k
            for row in range(rows_inout.efc_address.shape[1]):
                rows_inout.efc_address[at, row] = -1
            if rows_inout.adhesion:
                rows_inout.adhesion[at] = 0.0
            if rows_inout.surfacevel:
                rows_inout.surfacevel[at] = wp.vec3(0.0, 0.0, 0.0)


class MeshContacts:
    """Contacts of pairs of mesh geoms in the place of mujoco_warp's own, which stay for all other pairs.

    Masks and exclusions are MuJoCo's. Pairs that the file lists (`<pair>`) stay with mujoco_warp.

    Args:
        host: `mujoco.MjModel`.
        model, data: `mujoco_warp.Model` and `Data` of it. `model` loses the pairs and calls `collide` after its own
            collision detection, in every step; make graphs of its step after this.
        points: Most points of a pair of geoms.
        capacity: `warp_abtree.Buffers`, the room at first; steps make more, but not those that a graph replays.

    Raises:
        ValueError: No two mesh geoms may touch; or bodies may sleep, for which MuJoCo detects collisions twice a step.
    """

    def __init__(self, host, model, data, points=8, capacity=None):
        import mujoco

        if host.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
            raise ValueError("MeshContacts has no contacts of bodies that sleep; turn off the flag sleep")
        pairs, kinds = model.nxn_geom_pair.numpy(), model.nxn_pairid.numpy().copy()
        ours = (kinds[:, 0] == -1) & (host.geom_type[pairs] == 7).all(axis=1)
        if not ours.any():
            raise ValueError("no two mesh geoms may touch")
        kinds[ours, 0] = -2  # as MuJoCo marks pairs that may not touch; column 1 is that of its distance sensors
        kept = (kinds[:, 0] > -2) | (kinds[:, 1] >= 0)
        for name, values in (("geom_pair_filtered", pairs[kept]), ("pairid", kinds), ("pairid_filtered", kinds[kept])):
            setattr(model, f"nxn_{name}", wp.array(values, dtype=wp.vec2i, device=data.qpos.device))
        geoms = np.unique(pairs[ours])
        touch = np.zeros((len(geoms),) * 2, bool)
        touch[tuple(np.searchsorted(geoms, pairs[ours]).T)] = True
        self._make_scene(host, geoms, np.argwhere(np.triu(~touch, 1)), data)
        self.query = ab.ManifoldQuery(self.scene, capacity=capacity, points=points)
        self.poses = ab.PoseInput(self.scene)
        self.geoms = wp.array(geoms, dtype=wp.int32, device=self.scene.device)
        model.callback.contactfilter = self.collide

    def _make_scene(self, host, geoms, apart, data):
        self.scene, meshes = ab.Scene(device=data.qpos.device), {}
        for world in range(data.nworld):
            for i in host.geom_dataid[geoms]:
                if i not in meshes:
                    start, first = host.mesh_vertadr[i], host.mesh_faceadr[i]
                    vertices = host.mesh_vert[start : start + host.mesh_vertnum[i]]
                    meshes[i] = ab.Model.from_arrays(vertices, host.mesh_face[first : first + host.mesh_facenum[i]])
                # Of solids, what has gone under whole keeps its depth.
                self.scene.add(meshes[i], world=world, solid=meshes[i].winding.is_closed)
            self.scene.filter(apart + world * len(geoms))

    def collide(self, model, data):
        """Append the contacts where the geoms stand. Waits for the device; while a graph is captured, launches only."""
        size, device = (data.nworld, len(self.geoms)), self.scene.device
        inputs = [self.geoms, data.geom_xpos, data.geom_xmat, self.poses.poses]
        wp.launch(pose_geom_kernel, size, inputs, device=device)
        self.poses.launch()
        (self.query.launch if device.is_capturing else self.query.grow)()
        rows = ContactRows()
        rows.count = data.nacon
        for name in FIELDS:
            setattr(rows, name, getattr(data.contact, name, None))
        for name in MATERIALS:
            setattr(rows, f"geom_{name}", getattr(model, f"geom_{name}"))
        query, found = self.query, self.query.manifolds
        inputs = [self.geoms, query.pair_count, query.pairs, found.count, found.point, found.normal, found.depth, rows]
        wp.launch(write_point_kernel, len(query.pairs), inputs, device=device)

    def check(self):
        """Raise `warp_abtree.CapacityError` where a graph found more than there is room for. Waits for the device."""
        self.query.result().check()


def build():
    """Return a `mujoco.MjModel` of a plane and a peg that stand, and a ring above, a bit aslant."""
    import mujoco

    shapes = {
        "peg": trimesh.creation.cylinder(0.1, 0.8, sections=16),
        "ring": trimesh.creation.torus(0.3, 0.08, 24, 12),
    }
    spec = mujoco.MjSpec()
    spec.option.timestep = 1 / 240
    for name, shape in shapes.items():
        mesh = spec.add_mesh(name=name, uservert=shape.vertices.ravel(), userface=shape.faces.ravel())
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(2, 2, 1))
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="peg", pos=(0, 0, 0.39))
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
        MeshContacts(host, model, data)
        rate = round(1 / host.opt.timestep)
        for step in range(round(seconds * rate)):
            mjw.step(model, data)
            if step % (rate // 2) == 0:
                heights = " ".join(f"{z:5.2f}" for z in data.qpos.numpy()[:, 2])
                print(f"{step / rate:4.1f} s  {int(data.nacon.numpy()[0]):3d} contacts  heights {heights}", flush=True)
        return data.qpos.numpy()[:, 2]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default=None)
    parser.add_argument("--worlds", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=2.0)
    main(**vars(parser.parse_args()))
