"""COLMAP models and their images."""
