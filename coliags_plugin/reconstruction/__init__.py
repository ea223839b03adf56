"""Camera poses and 3D points from images: structure from motion, and depth."""
