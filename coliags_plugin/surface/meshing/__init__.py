"""Runs to triangle meshes, by fusion of rendered depth."""
