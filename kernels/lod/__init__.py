"""Selection of LODs."""
