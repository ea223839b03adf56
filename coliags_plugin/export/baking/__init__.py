"""Runs to files of Gaussians, baked where need be, and such files to runs."""
