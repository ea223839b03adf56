"""COLMAP models and their pictures."""
