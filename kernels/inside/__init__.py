"""Solids: the parts of a surface, which points lie inside a closed one, and how deep."""
