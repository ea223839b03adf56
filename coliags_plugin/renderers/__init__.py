"""Renderers: a field, seen by a camera."""
