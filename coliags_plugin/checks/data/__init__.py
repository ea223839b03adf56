"""Consistency checks of a dataset's images, poses, depth and calibration: ``coliags check data``."""
