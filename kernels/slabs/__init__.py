"""Slabs of nodes: how far faces reach along a direction, that in which they are thinnest or their mean normal."""
