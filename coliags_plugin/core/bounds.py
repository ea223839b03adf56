"""Largest magnitudes that are accepted from files, so that what is computed from them is finite and fits in memory."""

from __future__ import annotations

#: Largest coordinate or depth, scene units. A kilometre where they are mm; float32 still tells 0.06 mm apart there, and
#: squared distances stay far below its limit.
LENGTH = 1e6
#: Largest focal length or coordinate of a principal point, pixels: a hundred times a telephoto lens's on the
#: largest images.
PIXELS = 1e7
#: Largest tangent of the angle between a pinhole's axis and a pixel's ray: 89.4 degrees. Pinholes have less than 10.
SLOPE = 100.0
#: Largest width and height of an image, pixels; OpenCV's remapping takes no more than 32767.
IMAGE_SIDE = 32767
#: Most pixels of an image: an 8-bit RGB image has 300 MB then.
IMAGE_PIXELS = 100_000_000
#: Largest coefficient of lens distortion. Real ones are below 100, even of rational models.
DISTORTION = 1e4
#: Largest text file of settings or of few numbers, bytes. YAML is parsed slowly.
TEXT_BYTES = 1_000_000
#: Largest JSON file, bytes: its values take up to ten times as much memory. Cameras take about 1 kB per frame.
JSON_BYTES = 100_000_000
