"""The paper's experiments again: `python -m bench paper --out DIR`."""

from . import budget, meshes, static, update

PARTS = {
    "table1": meshes.run,
    "figure6": update.run_figure_6,
    "share": update.run_share,
    "static": static.run,
    "figure4": budget.run,
}
SUMMARIES = {
    "fit_figure_6": update.fit_figure_6,
    "fitted_moves": update.fitted_moves,
    "thin": update.thin,
}
