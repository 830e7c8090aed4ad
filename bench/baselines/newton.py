"""Newton's mesh-mesh narrow phase, where the package `newton` is installed: by BVH, and by SDF (CUDA only).

Another question, and an approximate answer: it looks for points of the edges of one mesh inside the other and keeps a
few contacts a pair, without face numbers, so only whether a pair intersects can be compared. All shapes share one mesh;
margins and gaps are 0, so that contacts are those of surfaces that pass through each other.
"""

import warnings

import numpy as np
import warp as wp

from ..timing import make_replay

SDF_RESOLUTION = 64
CONTACTS_PER_PAIR = 512  # what is left of them after reduction
CANDIDATES_PER_HIT = 4


class Pipeline:
    """A `newton.CollisionPipeline` over pairs of shapes that follow one another, with its state and contacts.

    It has room for so many contacts, and so many candidates, a million at least.
    """

    def __init__(self, model, contacts, candidates, **options):
        import newton

        self.model, self.state = model, model.state()
        pairs = np.arange(model.shape_count).reshape(-1, 2)
        options |= {"broad_phase": "explicit", "verify_buffers": False}
        options["shape_pairs_filtered"] = wp.array(pairs, dtype=wp.vec2i, device=model.device)
        room = {"rigid_contact_max": contacts, "max_triangle_pairs": max(1_000_000, candidates)}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of large buffers
            self.pipeline = newton.CollisionPipeline(model, **room, **options)
            self.contacts = self.pipeline.contacts()

    def place(self, poses):
        """Move all bodies, float32 (n, 7)."""
        self.state.body_q.assign(poses)

    def launch(self):
        self.pipeline.collide(self.state, self.contacts)

    def check(self):
        """Raise a RuntimeError that names a buffer that overflowed in the last launch. Waits for the device."""
        narrow, reducer = self.pipeline.narrow_phase, self.pipeline.narrow_phase.global_contact_reducer
        lost = {
            "contacts": int(self.contacts.rigid_contact_count.numpy()[0]) - self.contacts.rigid_contact_max,
            "pairs": int(narrow.shape_pairs_mesh_mesh_count.numpy()[0]) - len(narrow.shape_pairs_mesh_mesh),
            "candidates": int(reducer.buffer_overflows.numpy()[0]),
            "hash table entries": int(reducer.ht_insert_failures.numpy()[0]),
        }
        for what, count in lost.items():
            if count > 0:
                raise RuntimeError(f"Newton lost {count} {what}")


def finalize(builder, device):
    """Return the model of a `newton.ModelBuilder`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of inertia
        return builder.finalize(device=device)


class Newton(Pipeline):
    """Newton's pipeline over given pairs of one mesh.

    Args:
        poses: Float32 (2 p, 7), the two objects of a pair one after the other.
        hits: About how many face pairs intersect, for the size of its buffers.
        sdf: Voxels along the longest side of a signed distance field, 0 for the BVH.
    """

    def __init__(self, vertices, faces, poses, hits, device, sdf):
        import newton

        self.pair_count = len(poses) // 2
        mesh = newton.Mesh(vertices, faces.reshape(-1), compute_inertia=False)
        if sdf:
            mesh.build_sdf(device=device, max_resolution=sdf)
        builder = newton.ModelBuilder()
        config = newton.ModelBuilder.ShapeConfig(density=0.0, margin=0.0, gap=0.0)
        for pose in poses.tolist():
            builder.add_shape_mesh(builder.add_body(xform=wp.transform(*pose), mass=1.0), mesh=mesh, cfg=config)
        room = CONTACTS_PER_PAIR * self.pair_count, CANDIDATES_PER_HIT * int(hits)
        super().__init__(finalize(builder, device), *room, contact_reduction_hashtable_size_factor=1.0)

    def result(self):
        """Return whether each pair has a contact, bool (p,), and their number; raise a RuntimeError where some are lost
        for lack of room, or are between objects of different pairs."""
        self.check()
        count = int(self.contacts.rigid_contact_count.numpy()[0])
        first, second = (getattr(self.contacts, f"rigid_contact_shape{i}").numpy()[:count] // 2 for i in (0, 1))
        if not np.array_equal(first, second):
            raise RuntimeError("Newton reports contacts between objects of different pairs")
        return np.isin(np.arange(self.pair_count), first), count

    def compare(self, any_hit):
        """Return columns: contacts kept, pairs that it misses and invents beside the exact answer, bool (p,)."""
        found, count = self.result()
        return {"contacts": count, "any_missed": (any_hit & ~found).sum(), "any_invented": (found & ~any_hit).sum()}


def make_newton(vertices, faces, poses, hits, device):
    """Return the baselines that can be made, by name, and why the others cannot."""
    made, skipped = {}, {}
    for name, sdf in (("newton_bvh", 0), (f"newton_sdf{SDF_RESOLUTION}", SDF_RESOLUTION)):
        try:
            if sdf and not device.is_cuda:
                raise RuntimeError("its signed distance fields need CUDA")
            baseline = Newton(vertices, faces, poses, hits, device, sdf)
            baseline.launch()  # compiles it
            baseline.check()
            make_replay(baseline.launch, device)
            made[name] = baseline
        except Exception as error:  # another package's failure must not cost the rest of a run
            skipped[name] = f"{type(error).__name__}: {error}"
    return made, skipped
