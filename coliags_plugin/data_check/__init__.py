"""What a scene is, and whether its pictures, poses, depth and calibration agree: ``coliags data check``."""
