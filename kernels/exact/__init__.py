"""Exact signs of determinants."""
