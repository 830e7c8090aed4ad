"""Accuracy against speed, setting by setting, beside the exact answer at the finest LODs."""

from functools import partial

from . import competitors, distances, lods, motions, summaries

PARTS = {
    "lods": lods.run,
    "competitors": competitors.run,
    "distances": distances.run,
    "motions": motions.run,
}
SUMMARIES = {
    "over_meshes": summaries.over_meshes,
    "choose": summaries.choose,
    "by_offset": summaries.by_offset,
    "over_workloads": summaries.over_workloads,
    "distances": partial(summaries.summarise, names=("method", "setting", "where")),
    "motions": partial(summaries.summarise, names=("method", "setting")),
}
