"""Types of keys in scene files, and what all tables share."""

from typing import Annotated, TypeVar

from msgspec import Meta, Struct

from warp_abtree.app.toml.objects import OBJECT_LIMIT

T = TypeVar("T")
Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Fraction = Annotated[float, Meta(gt=0, le=1)]
Count = Annotated[int, Meta(ge=1, le=2**31 - 1)]
Cells = Annotated[int, Meta(ge=0, le=OBJECT_LIMIT)]
Copies = Annotated[int, Meta(ge=1, le=OBJECT_LIMIT)]
Restitution = Annotated[float, Meta(ge=0, le=1)]
Sections = Annotated[int, Meta(ge=3, le=10_000)]
NonEmpty = Annotated[list[T], Meta(min_length=1)]
Vector = tuple[float, float, float]
ORIGIN = (0.0, 0.0, 0.0)


class Table(Struct, forbid_unknown_fields=True):
    """What all tables share."""


def check_direction(key, vector):
    """Refuse a direction of no length."""
    if vector is not None and not any(vector):
        raise ValueError(f"{key}: a direction of no length")
