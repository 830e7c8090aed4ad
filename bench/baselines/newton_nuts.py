"""Nuts on their bolts in Newton's worlds: `NewtonContacts` beside Newton's own pass, by signed distance fields.

Fields, reduction and room are those of its example nut_bolt_sdf: 512 voxels along the longest side, within 5 mm of the
surface, and a gap of 5 mm a shape; and the gap that `NewtonContacts` has here, 0.05 mm, with which Newton has less to
do. Fields need CUDA; on the CPU its BVH takes their place. The bolt is a body as well, and there is no ground.
"""

import time
from functools import partial

import numpy as np
import warp as wp

import warp_abtree as ab

from ..memory import used_memory
from ..timing import medians, time_in_turn
from .newton import Pipeline, finalize

RESOLUTION, BAND = 512, 0.005
GAP, EXAMPLE_GAP = 5e-5, 0.005  # [m] a shape
CONTACTS_PER_WORLD = 500
POINTS = 32
# Certified tolerance of the meshes' LODs [m], and whether points are moved to the originals.
OURS = {
    "ours": (None, False),
    "ours_10um": (1e-5, False),
    "ours_30um": (3e-5, False),
    "ours_30um_originals": (3e-5, True),
}
FIELDS = tuple(f"rigid_contact_{name}" for name in ("shape0", "shape1", "point0", "point1", "normal"))
ROOM_TRIES = 4  # each with four times the room


def cook_meshes(models, device):
    """Return Newton's meshes of bolt and nut, on CUDA with fields of distances, and the time of these [s]."""
    import newton

    parts = [model.mesh_at(model.lod_max)[:2] for model in models]
    meshes = [newton.Mesh(v.astype(np.float32), f.reshape(-1)) for v, f in parts]
    begin = time.perf_counter()
    for mesh in meshes if device.is_cuda else []:
        band = (-BAND, BAND)
        mesh.build_sdf(device=device, max_resolution=RESOLUTION, narrow_band_range=band, margin=EXAMPLE_GAP)
    wp.synchronize_device(device)
    return meshes, time.perf_counter() - begin


def taken_memory(device) -> float:
    """Return the memory that is taken on a device [MiB]; 0 on the CPU."""
    return used_memory(device).get("taken_mib", 0.0)


def make_model(meshes, worlds, device):
    """Return a `newton.Model` of worlds that have a bolt and a nut."""
    import newton

    config = newton.ModelBuilder.ShapeConfig(density=8000.0, mu=0.01, ke=1e7, kd=1e4, margin=0.0, gap=GAP)
    world, builder = newton.ModelBuilder(), newton.ModelBuilder()
    for mesh in meshes:
        world.add_shape_mesh(world.add_body(), mesh=mesh, cfg=config)
    builder.replicate(world, worlds)
    return finalize(builder, device)


class NutFields(Pipeline):
    """Newton's pipeline over given pairs of a bolt and a nut, with room for what it finds."""

    def __init__(self, model, gap, poses):
        self.gap, worlds = gap, model.shape_count // 2
        for k in range(ROOM_TRIES):
            super().__init__(model, CONTACTS_PER_WORLD * worlds, 2000 * worlds << 2 * k, reduce_contacts=True)
            self.place(poses)
            self.launch()
            try:
                return self.check()
            except RuntimeError:
                if k == ROOM_TRIES - 1:
                    raise

    def launch(self):
        self.model.shape_gap.fill_(self.gap)
        super().launch()


class Ours:
    """`NewtonContacts` of the same model, with the same calls; all faces, or LODs within a tolerance.

    A launch searches all pairs anew; at `rest` none.
    """

    def __init__(self, model, models, tolerance, originals, poses):
        shapes = {shape: models[shape % 2] for shape in range(model.shape_count)}
        model.shape_gap.fill_(GAP)  # read once
        self.found = ab.NewtonContacts(model, shapes, None, POINTS, originals=originals)
        self.state = model.state()
        lods = [m.lod_max if tolerance is None else m.lod_for(tolerance=tolerance) for m in models]
        self.found.scene.set_lods(lods * (model.shape_count // 2))
        self.faces = " on ".join(str(len(m.mesh_at(lod)[1])) for m, lod in zip(models[::-1], lods[::-1]))
        self.contacts = self.found.contacts()
        self.place(poses)
        self.found.collide(self.state, self.contacts)

    place = Pipeline.place

    def launch(self):
        self.found.query.forget()
        self.rest()

    def rest(self):
        self.found.launch(self.state, self.contacts)

    def check(self):
        self.found.check(self.contacts)


def same_twice(one, poses, others):
    """Return whether contacts have the same bits twice, in order; other poses between."""
    found = []
    for placed in (poses, others, poses):
        one.place(placed)
        one.launch()
        count = int(one.contacts.rigid_contact_count.numpy()[0])
        found.append([getattr(one.contacts, name).numpy()[:count].tobytes() for name in FIELDS])
    one.check()
    return found[0] == found[2]


def measure(models, matrices, others, device, repeats):
    """Return a row: times of a launch over all worlds [ms], in turn; contacts, bits, fields and memory.

    Args:
        models: Bolt and nut.
        matrices, others: Two sets of poses of the nuts in their bolts' frames, (worlds, 4, 4).
    """
    before, (_, first) = taken_memory(device), cook_meshes(models, device)  # compiles
    meshes, seconds = cook_meshes(models, device)
    row = {"worlds": len(matrices), "fields_mib": taken_memory(device) - before}
    row |= {"cook_first_s": first, "cook_s": seconds}
    model = make_model(meshes, len(matrices), device)
    poses, others = (body_poses(m) for m in (matrices, others))
    kind = "sdf" if device.is_cuda else "bvh"
    gaps = {f"{kind}_same_gap": GAP} | ({f"{kind}_example": EXAMPLE_GAP} if device.is_cuda else {})
    theirs = {}
    for name, gap in gaps.items():
        keep(row, name, partial(NutFields, model, gap, poses), poses, others, device, theirs)
    for name, given in OURS.items():  # one goes before the next is made, since all would take too much
        made = dict(theirs)
        keep(row, name, partial(Ours, model, models, *given, poses), poses, others, device, made)
        if name in made:
            row |= measure_ours(name, made, device, repeats)
    return row


def measure_ours(name, made, device, repeats) -> dict:
    """Return columns of one of ours: faces, nuts that meet their bolts, crossing face pairs; times in turn with
    Newton's, and at rest, and their ratios. Raise a RuntimeError where contacts differ from what meets."""
    ours = made[name]
    found, scene = ours.found.query.result(with_points=False), ours.found.scene
    meet, crossing = scene.intersect(found.pairs, "any").any.sum(), found.any.sum()
    if meet != crossing:
        raise RuntimeError(f"{meet} nuts meet their bolts, {crossing} have faces that cross")
    row = {f"{name}_faces": ours.faces, f"{name}_meet": meet, f"{name}_crossing": found.count.sum()}
    launches = {key: one.launch for key, one in made.items()}
    times = medians(time_in_turn(launches, device, repeats))
    ours.launch()
    times |= medians(time_in_turn({f"{name}_rest": ours.rest}, device, repeats))
    ratios = {f"{key}_over_{name}": ms / times[name] for key, ms in times.items() if not key.startswith(name)}
    return row | {f"{key}_ms": ms for key, ms in times.items()} | ratios


def keep(row, name, make, poses, others, device, made):
    """Make a contender and keep it in `made`, or in the row why it cannot be; add what it found to the row."""
    before = taken_memory(device)
    try:
        one = make()
        row[f"{name}_same_bits"] = same_twice(one, poses, others)
    except (RuntimeError, MemoryError) as error:  # what has no room must not cost the rest of a run
        row[f"{name}_skipped"] = f"{type(error).__name__}: {error}"
        return
    made[name] = one
    row[f"{name}_mib"] = taken_memory(device) - before
    count = int(one.contacts.rigid_contact_count.numpy()[0])
    row[f"{name}_contacts"] = count
    row[f"{name}_worlds"] = len(np.unique(one.contacts.rigid_contact_shape0.numpy()[:count] // 2))


def body_poses(matrices):
    """Return the poses of bolts, which stand at the origin, and nuts, float32 (2 worlds, 7)."""
    poses = np.zeros((2 * len(matrices), 7), np.float32)
    poses[:, 6] = 1
    poses[1::2] = [wp.transform(*wp.transform_decompose(wp.mat44(matrix))[:2]) for matrix in matrices]
    return poses
