"""Lens models and undistortion."""
