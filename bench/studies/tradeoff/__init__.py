"""What speed costs in accuracy, setting by setting, against the exact answer at the finest LODs."""

from . import bounds, competitors, lods, settings, summaries

PARTS = {"lods": lods.run, "settings": settings.run, "bounds": bounds.run, "competitors": competitors.run}
SUMMARIES = {
    function.__name__: function
    for function in (
        summaries.over_meshes,
        summaries.choose,
        summaries.by_offset,
        summaries.precisions,
        summaries.outputs,
        summaries.margins,
        summaries.over_workloads,
    )
}
