"""Colours and labels that pictures, the viewer and the command line share."""

# Plain and intersecting faces, by model in the order of the scene.
COLOURS = (
    ((0.80, 0.76, 0.71), (0.06, 0.74, 0.25)),
    ((0.30, 0.50, 0.78), (1.00, 0.87, 0.12)),
    ((0.84, 0.50, 0.37), (0.97, 0.22, 0.60)),
    ((0.56, 0.48, 0.74), (0.20, 0.88, 0.94)),
)
# Segments between the nearest points of two objects.
NEAREST_COLOUR = (0.85, 0.10, 0.10)
# Contact points, and how opaque the objects are behind which they lie.
CONTACT_COLOUR, SEE_THROUGH = (0.90, 0.05, 0.20), 0.3
# Boxes of an AB-Tree.
BOX_COLOUR = (0.05, 0.05, 0.05)
# The stages of a frame; a budget is for the first four.
STAGE_LABELS = {
    "select_ms": "select LODs",
    "refine_ms": "refine and refit",
    "broad_ms": "broad phase",
    "query_ms": "query",
    "move_ms": "move",
    "answer_ms": "answer",
}


def to_bytes(colour) -> tuple[int, ...]:
    """Return a colour of 0 to 1 as whole numbers of 0 to 255."""
    return tuple(round(255 * part) for part in colour)
