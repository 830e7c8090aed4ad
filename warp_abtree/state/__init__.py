"""Tree states, what an LOD decides, and their updates, on a device."""
