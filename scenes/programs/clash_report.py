"""A clash report of an assembly of 50 parts: which parts interfere and how far one has to move, which are too close.

python scenes/programs/clash_report.py writes clashes.csv and clash_report.png (docs/programs.md); of a file,
without a program: `warp-abtree clash ASSEMBLY --within 2`.
"""

import numpy as np
import trimesh

import warp_abtree as ab
from warp_abtree.app import picture


def write_assembly(path, rng):
    """Write a plate with bolts in its holes, a washer on each, and blocks between them; some are misplaced [mm]."""
    assembly = trimesh.Scene()
    bore = trimesh.creation.annulus(3.3, 8, 12, sections=64, metadata={"name": "sleeve"})
    parts = {"sleeve": bore, "bolt": trimesh.creation.cylinder(3.2, 30, sections=64, metadata={"name": "bolt"})}
    parts["washer"] = trimesh.creation.annulus(3.3, 7, 1.5, sections=64, metadata={"name": "washer"})
    lift = {"sleeve": 0, "bolt": 5, "washer": 6.75}
    for k in range(16):
        for name, mesh in parts.items():
            offset = rng.normal(0, 0.04, 3) if name == "bolt" else np.zeros(3)
            place = np.array((20 * (k % 4), 20 * (k // 4), lift[name])) + offset
            assembly.add_geometry(mesh, f"{name} {k}", transform=trimesh.transformations.translation_matrix(place))
    for k, x in enumerate((10, 51)):
        place = trimesh.transformations.translation_matrix((x, 30, 0))
        assembly.add_geometry(
            trimesh.creation.box((3.5, 60, 8), metadata={"name": "rail"}), f"rail {k}", transform=place
        )
    assembly.export(path)


def main(path="assembly.glb", table="clashes.csv", png="clash_report.png", device=None):
    write_assembly(path, np.random.default_rng(2))
    scene = ab.scene_from_file(path, device=device, solid=True)
    near = scene.intersect(output="distance", signed=True, beyond=0.05)  # no farther apart than 0.05 mm
    near.to_csv(table)
    found = [row for row in near.rows() if row["distance"] < np.inf]
    clashes = sorted((row for row in found if row["distance"] < -1e-4), key=lambda row: row["distance"])
    print(f"{scene.object_count} parts of {len(scene.models)} shapes: {len(clashes)} pairs interfere,", end=" ")
    print(f"{len(found) - len(clashes)} touch or are within 0.05 mm")
    pairs = near.pairs[near.distance < -1e-4]
    way = scene.penetration(pairs)
    depths = dict(zip(map(tuple, pairs.tolist()), zip(way.depth, way.direction)))
    for (first, second), (depth, direction) in sorted(depths.items(), key=lambda item: -item[1][0])[:5]:
        print(f"move {scene.name(second)} by {depth:.3f} mm along {np.round(direction, 2)} out of {scene.name(first)}")
    picture(scene, png, result=scene.intersect(pairs, "faces"))
    return scene, clashes, way


if __name__ == "__main__":
    main()
