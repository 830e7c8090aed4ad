"""Dual-tree traversal of object pairs."""
