"""The progressive mesh and its certified errors."""
