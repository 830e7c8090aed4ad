"""What an LOD decides, on a device: tree states and their updates."""
