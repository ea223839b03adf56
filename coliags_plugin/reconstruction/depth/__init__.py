"""Dense depth with confidence from posed images without depth (docs/depth.md)."""
