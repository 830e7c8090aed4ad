"""Scenes as TOML files."""
