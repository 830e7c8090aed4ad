import warp as wp
