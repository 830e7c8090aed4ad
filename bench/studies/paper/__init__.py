"""The paper's experiments again: `python -m bench paper --out DIR`."""

from . import budget, meshes, static, update

PARTS = {
    "table1": meshes.run,
    "figure6": update.run_figure_6,
    "share": update.run_share,
    "static": static.run,
    "figure4": budget.run,
}
SUMMARIES = {function.__name__: function for function in (update.fit_figure_6, update.fitted_moves, update.thin)}
