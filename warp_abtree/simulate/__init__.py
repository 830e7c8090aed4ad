"""Algorithm 4 of the paper: frames, motion and rigid bodies."""
