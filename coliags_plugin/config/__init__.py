"""Component registries and method configs."""
