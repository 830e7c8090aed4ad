"""Slabs of nodes: how far faces reach along the direction in which they are thinnest."""
