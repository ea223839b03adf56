"""RotateColon."""
