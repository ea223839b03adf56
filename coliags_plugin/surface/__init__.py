"""Surfaces of runs: triangle meshes, and what a camera saw of them."""
