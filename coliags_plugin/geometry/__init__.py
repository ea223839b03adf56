"""Lenses, trajectories and triangle meshes."""
