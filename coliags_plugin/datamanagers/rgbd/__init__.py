"""TUM RGB-D: images, depth and a trajectory."""
