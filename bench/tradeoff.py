"""Study `tradeoff`: what speed costs in accuracy, dial by dial, against the exact answer at the finest LODs."""

from . import tradeoff_dials, tradeoff_lods, tradeoff_peers, tradeoff_promise
from .parts import Figure, Part
from .tradeoff_figures import draw_dials, draw_first_contact, draw_pareto, draw_quality, draw_rivals
from .tradeoff_tables import (
    DIAL_TABLES,
    LOD_CLAIMS,
    LOD_TABLES,
    PROMISE_CLAIMS,
    PROMISE_TABLES,
    RIVAL_CLAIMS,
    RIVAL_TABLES,
)

POSES = (
    "Each mesh against itself, and a robot against its surroundings: B in random rotations comes towards A on straight "
    "lines in random directions. Poses lie from 10 % of the longest side before the first contact to 30 % behind it, "
    "and on both sides of it. "
)

PARTS = (
    Part(
        "lods",
        "Levels of detail",
        tradeoff_lods.run,
        POSES
        + "Both models stand at LODs of one share of the faces, or at those that lod_for(tolerance=) gives for half of "
        "a tolerance each. The first contact is searched for in the same way at every LOD; a gap is the distance of "
        "the finest surfaces where coarse ones first touch. A contact region is the segments of all contacts, sampled.",
        LOD_TABLES,
        (
            Figure(
                "tradeoff_first_contact",
                "Error of the first contact along a motion",
                draw_first_contact,
                (9, 4.5),
                "The certified bound speaks of surface distance; it happens to hold where points lie below the dashed "
                "line.",
            ),
            Figure("tradeoff_quality", "Answers, contacts, regions and normals by LOD", draw_quality, (9, 6)),
            Figure(
                "tradeoff_pareto",
                "Error against time and against node tests",
                draw_pareto,
                (9, 7.5),
                "Filled and joined: rungs that no other rung of the mesh beats in time and error; hollow: the others.",
            ),
        ),
        LOD_CLAIMS,
    ),
    Part(
        "dials",
        "Precision, output, margin",
        tradeoff_dials.run,
        POSES
        + "Precisions are compared at the same LOD, also at the two sides of the first contact and with a mesh laid on "
        "itself. A margin counts pairs as meeting that are not proved farther apart than it, a part of both errors.",
        DIAL_TABLES,
        (Figure("tradeoff_dials", "What is asked, and a margin around coarse surfaces", draw_dials, (9, 4.5)),),
    ),
    Part(
        "promises",
        "What the certified bound promises",
        tradeoff_promise.run,
        "Random LODs: points of the original surface, half of them vertices, against the surface at the LOD, measured "
        "by libigl. Random LODs and poses about the first contact: what is proved apart by both errors, beside the "
        "exact answer at the finest LODs.",
        PROMISE_TABLES,
        (),
        PROMISE_CLAIMS,
    ),
    Part(
        "rivals",
        "Other ways to the same end",
        tradeoff_peers.run,
        POSES
        + "Other simplifications, convex hulls and decompositions are asked by python-fcl on one core, Newton's signed "
        "distance fields on a GPU where there is one.",
        RIVAL_TABLES,
        (
            Figure(
                "tradeoff_rivals",
                "Yes or no: time against the error of the first contact",
                draw_rivals,
                (10, 7.5),
                "Exact answers lie at 0. Points of one method are joined in the order of their settings.",
            ),
        ),
        RIVAL_CLAIMS,
    ),
)
