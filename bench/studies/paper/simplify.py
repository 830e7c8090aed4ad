"""Error of the progressive meshes beside other simplifiers."""

import numpy as np

from ...surfaces import distances, sample_surface
from ...tables import pick

FRACTIONS = (0.5, 0.1, 0.02, 0.01)
OURS = "warp_abtree"
MESHES = (("cow", "warp:rocks"), ("fandisk", "warp:bear"), ("stanford-bunny", "warp:bunny"))
QUICK_MESHES = (("cow", "warp:rocks"), ("warp:bear", "fandisk"))


def surface_error(original, simple, count, device):
    """Return mean and greatest distances between two meshes, from dense samples and the vertices [model units].

    Returns:
        Mean of both ways' means, the greatest from the original to the other, and the greatest of both ways.
    """
    means, worst = [], []
    for (vertices, faces), other in ((original, simple), (simple, original)):
        points = sample_surface(np.random.default_rng(0), vertices, faces, count)
        found = distances(np.concatenate([points, vertices[np.unique(faces)]]), *other, device)
        means.append(found[:count].mean())  # the vertices after the samples are not spread evenly
        worst.append(found.max())
    return float(np.mean(means)), float(worst[0]), float(max(worst))


def simplify_vtk(vtk, vertices, faces, target):
    """Return a mesh simplified by vtkQuadricDecimation."""
    from vtk.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy

    points = vtk.vtkPoints()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(vertices), deep=True))
    cells = vtk.vtkCellArray()
    cells.SetData(3, numpy_to_vtkIdTypeArray(np.ascontiguousarray(faces.astype(np.int64).ravel()), deep=True))
    mesh = vtk.vtkPolyData()
    mesh.SetPoints(points)
    mesh.SetPolys(cells)
    decimation = vtk.vtkQuadricDecimation()
    decimation.SetInputData(mesh)
    decimation.SetTargetReduction(1 - target / len(faces))
    decimation.Update()
    found = decimation.GetOutput()
    corners = vtk_to_numpy(found.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    return vtk_to_numpy(found.GetPoints().GetData()).astype(np.float64), corners


def simplify_fast(library, vertices, faces, target):
    """Return a mesh simplified by fast-simplification."""
    found = library.simplify(np.ascontiguousarray(vertices), np.ascontiguousarray(faces), target_count=target)
    return np.asarray(found[0], np.float64), np.asarray(found[1])


SIMPLIFIERS = {
    "VTK vtkQuadricDecimation": ("vtk", simplify_vtk),
    "fast-simplification": ("fast_simplification", simplify_fast),
}


def run(context):
    """Yield one row a mesh, fraction of the faces and simplifier; what is not installed is noted.

    Distances are fractions of the mesh's diagonal, both ways, from 200,000 points spread evenly over each surface and
    its vertices, by Warp's closest-point query (float32).
    """
    libraries = {name: (simplify, context.library(module)) for name, (module, simplify) in SIMPLIFIERS.items()}
    samples = context.size(200_000, 20_000)
    for names in context.size(MESHES, QUICK_MESHES):
        model = context.model(*names)
        context.progress(model.name)
        original = model.mesh_at(model.lod_max)[:2]
        diagonal = float(np.linalg.norm(np.ptp(original[0], axis=0)))
        for fraction in FRACTIONS:
            lod = model.lod_for(fraction=fraction)
            meshes = {OURS: model.mesh_at(lod)[:2]}
            for name, (simplify, library) in libraries.items():
                if library is not None:
                    meshes[name] = simplify(library, *original, len(meshes[OURS][1]))
            for who, mesh in meshes.items():
                mean, there, worst = surface_error(original, mesh, samples, context.device)
                row = {"model": model.name, "share": fraction, "simplifier": who, "faces": len(mesh[1])}
                row |= {"mean": mean / diagonal, "there": there / diagonal, "hausdorff": worst / diagonal}
                yield row | {"certified": model.error_at(lod) / diagonal if who == OURS else None}


def compare_simplifiers(rows):
    """Return one row a mesh and fraction of the faces, with columns for every simplifier."""
    found = []
    short = {OURS: "ours"} | {name: module for name, (module, _) in SIMPLIFIERS.items()}
    for model, fraction in dict.fromkeys((row["model"], row["share"]) for row in rows):
        line = {"model": model, "share": fraction}
        for row in pick(rows, model=model, share=fraction):
            names = ("faces", "mean", "there", "hausdorff", "certified")
            line |= {f"{short[row['simplifier']]}_{name}": row[name] for name in names}
        found.append(line)
    return found
