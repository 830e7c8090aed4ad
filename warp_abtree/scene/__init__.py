"""Posed objects: the scene, its poses, the captured pipeline and sweeps of poses."""
