"""`warp-abtree clash`: interference, touching and clearance of all pairs of parts of an assembly."""

import csv
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from warp_abtree.app.cli.arguments import Parser
from warp_abtree.app.cli.report import check_output, plain, print_result
from warp_abtree.app.pictures.render import import_pyvista
from warp_abtree.app.pictures.scenes import draw_clashes
from warp_abtree.checks.atomic_write import atomic_write
from warp_abtree.checks.quaternions import matrices_of
from warp_abtree.interop.scenes import scene_from_file, to_trimesh
from warp_abtree.query.result import Result
from warp_abtree.scene.point_distance import signed_distance
from warp_abtree.scene.scene import Scene

SUMMARY = "list the pairs of parts of an assembly that interfere, touch or are close"
EXAMPLES = (
    "assembly.glb --within 2",
    "assembly.step --tolerance 0.01 --csv clashes.csv --picture clashes.png",
    "assembly.usd --json --glb clashes.glb",
)
CLASH_KINDS = ("interference", "touching", "clearance")
TOUCH_TOLERANCE = 1e-6  # of the assembly's diagonal: files hold coordinates in float32
DEPTH_SAMPLES = 16  # faces of each object of a pair at which depths are looked for beside those of the query
PROBE = 1e-9  # of the assembly's diagonal: the first step under a wall
UNBUILT = 2**31  # base faces: no levels of detail are asked for


@dataclass(frozen=True)
class Clash:
    """A pair of objects that interfere, touch, or are near one another."""

    first: str  # name
    second: str
    kind: str  # of CLASH_KINDS
    distance: float  # least distance of the surfaces [units], 0 where they meet or one is inside the other
    penetration: float | None  # depth of one in the other [units], a lower bound; None of two that are open
    faces: int  # pairs of faces that intersect
    open: tuple[str, ...]  # names of those that are not closed
    pair: tuple[int, int]  # indices

    def severity(self) -> tuple:
        """Return what sorts clashes: the deepest interference first, the widest clearance last."""
        return CLASH_KINDS.index(self.kind), -(self.penetration or 0.0), self.distance, -self.faces, self.pair


def assembly_size(scene: Scene) -> float:
    """Return the diagonal of the box around all objects [world units]."""
    objects = scene.batch().objects.pool
    corners, turns, shifts = [], objects.rotation.numpy(), objects.position.numpy()
    for i in np.flatnonzero(scene.present):
        model = scene.models[scene.object_model[i]]
        posed = model.mesh_at(model.lod_max)[0] @ turns[i].T + shifts[i]
        corners += [posed.min(0), posed.max(0)]
    return float(np.linalg.norm(np.ptp(corners or np.zeros((1, 3)), axis=0)))


def find_clashes(scene: Scene, within: float = 0.0, tolerance: float | None = None) -> list[Clash]:
    """Return the pairs of objects that interfere, touch, or are no farther apart than a distance, the worst first.

    Of a pair with a solid, the signed distance tells: deeper than the tolerance is interference, within it is touching.
    Depths are those of `query.stages.distance`; where faces intersect and none of its points is deep, points of the
    surfaces between their contacts are looked at, and points under walls that coincide. Two objects that are no solids
    interfere where faces intersect. Waits for the device.

    Args:
        within: Distance [world units] up to which pairs that are apart are listed.
        tolerance: Depth and distance [world units] up to which a pair touches; None is 1e-6 of `assembly_size`.

    Raises ValueError for one that is negative or not finite.
    """
    size = assembly_size(scene)
    tolerance = TOUCH_TOLERANCE * size if tolerance is None else tolerance
    for name, value in (("within", within), ("tolerance", tolerance)):
        if not 0 <= value < np.inf:
            raise ValueError(f"{name}: {value} is no distance of 0 or more")
    solid = np.array(scene.object_solid, bool)
    signed = {"signed": True} if solid.any() else {}
    found = scene.intersect(output="distance", beyond=max(within, tolerance), **signed)
    near = np.isfinite(found.distance)
    pairs, distance = found.pairs[near], found.distance[near]
    depth, faces = np.maximum(-distance, 0.0), np.zeros(len(pairs), np.int64)
    meet = np.flatnonzero(distance <= tolerance)
    if len(meet):
        met = scene.intersect(pairs[meet], output="contacts")
        faces[meet] = met.count
        shallow = (depth[meet] <= tolerance) & solid[pairs[meet]].any(1)
        depth[meet] = np.maximum(depth[meet], _sampled_depths(scene, met, shallow, size, tolerance))
    clashes = []
    for pair, apart, deep, count in zip(pairs.tolist(), distance.tolist(), depth.tolist(), faces.tolist()):
        decided = solid[pair].any()
        inside = deep > tolerance if decided else count > 0
        kind = CLASH_KINDS[0] if inside else CLASH_KINDS[1] if apart <= tolerance else CLASH_KINDS[2]
        first, second = map(scene.name, pair)
        is_open = tuple(name for name, i in zip((first, second), pair) if not solid[i])
        depth_told = deep if decided else None
        clashes.append(Clash(first, second, kind, max(apart, 0.0), depth_told, count, is_open, tuple(pair)))
    return sorted(clashes, key=Clash.severity)


def _sampled_depths(scene, met: Result, asked, size, tolerance) -> np.ndarray:
    """Return the greatest depth that samples find for each pair of a result of contacts, 0 for those not asked.

    A sample is the mean of what a face shares with the other object: a point of one surface, which is inside the other
    object where that goes through the face. Under walls that coincide no point of a surface is inside: of pairs of
    solids that are still shallow, points farther and farther along the normal are looked at in both.
    """
    solid, pose_of = np.array(scene.object_solid, bool), scene.poses
    depth = np.zeros(len(met.pairs))
    samples = [_samples(met.contacts, asked, side) for side in (0, 1)]
    for side, (place, point, _) in enumerate(samples):
        other = met.pairs[place, 1 - side]
        found = _depths(scene, pose_of, other[solid[other]], point[solid[other]])
        np.maximum.at(depth, place[solid[other]], found)
    place, point, normal = (np.concatenate(parts) for parts in zip(*samples))
    flat = (depth[place] <= tolerance) & solid[met.pairs[place]].all(1)
    place, point = np.tile(place[flat], 2), np.tile(point[flat], (2, 1))
    normal, step = np.concatenate([normal[flat], -normal[flat]]), 4 * (tolerance or PROBE * size)
    while len(place) and step < size:
        below = point + step * normal
        deep = np.minimum(*(_depths(scene, pose_of, met.pairs[place, side], below) for side in (0, 1)))
        np.maximum.at(depth, place, deep)
        on = deep > step / 2
        place, point, normal, step = place[on], point[on], normal[on], 2 * step
    return depth


def _samples(contacts, asked, side: int):
    """Return the place in the pairs, the mean contact and the normal of some faces of one side of pairs asked for."""
    rows = contacts[asked[contacts["pair"]]]
    keys, first, group = np.unique(
        np.stack([rows["pair"], rows["faces"][:, side]], 1), axis=0, return_index=True, return_inverse=True
    )
    group = group.reshape(-1)
    means = np.zeros((len(keys), 3))
    np.add.at(means, group, (rows["p0"] + rows["p1"]) / 2)
    means /= np.bincount(group, minlength=len(keys))[:, None]
    starts, counts = np.unique(keys[:, 0], return_index=True, return_counts=True)[1:]
    spread = [start + np.unique(np.linspace(0, n - 1, DEPTH_SAMPLES).astype(int)) for start, n in zip(starts, counts)]
    some = np.concatenate(spread) if spread else np.zeros(0, int)
    return keys[some, 0], means[some], rows[f"normal_{'ab'[side]}"][first[some]]


def _depths(scene, pose_of, objects, points) -> np.ndarray:
    """Return how deep points (n, 3) lie in solid objects (n,) [world units], 0 for those outside."""
    depth = np.zeros(len(points))
    for i in np.unique(objects).tolist():
        rows, turn = objects == i, matrices_of(pose_of[i : i + 1, 3:])[0]
        model, lod = scene.models[scene.object_model[i]], int(scene.lods[i])
        depth[rows] = -signed_distance(model, (points[rows] - pose_of[i, :3]) @ turn, lod, scene.device.alias)
    return np.maximum(depth, 0.0)


def add_arguments(sub: Parser):
    """Add the arguments of the command to its parser."""
    sub.add_file("assembly", metavar="ASSEMBLY", help="GLB, glTF, USD, 3MF, STEP, or OBJ with an `o` line a part")
    about = "list pairs no farther apart than this too [file's units] (0: what meets alone)"
    sub.add_number("--within", about, default=0.0)
    about = "depth and distance up to which parts touch [file's units]"
    sub.add_number("--tolerance", f"{about} ({TOUCH_TOLERANCE:g} of the assembly's diagonal)")
    sub.add_file("--csv", type=Path, metavar="FILE", help="write a row a pair")
    sub.add_file("--picture", type=Path, metavar="PNG", help="draw the assembly, what interferes coloured")
    sub.add_file("--glb", type=Path, metavar="FILE", help="write the assembly, faces that interfere in red")


def clash(options, progress) -> int:
    """List the clashes of an assembly; return 1 where something interferes."""
    for path, suffix in ((options.csv, ".csv"), (options.picture, ".png"), (options.glb, ".glb")):
        if path:
            check_output(path, [suffix], inputs=[options.assembly])
    if options.picture:
        import_pyvista("--picture")
    scene = scene_from_file(options.assembly, options.device, UNBUILT, progress, solid="closed")
    progress.close()
    if scene.object_count < 2:
        raise ValueError(f"{options.assembly}: holds one object alone, which clashes with nothing")
    tolerance = TOUCH_TOLERANCE * assembly_size(scene) if options.tolerance is None else options.tolerance
    try:
        clashes = find_clashes(scene, options.within, tolerance)
    except ValueError as error:
        raise ValueError(f"--{error}") from None
    rows = [{key: value for key, value in asdict(each).items() if key != "pair"} for each in clashes]
    counts = {kind: sum(each.kind == kind for each in clashes) for kind in CLASH_KINDS}
    _write(options, scene, clashes, rows)
    summary = {
        "assembly": str(options.assembly),
        "device": str(scene.device),
        "objects": scene.object_count,
        "open": [scene.name(i) for i, solid in enumerate(scene.object_solid) if not solid],
        "tolerance": tolerance,
        "within": options.within,
        **counts,
        "written": [str(path) for path in (options.csv, options.picture, options.glb) if path],
        "pairs": rows,
    }
    print_result(summary, options.json)
    return int(counts[CLASH_KINDS[0]] > 0)


def _write(options, scene, clashes, rows):
    """Write the files that the options name."""
    if options.csv:
        with atomic_write(options.csv, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, [key for key in Clash.__dataclass_fields__ if key != "pair"])
            writer.writeheader()
            writer.writerows({**plain(row), "open": " ".join(row["open"])} for row in rows)
    if not (options.picture or options.glb):
        return
    pairs = np.array([each.pair for each in clashes if each.kind == CLASH_KINDS[0]], np.int32).reshape(-1, 2)
    found = scene.intersect(pairs, output="contacts")
    if options.picture:
        draw_clashes(scene, found, options.picture, Path(options.assembly).name)
    if options.glb:
        import trimesh

        made = to_trimesh(scene, found)
        curves = np.stack([found.contacts["p0"], found.contacts["p1"]], 1)
        if len(curves):
            made.add_geometry(trimesh.load_path(curves), node_name="curves of contact")
        with atomic_write(options.glb) as file:
            file.write(made.export(file_type="glb"))
