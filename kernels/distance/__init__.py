"""Least distances of surfaces: of two triangles, of two boxes, and the search of both trees."""
