"""A whole procedure: a long video, cut into segments that are reconstructed each by itself, and joined."""
