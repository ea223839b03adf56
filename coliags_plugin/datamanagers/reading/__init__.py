"""Reading of images, depth files, points and camera files, shared by all data managers."""
