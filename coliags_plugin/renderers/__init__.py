"""Renderers: images, depth maps and normals of a field from a camera."""
