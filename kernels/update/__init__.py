"""LOD updates of tree states."""
