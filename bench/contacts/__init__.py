"""Contact points of nuts on bolts, and the penetration that they allow."""
