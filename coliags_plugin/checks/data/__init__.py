"""Consistency checks of a dataset's images, poses, depth and calibration: ``coliags data check``."""
