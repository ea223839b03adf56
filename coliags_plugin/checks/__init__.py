"""Checks of datasets, estimated depth and methods."""
