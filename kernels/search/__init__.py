"""Searches of two trees: items, stacks, load balancing, slabs."""
