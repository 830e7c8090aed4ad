"""Checks of arguments, atomic writes and locks: what every package may use."""
