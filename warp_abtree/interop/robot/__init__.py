"""Robots of URDF and MJCF files, checked at many configurations."""
