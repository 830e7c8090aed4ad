"""Accuracy against speed, setting by setting, beside the exact answer at the finest LODs."""

from functools import partial

from . import competitors, distances, lods, motions
from .summaries import by_offset, choose, over_meshes, over_workloads, summarise
from .workload import part_of

PARTS = {part.__name__.rpartition(".")[2]: part_of(part.run) for part in (lods, competitors, distances, motions)}
SUMMARIES = {function.__name__: function for function in (over_meshes, choose, by_offset, over_workloads)}
SUMMARIES["distances"] = partial(summarise, names=("method", "setting", "where"))
SUMMARIES["motions"] = partial(summarise, names=("method", "setting"))
