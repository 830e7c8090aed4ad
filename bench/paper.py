"""The paper's experiments again: `python -m bench paper --out DIR`."""

from . import paper_lods, paper_meshes, paper_query, paper_tree, paper_update

PARTS = (
    paper_meshes.TABLE_1,
    paper_update.FIGURE_6,
    paper_update.SHARE,
    paper_query.STATIC,
    paper_lods.FIGURE_4_PART,
    paper_tree.TREES,
    paper_meshes.SIMPLIFY,
    paper_lods.CACHE,
)
