"""``transforms.json``."""
