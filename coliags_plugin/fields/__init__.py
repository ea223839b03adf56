"""Fields: what a scene looks like from anywhere."""
