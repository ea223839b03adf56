"""Datasets on disk, each read into a scene."""
