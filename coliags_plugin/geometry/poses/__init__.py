"""Camera trajectories: pose file formats, alignment and trajectory errors."""
