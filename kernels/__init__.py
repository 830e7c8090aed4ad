"""Warp kernels and functions of warp_abtree, imported as ``warp_abtree.kernels``."""
