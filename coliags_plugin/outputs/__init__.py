"""Image files, colour-mapped images, charts, video and HTML pages."""
